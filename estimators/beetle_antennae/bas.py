"""Beetle antennae search (BAS): beetles that do not know of each other."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from estimators.beetle_antennae.base import (
    DECAY,
    FIRST_STEP,
    STEP_TO_ANTENNAE,
    BeetleSearch,
    Cost,
    sign_of_difference,
    unit,
)
from estimators.messages import FloatArray

_PAPER_ITERATIONS = 200
"""huang2024 section 3.1."""


@dataclass(frozen=True)
class PrintedBeetleAntennaeSearch(BeetleSearch):
    """BAS exactly as printed.

    It does not search. Eq. (12) takes the fitness of the difference of the two antennae, a point near the
    origin of the coordinates that says nothing about the sides; where fitness has one sign, all steps go one
    way. Eq. (8) draws from [0, 1], hence directions of one orthant.

    Args:
        step: length of the first step, in units of the scale.

    Source: huang2024 Eq. (8)-(14).
    """

    step: float = FIRST_STEP

    def evaluations_per_iteration(self, beetles: int) -> int:
        """The difference of the antennae, and the new place."""
        return 2 * beetles

    def _path(
        self, cost: Cost, beetles: FloatArray, iterations: int, rng: np.random.Generator
    ) -> Iterator[FloatArray]:
        cost.visit(beetles)
        yield beetles
        step = self.step
        distance = step / STEP_TO_ANTENNAE  # (11)
        for _ in range(iterations):
            direction = unit(rng.random(beetles.shape))  # (8)
            right = beetles - distance * direction / 2.0  # (9)
            left = beetles + distance * direction / 2.0  # (10)
            fitness = -cost.of(right - left)
            beetles = cost.inside(beetles + step * direction * np.sign(fitness)[:, None])  # (12)
            distance = DECAY * distance + 0.01  # (13)
            step = DECAY * step  # (14)
            cost.visit(beetles)
            yield beetles


@dataclass(frozen=True)
class BeetleAntennaeSearch(BeetleSearch):
    """BAS as it is meant.

    Corrections: Eq. (12) compares the costs at the two antennae; Eq. (8) draws from [-1, 1]; Eq. (14) lets
    the step lose over any number of iterations what it loses over the paper's 200, for otherwise more of
    them are of no use; the distance of the antennae stays in proportion to the step, Eq. (11), instead
    of ending at a constant, Eq. (13).

    Args:
        step: length of the first step, in units of the scale. The text under Eq. (12) wants it as large as
            the region to be searched.

    Source: huang2024 Eq. (8)-(14).
    """

    step: float = FIRST_STEP

    def evaluations_per_iteration(self, beetles: int) -> int:
        """Two antennae, and the new place."""
        return 3 * beetles

    def _path(
        self, cost: Cost, beetles: FloatArray, iterations: int, rng: np.random.Generator
    ) -> Iterator[FloatArray]:
        cost.visit(beetles)
        yield beetles
        for k in range(iterations):
            step = self.step * DECAY ** (_PAPER_ITERATIONS * k / iterations)  # (14)
            distance = step / STEP_TO_ANTENNAE  # (11)
            direction = unit(rng.uniform(-1.0, 1.0, beetles.shape))  # (8)
            right = cost.visit(cost.inside(beetles - distance * direction / 2.0))  # (9)
            left = cost.visit(cost.inside(beetles + distance * direction / 2.0))  # (10)
            beetles = cost.inside(beetles + step * direction * sign_of_difference(right, left))  # (12)
            cost.visit(beetles)
            yield beetles
