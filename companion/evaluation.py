"""Estimators over many trials of a scenario: mean errors, consistency, time, and distance from the bound.

Trial k has seed S + k for everything random in it: obstacles, start, gait and noise. Trials run in processes
of their own; how many there are changes no figure but the times.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from companion.config import Config
from companion.errors import UserError
from companion.estimator_choice import chosen_settings, split_choice
from companion.legs import LegFigures
from companion.sim.scenario import load_scenario
from companion.sim.scenario_tables import PaperTable
from companion.trial import LIDAR_ALONE, UWB_ALONE, TrialFigures, run_trial
from estimators import ESTIMATORS

DEFAULT_CHOICES = (UWB_ALONE, LIDAR_ALONE, "ekf")
NEES_CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class UpdateTime:
    """Time of an update that was used [us]."""

    median: float
    p99: float


@dataclass(frozen=True, slots=True)
class MeanFigures:
    """Means over trials of an estimator's `TrialFigures`.

    Attributes:
        nees_bounds: the mean NEES of an honest covariance lies between these with 95 % probability. The
            samples of a trial follow each other too closely to be independent: each trial counts as one
            sample, which makes the bounds too wide rather than too narrow.
    """

    rmse_m: float
    rmse_x_m: float
    rmse_y_m: float
    max_m: float
    max_x_m: float
    max_y_m: float
    p95_m: float
    yaw_rmse_deg: float | None
    nees: float
    nees_bounds: tuple[float, float]
    update_us: UpdateTime
    bound_ratio: float | None
    iterations: float | None
    legs: dict[str, LegFigures]


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What came out of all trials.

    Attributes:
        scenario: its name.
        trials: how many.
        estimators: choice -> mean figures; None when it gave no pose at all in some trial.
        availability: choice -> share of the instants at which it gave a pose.
        paper: published figures of the scenario.
    """

    scenario: str
    trials: int
    estimators: dict[str, MeanFigures | None]
    availability: dict[str, float]
    paper: PaperTable | None

    def to_json(self) -> dict[str, Any]:
        """The figures as plain data, in the layout that other programs rely on."""
        figures = {name: asdict(mean) if mean else None for name, mean in self.estimators.items()}
        return {"scenario": self.scenario, "trials": self.trials, "estimators": figures}


def evaluate_scenario(
    path: Path,
    trials: int,
    seed: int | None = None,
    choices: Sequence[str] = DEFAULT_CHOICES,
    sets: Sequence[str] = (),
    workers: int = 1,
    on_trial: Callable[[], None] = lambda: None,
) -> Evaluation:
    """Run a scenario many times.

    Args:
        path: scenario file.
        trials: number of runs.
        seed: of the first; None for the scenario's own.
        choices: estimators NAME[:PARAM], `uwb_ls` (ranges alone) and `lidar` (increments alone).
        sets: `--set` assignments on the site's configuration.
        workers: processes to share the trials among; 1 runs them here.
        on_trial: called after each.

    Raises:
        UserError: a file, an assignment or a choice is wrong.
    """
    scenario = load_scenario(path, seed, list(sets))
    names = list(dict.fromkeys(choices))
    for choice in names:
        _check(choice, scenario.config)
    trial = partial(run_trial, path, sets=list(sets), choices=names)
    results = _run_all(trial, range(scenario.seed, scenario.seed + trials), workers, on_trial)
    by_name = {name: [result[name] for result in results] for name in names}
    return Evaluation(
        scenario=scenario.name,
        trials=trials,
        estimators={name: _mean(figures) for name, figures in by_name.items()},
        availability={
            name: float(np.mean([f.availability if f else 0.0 for f in figures]))
            for name, figures in by_name.items()
        },
        paper=scenario.file.paper,
    )


def _check(choice: str, config: Config) -> None:
    name, parameter = split_choice(choice)
    if name in ESTIMATORS:
        chosen_settings(config, choice, "--estimators")
    elif name not in (UWB_ALONE, LIDAR_ALONE):
        known = ", ".join([UWB_ALONE, LIDAR_ALONE, *ESTIMATORS])
        raise UserError(f"--estimators: unknown estimator {name!r}, there are: {known}")
    elif parameter is not None:
        raise UserError(f"--estimators {choice}: {name} takes no parameter, got {parameter!r}")


Trial = Callable[[int], dict[str, TrialFigures | None]]


def _run_all(
    trial: Trial, seeds: range, workers: int, on_trial: Callable[[], None]
) -> list[dict[str, TrialFigures | None]]:
    """Results in the order of the seeds."""
    if workers == 1:
        results = []
        for seed in seeds:
            results.append(trial(seed))
            on_trial()
        return results
    # Spawned, not forked: this process has threads, of the progress display for one.
    with ProcessPoolExecutor(min(workers, len(seeds)), get_context("spawn")) as pool:
        futures = [pool.submit(trial, seed) for seed in seeds]
        try:
            for future in as_completed(futures):
                future.result()
                on_trial()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
        return [future.result() for future in futures]


def _mean(results: list[TrialFigures | None]) -> MeanFigures | None:
    figures = [result for result in results if result is not None]
    if len(figures) < len(results):
        return None

    def mean(name: str) -> float:
        return float(np.mean([getattr(each, name) for each in figures]))

    def mean_if_known(name: str) -> float | None:
        return None if any(getattr(each, name) is None for each in figures) else mean(name)

    median, p99 = np.mean([each.update_us for each in figures], axis=0).tolist()
    return MeanFigures(
        **{name: mean(name) for name in _ALWAYS_KNOWN},
        yaw_rmse_deg=mean_if_known("yaw_rmse_deg"),
        nees_bounds=nees_bounds([each.nees_dof for each in figures]),
        update_us=UpdateTime(median, p99),
        bound_ratio=mean_if_known("bound_ratio"),
        iterations=mean_if_known("iterations"),
        legs=_mean_legs([each.legs for each in figures]),
    )


def _mean_legs(trials: list[dict[str, LegFigures]]) -> dict[str, LegFigures]:
    """Means over trials on the legs that every trial has figures for."""
    names = [name for name in trials[0] if all(name in legs for legs in trials)]
    return {
        name: LegFigures(
            rmse_m=float(np.mean([legs[name].rmse_m for legs in trials])),
            max_m=float(np.mean([legs[name].max_m for legs in trials])),
        )
        for name in names
    }


_ALWAYS_KNOWN = ("rmse_m", "rmse_x_m", "rmse_y_m", "max_m", "max_x_m", "max_y_m", "p95_m", "nees")


def nees_bounds(dofs: Sequence[int]) -> tuple[float, float]:
    """Two-sided bounds on a mean of independent NEES.

    Args:
        dofs: degrees of freedom of each, the expectation of its NEES.

    Source: Bar-Shalom et al., Estimation with Applications to Tracking and Navigation, 5.4.2: the sum of
    independent NEES is chi-square with the sum of their degrees of freedom.
    """
    tail = (1.0 - NEES_CONFIDENCE) / 2.0
    law = chi2(sum(dofs))
    return float(law.ppf(tail)) / len(dofs), float(law.ppf(1.0 - tail)) / len(dofs)
