"""Estimators over many trials of a scenario: mean errors, consistency, time, and distance from the bound.

Trial k has seed S + k for everything random in it: obstacles, start, gait and noise. Trials run in processes
of their own; how many there are changes no figure but the times.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from companion.alignment import Alignment
from companion.config import Config
from companion.errors import UserError
from companion.estimator_choice import chosen_settings, split_choice
from companion.evaluate import Errors
from companion.fault_trial import run_fault_trial
from companion.legs import LegFigures
from companion.log_edit.faults import parse_fault
from companion.log_trial import LOG_SUFFIX, log_config, run_log_trial
from companion.metrics import chi2_mean_bounds
from companion.range_score import pooled
from companion.run_folder import log_name
from companion.sim.scenario import load_scenario
from companion.sim.scenario_tables import PaperTable
from companion.trial import run_trial
from companion.trial_figures import TrialFigures
from companion.trial_runner import run_trials
from companion.watched_choices import LIDAR_ALONE, UWB_ALONE
from estimators import ESTIMATORS

DEFAULT_CHOICES = (UWB_ALONE, LIDAR_ALONE, "ekf")
SETTLED_IN_TIME = 5.0
"""A pose that had to be found is found in time within so much motion [s]."""


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
        ranges: what became of the ranges of all trials together, see `companion.range_score.pooled`; None
            when nobody knows which were blocked.
        nis_bounds: the same of `nis`; innovations of a consistent filter are independent, so each counts.
        first_fix_s: None when some trial never gave a pose that would be sent.
        integrity: of the trials that gave such poses; None when none did.
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
    ranges: dict[str, float | int | None] | None
    ate_m: float
    rpe_m: float | None
    rpe_deg: float | None
    nis: float | None
    nis_bounds: tuple[float, float] | None
    availability: float
    first_fix_s: float | None
    integrity: float | None
    epoch_bound_ratio: float | None
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
        settled: choice -> `TrialFigures.settled_s` of each trial; empty unless a pose had to be found.
        paper: published figures of the scenario.
        alignment: of the tracks, for `MeanFigures.ate_m`.
        seeds: of the trials.
        errors: choice -> errors of every trial in which it gave a pose, by seed.
        interrupted: whether trials are missing because the user ended them.
        config: of the site.
    """

    scenario: str
    trials: int
    estimators: dict[str, MeanFigures | None]
    availability: dict[str, float]
    settled: dict[str, list[float]]
    paper: PaperTable | None
    alignment: Alignment
    seeds: list[int]
    errors: dict[str, dict[int, Errors]]
    interrupted: bool
    config: Config

    @property
    def file_stem(self) -> str:
        """The name as part of a file's name."""
        return re.sub(r"[^\w.=-]+", "_", self.scenario)

    @property
    def decisive(self) -> str:
        """The choice whose worst trial is looked at: the site's own estimator, else the last one."""
        own = self.config.pipeline.estimator
        return own if own in self.estimators else list(self.estimators)[-1]

    def worst_seed(self) -> int:
        """Trial in which the decisive choice erred most (RMSE), or gave no pose at all."""
        errors = self.errors[self.decisive]
        without = [seed for seed in self.seeds if seed not in errors]
        if without:
            return without[0]
        return max(self.seeds, key=lambda seed: float((errors[seed].distance ** 2).mean()))

    def to_json(self) -> dict[str, Any]:
        """The figures as plain data, in the layout that other programs rely on."""
        figures = {name: asdict(mean) if mean else None for name, mean in self.estimators.items()}
        data = {
            "scenario": self.scenario,
            "trials": self.trials,
            "estimators": figures,
            "alignment": self.alignment,
        }
        if self.settled:
            data["settled"] = {name: self.settled_figures(name) for name in self.settled}
        return data

    def settled_figures(self, name: str) -> dict[str, float | None]:
        """In how many trials the pose was found in time, and the median time it took [s]; None: never."""
        median = float(np.median(self.settled[name]))
        return {
            "within_5_s": sum(seconds <= SETTLED_IN_TIME for seconds in self.settled[name]),
            "median_s": median if np.isfinite(median) else None,
        }


def evaluate_scenario(
    path: Path,
    trials: int,
    seed: int | None = None,
    choices: Sequence[str] = DEFAULT_CHOICES,
    sets: Sequence[str] = (),
    workers: int = 1,
    on_trial: Callable[[], None] = lambda: None,
    alignment: Alignment = Alignment.NONE,
    scheduler: str | None = None,
    faults: Sequence[str] = (),
) -> Evaluation:
    """Run a scenario many times, or a log once (with faults, many times).

    Args:
        path: scenario file, or log with truth.
        trials: number of runs of a scenario.
        seed: of the first; None for the scenario's own.
        choices: estimators NAME[:PARAM], `uwb_ls` (ranges alone) and `lidar` (increments alone).
        sets: `--set` assignments on the site's configuration.
        workers: processes to share the trials among; 1 runs them here.
        on_trial: called after each.
        alignment: of the tracks, for `MeanFigures.ate_m`.
        scheduler: address of a Dask scheduler, instead of processes here.
        faults: put into every trial, as the command line writes them.

    Raises:
        UserError: a file, a fault, an assignment, a choice or the address is wrong; or no trial was done
            before the user ended it.
    """
    names = list(dict.fromkeys(choices))
    if path.suffix == LOG_SUFFIX:
        config, name, paper, seeds = log_config(path, sets), log_name(path), None, range(1)
        trial: Trial = partial(run_log_trial, path, sets=list(sets), choices=names, alignment=alignment)
    else:
        scenario = load_scenario(path, seed, list(sets))
        config, name, paper = scenario.config, scenario.name, scenario.file.paper
        seeds = range(scenario.seed, scenario.seed + trials)
        trial = partial(run_trial, path, sets=list(sets), choices=names, alignment=alignment)
    for choice in names:
        _check(choice, config)
    for fault in faults:
        parse_fault(fault, config)
    if faults:
        first = seeds[0] if seed is None else seed
        seeds, name = range(first, first + trials), f"{name}, {' '.join(faults)}"
        trial = partial(
            run_fault_trial, path, sets=list(sets), choices=names, alignment=alignment, faults=list(faults)
        )
    done = run_trials(trial, seeds, workers, scheduler, on_trial)
    if not done:
        raise UserError("interrupted before the first trial was done")
    return summarised(name, done, names, paper, alignment, len(done) < len(seeds), config)


def summarised(
    scenario: str,
    done: dict[int, dict[str, TrialFigures | None]],
    names: Sequence[str],
    paper: PaperTable | None,
    alignment: Alignment,
    interrupted: bool,
    config: Config,
) -> Evaluation:
    """Means of what trials gave, by seed and choice; see `Evaluation`."""
    by_name = {name: [result[name] for result in done.values()] for name in names}
    is_sought = any(each and each.settled_s is not None for figures in by_name.values() for each in figures)
    return Evaluation(
        scenario=scenario,
        trials=len(done),
        estimators={name: _mean(figures) for name, figures in by_name.items()},
        availability={
            name: float(np.mean([f.availability if f else 0.0 for f in figures]))
            for name, figures in by_name.items()
        },
        settled={
            name: [each.settled_s if each and each.settled_s is not None else np.inf for each in figures]
            for name, figures in by_name.items()
            if is_sought
        },
        paper=paper,
        alignment=alignment,
        seeds=list(done),
        errors={
            name: {seed: f.errors for seed, f in zip(done, figures, strict=True) if f}
            for name, figures in by_name.items()
        },
        interrupted=interrupted,
        config=config,
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


def _mean(results: list[TrialFigures | None]) -> MeanFigures | None:
    figures = [result for result in results if result is not None]
    if len(figures) < len(results):
        return None

    def mean(name: str) -> float:
        return float(np.mean([getattr(each, name) for each in figures]))

    def mean_if_known(name: str) -> float | None:
        return None if any(getattr(each, name) is None for each in figures) else mean(name)

    median, p99 = np.mean([each.update_us for each in figures], axis=0).tolist()
    nis_count = sum(each.nis_count for each in figures)
    scores = [each.ranges for each in figures if each.ranges is not None]
    integrities = [each.integrity for each in figures if each.integrity is not None]
    return MeanFigures(
        **{name: mean(name) for name in _ALWAYS_KNOWN},
        yaw_rmse_deg=mean_if_known("yaw_rmse_deg"),
        nees_bounds=chi2_mean_bounds([each.nees_dof for each in figures]),
        update_us=UpdateTime(median, p99),
        bound_ratio=mean_if_known("bound_ratio"),
        ranges=pooled(scores) if scores else None,
        rpe_m=mean_if_known("rpe_m"),
        rpe_deg=mean_if_known("rpe_deg"),
        nis=mean_if_known("nis"),
        nis_bounds=chi2_mean_bounds([1] * nis_count) if nis_count else None,
        first_fix_s=mean_if_known("first_fix_s"),
        integrity=float(np.mean(integrities)) if integrities else None,
        epoch_bound_ratio=mean_if_known("epoch_bound_ratio"),
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


_ALWAYS_KNOWN = (
    "rmse_m",
    "rmse_x_m",
    "rmse_y_m",
    "max_m",
    "max_x_m",
    "max_y_m",
    "p95_m",
    "nees",
    "ate_m",
    "availability",
)
