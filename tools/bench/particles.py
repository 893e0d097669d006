"""Rows of the particle filters: 40 particles that search beside many that do not, on the same walks.

The walk is huang2024's square with six landmarks, where a likelihood is sharp and the motion prior wide:
there a plain filter needs many particles.
"""

from collections.abc import Callable, Sequence
from functools import cache, partial
from statistics import fmean

import numpy as np

from companion.shipped_files import params_dir
from companion.sim.measurements import measure as measured_walk
from companion.sim.measurements import setup_of
from companion.sim.scenario import load_scenario
from companion.trial import run_trial
from companion.trial_figures import TrialFigures
from companion.watched_choices import make_choice
from tools.bench.rows import Benchmark, Row, Run

OURS, RIVALS = "pf_ibas:40", ("pf:200", "pf:1000")
SCENARIO = params_dir() / "scenarios" / "huang2024_landmarks.toml"
SEEDS = range(1, 7)


def _time(rival: str) -> Benchmark:
    """Time of a measurement, whatever it is, over one walk."""
    scenario = load_scenario(SCENARIO, 1, [])
    measurements = list(measured_walk(scenario).in_order())
    start = scenario.trajectory.at(np.zeros(1)).pose[0]

    def run_of(choice: str) -> Run:
        def run() -> None:
            estimator = make_choice(scenario.config, setup_of(scenario), choice, start)
            for measurement in measurements:
                estimator.update(measurement)

        return run

    return Benchmark(
        "us/update", "lower", len(measurements) / 1e6, run_of(OURS), {f"our {rival}": run_of(rival)}
    )


def _rmse(rival: str) -> Row:
    """Error over some walks; its spread is that between walks, as a share of the mean."""
    ours, theirs = ([figures[choice].rmse_m for figures in _trials()] for choice in (OURS, rival))
    name = f"{_prefix(rival)}_rmse"
    spread = max((max(errors) - min(errors)) / fmean(errors) for errors in (ours, theirs))
    ratio = fmean(theirs) / fmean(ours)
    return Row(name, fmean(ours), fmean(theirs), f"our {rival}", ratio, "m", "lower", spread)


@cache
def _trials() -> Sequence[dict[str, TrialFigures]]:
    """Figures of all filters on the same walks."""
    trials = [run_trial(SCENARIO, seed, [], [OURS, *RIVALS]) for seed in SEEDS]
    return [{choice: figures for choice, figures in trial.items() if figures} for trial in trials]


def _prefix(rival: str) -> str:
    return f"{OURS}_vs_{rival}".replace(":", "_")


BENCHMARKS: dict[str, Callable[[], Benchmark]] = {
    f"{_prefix(rival)}_time": partial(_time, rival) for rival in RIVALS
}
"""Name of the row -> what makes its benchmark."""
ROWS: dict[str, Callable[[], Row]] = {f"{_prefix(rival)}_rmse": partial(_rmse, rival) for rival in RIVALS}
"""Name of the row -> what measures it."""
