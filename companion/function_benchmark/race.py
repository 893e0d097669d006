"""Runs of all algorithms on all functions, and what comes out on average."""

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from enum import StrEnum
from itertools import product
from time import process_time
from typing import Any

import numpy as np

from companion.function_benchmark.functions import DIMENSIONS, FUNCTIONS, ITERATIONS, PAPER, POPULATION
from companion.function_benchmark.rivals import RIVALS
from estimators.beetle_antennae import SEARCHES, BeetleAntennaeSearch
from estimators.immutable import immutable
from estimators.messages import FloatArray

EVALUATIONS = POPULATION * ITERATIONS
"""What every algorithm may ask of a shifted function, and PSO, GA and BA always."""

SAMPLES = 201
"""Instants of a run at which the least cost so far is kept."""

_SHIFT = 0.8
"""Share of the range in which the optimum of a shifted function is, so that it is not at its edge."""


class Setting(StrEnum):
    """How a function is posed."""

    ORIGINAL = "original"
    """As in the paper: optimum in the origin, 200 iterations of each algorithm, however much they ask."""
    SHIFTED = "shifted"
    """Optimum in a random place, another one in each run; equal numbers of evaluations."""


CONTENDERS = {
    "bas_printed": "BAS",
    "bas": "BAS",
    "bas_range": "BAS",
    "ibas_printed": "IBAS",
    "ibas_prose": "IBAS",
    "ibas": "IBAS",
    "pso": "PSO",
    "ga": "GA",
    "ba": "BA",
}
"""Name -> algorithm of the paper. `bas_range` is `bas` with a first step as large as the half range."""

PAPER_SETTINGS = ("bas", "ibas", "pso", "ga", "ba")
"""The five algorithms of the paper, the beetles' equations corrected, with the settings it names."""


@immutable
class Run:
    """One run of one algorithm.

    Attributes:
        history: (SAMPLES,) least cost so far, evenly over the run.
        evaluations: points whose cost was asked.
        seconds: time of the processor.
    """

    history: FloatArray
    evaluations: int
    seconds: float


@immutable
class Outcome:
    """Several runs of one algorithm on one function.

    Attributes:
        mean: of the least costs.
        std: their standard deviation.
        seconds: of one run, on average.
        evaluations: of one run.
        history: (SAMPLES,) mean over the runs of the least cost so far.
    """

    mean: float
    std: float
    seconds: float
    evaluations: int
    history: FloatArray


@immutable
class Race:
    """All outcomes.

    Attributes:
        trials: runs of each algorithm on each function.
        seed: of all randomness.
        outcomes: setting -> contender -> function -> outcome.
    """

    trials: int
    seed: int
    outcomes: dict[Setting, dict[str, dict[str, Outcome]]]

    def best(self, setting: Setting, contenders: tuple[str, ...] = tuple(CONTENDERS)) -> dict[str, str]:
        """The contender with the least mean on each function, among those that ran."""
        there = {name: row for name, row in self.outcomes[setting].items() if name in contenders}
        return {f: min(there, key=lambda name: there[name][f].mean) for f in FUNCTIONS}

    def to_json(self) -> dict[str, Any]:
        """The figures, those of the paper beside them, without the histories."""
        return {
            "trials": self.trials,
            "seed": self.seed,
            "dimensions": DIMENSIONS,
            "population": POPULATION,
            "best_of_paper_settings_shifted": self.best(Setting.SHIFTED, PAPER_SETTINGS),
            "best_of_all_shifted": self.best(Setting.SHIFTED),
            "paper": {name: {f: entry._asdict() for f, entry in row.items()} for name, row in PAPER.items()},
            **{
                setting: {
                    name: {
                        f: {
                            "mean": outcome.mean,
                            "std": outcome.std,
                            "seconds": outcome.seconds,
                            "evaluations": outcome.evaluations,
                        }
                        for f, outcome in row.items()
                    }
                    for name, row in rows.items()
                }
                for setting, rows in self.outcomes.items()
            },
        }


def run_once(setting: Setting, contender: str, function: str, seed: int, trial: int) -> Run:
    """One run; all contenders get the same optimum and the same first population in a trial.

    Args:
        setting: how the function is posed.
        contender: key of `CONTENDERS`.
        function: key of `FUNCTIONS`.
        seed: of the race.
        trial: number of the run.
    """
    problem = FUNCTIONS[function]
    half_range = problem.half_range
    draw = np.random.default_rng([seed, trial])
    start = draw.uniform(-half_range, half_range, (POPULATION, DIMENSIONS))
    optimum = draw.uniform(-_SHIFT * half_range, _SHIFT * half_range, DIMENSIONS)
    if setting is Setting.ORIGINAL:
        optimum[:] = 0.0

    def cost(points: FloatArray) -> FloatArray:
        return problem.cost(points - optimum)

    if contender in RIVALS:
        begin = process_time()
        history = RIVALS[contender](cost, start, half_range, EVALUATIONS, int(draw.integers(2**31)))
        return Run(_sampled(history), len(history), process_time() - begin)
    in_range = contender == "bas_range"
    search = BeetleAntennaeSearch(step=half_range) if in_range else SEARCHES[contender]()
    if CONTENDERS[contender] == "BAS":
        start = start[:1]
    iterations = ITERATIONS
    if setting is Setting.SHIFTED:
        iterations = (EVALUATIONS - len(start)) // search.evaluations_per_iteration(len(start))
    begin = process_time()
    found = search.search(cost, start, iterations, draw, bounds=(-half_range, half_range))
    return Run(_sampled(found.history), found.evaluations, process_time() - begin)


def _sampled(history: FloatArray) -> FloatArray:
    return history[np.linspace(0, len(history) - 1, SAMPLES).round().astype(np.int64)]


def run_race(
    contenders: list[str], trials: int, seed: int, processes: int, on_run: Callable[[], None]
) -> Race:
    """Let contenders run on all functions in both settings.

    Args:
        contenders: keys of `CONTENDERS`.
        trials: runs of each.
        seed: the same seed gives the same costs.
        processes: how many run at a time.
        on_run: called after each run.
    """
    cases = list(product(Setting, contenders, FUNCTIONS))
    jobs = [(*case, seed, trial) for case in cases for trial in range(trials)]
    runs = []
    # A process started afresh: a copy of one with the thread of a progress bar may hang.
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        for run in pool.map(run_once, *zip(*jobs, strict=True), chunksize=4):
            runs.append(run)
            on_run()
    outcomes: dict[Setting, dict[str, dict[str, Outcome]]] = {
        setting: {name: {} for name in contenders} for setting in Setting
    }
    for i, (setting, name, function) in enumerate(cases):
        outcomes[setting][name][function] = _outcome(runs[i * trials : (i + 1) * trials])
    return Race(trials, seed, outcomes)


def _outcome(runs: list[Run]) -> Outcome:
    histories = np.array([run.history for run in runs])
    least = histories[:, -1]
    return Outcome(
        mean=float(least.mean()),
        std=float(least.std(ddof=1)),
        seconds=float(np.mean([run.seconds for run in runs])),
        evaluations=runs[0].evaluations,
        history=histories.mean(axis=0),
    )
