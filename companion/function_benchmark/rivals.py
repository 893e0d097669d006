"""PSO, GA and BA from public libraries (extra `bench`), with the settings of huang2024 section 3.1."""

from collections.abc import Callable
from importlib.util import find_spec
from typing import TypeAlias

import numpy as np

from estimators.messages import FloatArray

Cost: TypeAlias = Callable[[FloatArray], FloatArray]

_VELOCITY_LIMIT = 0.05
"""Largest velocity of PSO as a share of the half range. The paper gives none, but with its weight of 1 the
swarm flies apart without; of 0.05, 0.1, 0.2, 0.3 and none this is best on all but one function."""

_LOUDNESS = 1.5
"""Loudness of BA at the start: the middle of the paper's 1 to 2, for the library has one for all bats."""


def missing() -> list[str]:
    """Libraries that are not installed."""
    return [library for library in ("niapy", "pygad") if find_spec(library) is None]


def particle_swarm(
    cost: Cost, start: FloatArray, half_range: float, evaluations: int, seed: int
) -> FloatArray:
    """PSO: c1 = c2 = 2, w = 1.

    Args:
        cost: values (n,) of points (n, dim).
        start: (n, dim) first population.
        half_range: each coordinate is between minus and plus this.
        evaluations: points whose cost is asked.
        seed: of the library's generator.

    Returns:
        (evaluations,) least cost so far after each evaluation.

    Source: huang2024 section 3.1.
    """
    from niapy.algorithms.basic import ParticleSwarmAlgorithm
    from niapy.util.repair import limit

    swarm = ParticleSwarmAlgorithm(
        len(start),
        c1=2.0,
        c2=2.0,
        w=1.0,
        min_velocity=-_VELOCITY_LIMIT * half_range,
        max_velocity=_VELOCITY_LIMIT * half_range,
        repair=limit,
        seed=seed,
    )
    return _run_niapy(swarm, cost, start, half_range, evaluations)


def bats(cost: Cost, start: FloatArray, half_range: float, evaluations: int, seed: int) -> FloatArray:
    """BA: alpha 0.85, beta 0.9 (gamma of the pulse rate), frequency 0 to 1.

    Args and return value are those of `particle_swarm`.

    Source: huang2024 section 3.1; Yang, A new metaheuristic bat-inspired algorithm (2010).
    """
    from niapy.algorithms.basic import BatAlgorithm

    swarm = BatAlgorithm(
        len(start),
        loudness=_LOUDNESS,
        alpha=0.85,
        gamma=0.9,
        min_frequency=0.0,
        max_frequency=1.0,
        seed=seed,
    )
    return _run_niapy(swarm, cost, start, half_range, evaluations)


def _run_niapy(
    algorithm: object, cost: Cost, start: FloatArray, half_range: float, evaluations: int
) -> FloatArray:
    from niapy.problems import Problem
    from niapy.task import Task

    recorder = _Recorder(cost)

    class OneProblem(Problem):  # type: ignore[misc]
        def _evaluate(self, x: FloatArray) -> float:
            return float(recorder(x[None, :])[0])

    algorithm.initialization_function = lambda task, **_: (  # type: ignore[attr-defined]
        start.copy(),
        np.array([task.eval(point) for point in start]),
    )
    problem = OneProblem(start.shape[1], -half_range, half_range)
    algorithm.run(Task(problem, max_evals=evaluations))  # type: ignore[attr-defined]
    return recorder.history(evaluations)


def genetic(cost: Cost, start: FloatArray, half_range: float, evaluations: int, seed: int) -> FloatArray:
    """GA: crossover (CR) 0.8, mutation (F) 0.05 of the genes; tournaments of 3, uniform crossover, one elite.

    Args and return value are those of `particle_swarm`.

    Source: huang2024 section 3.1, which does not name the operators.
    """
    import pygad

    recorder = _Recorder(cost)

    def fitness(_: object, population: FloatArray, __: object) -> list[float]:
        return [-value for value in recorder(np.asarray(population)).tolist()]

    # Known points are not asked again, so the number of generations is not known beforehand.
    pygad.GA(
        num_generations=evaluations,
        on_generation=lambda _: "stop" if recorder.evaluations >= evaluations else None,
        initial_population=start,
        num_parents_mating=len(start) // 2,
        parent_selection_type="tournament",
        crossover_type="uniform",
        crossover_probability=0.8,
        mutation_type="random",
        mutation_probability=0.05,
        mutation_by_replacement=True,
        random_mutation_min_val=-half_range,
        random_mutation_max_val=half_range,
        keep_elitism=1,
        fitness_func=fitness,
        fitness_batch_size=len(start),
        random_seed=seed,
        suppress_warnings=True,
    ).run()
    return recorder.history(evaluations)


RIVALS = {"pso": particle_swarm, "ga": genetic, "ba": bats}


class _Recorder:
    """A cost that remembers every value it gave."""

    def __init__(self, cost: Cost) -> None:
        self._cost = cost
        self._values: list[FloatArray] = []
        self.evaluations = 0

    def __call__(self, points: FloatArray) -> FloatArray:
        values = self._cost(points)
        self.evaluations += len(values)
        self._values.append(values)
        return values

    def history(self, evaluations: int) -> FloatArray:
        """Least cost so far after each of the first evaluations."""
        values: FloatArray = np.concatenate(self._values)[:evaluations]
        return np.minimum.accumulate(values)
