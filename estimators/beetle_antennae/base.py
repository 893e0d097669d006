"""What every beetle antennae search offers, and the cost as the beetles sense it."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import TypeAlias

import numpy as np

from estimators.immutable import immutable
from estimators.messages import FloatArray

Objective: TypeAlias = Callable[[FloatArray], FloatArray]
"""Cost (n,) of points (n, dim). NaN says that a point has none; such a point is never the best."""

Bounds: TypeAlias = tuple[FloatArray | float, FloatArray | float]
"""Lowest and highest coordinates, (dim,) or one for all."""

FIRST_STEP = 5.0
"""Length of the first step, huang2024 section 3.1."""

DECAY = 0.95
"""delta_e of Eq. (14), huang2024 section 3.1; also d_T of Eq. (13), for which the paper gives no value."""

STEP_TO_ANTENNAE = 5.0
"""c of Eq. (11). huang2024 gives none; programs of BAS use this."""


@immutable
class Found:
    """What a search found.

    Attributes:
        point: (dim,) the best point; the first beetle's start when no point has a cost.
        value: its cost; infinite when no point has one.
        beetles: (n, dim) where the beetles are after the last iteration.
        evaluations: number of points whose cost was asked.
        history: (iterations + 1,) least cost so far, at the start and after each iteration.
    """

    point: FloatArray
    value: float
    beetles: FloatArray
    evaluations: int
    history: FloatArray


class BeetleSearch(ABC):
    """A way of searching; it holds settings and no state."""

    def search(
        self,
        objective: Objective,
        start: FloatArray,
        iterations: int,
        rng: np.random.Generator,
        scale: FloatArray | float = 1.0,
        bounds: Bounds | None = None,
    ) -> Found:
        """Look for the point of least cost.

        Args:
            objective: the cost; asked for all beetles at once.
            start: (n, dim) where the beetles start.
            iterations: moves of each beetle.
            rng: source of all randomness.
            scale: (dim,) or one for all, the length along each axis that counts as one. Directions are drawn
                and steps are made in these units, so that metres and radians do not mix.
            bounds: no point outside is tried.
        """
        cost = Cost(objective, np.asarray(scale, dtype=np.float64), bounds)
        first = beetles = cost.inside(start / cost.scale)
        history = []
        for moved in self._path(cost, first, iterations, rng):
            beetles = moved
            history.append(cost.least)
        best = first[0] if cost.best is None else cost.best
        return Found(cost.place(best), cost.least, cost.place(beetles), cost.evaluations, np.array(history))

    @abstractmethod
    def evaluations_per_iteration(self, beetles: int) -> int:
        """Points whose cost is asked in one iteration; before the first one, the start is asked."""

    @abstractmethod
    def _path(
        self, cost: "Cost", beetles: FloatArray, iterations: int, rng: np.random.Generator
    ) -> Iterator[FloatArray]:
        """Beetles (n, dim) in scaled coordinates: where they start, and after each iteration."""


class Cost:
    """The objective in scaled coordinates: kept within bounds, counted, its best point remembered.

    Args:
        objective: in its own coordinates.
        scale: (dim,) or (), the length along each axis that counts as one.
        bounds: in the objective's coordinates.
    """

    def __init__(self, objective: Objective, scale: FloatArray, bounds: Bounds | None) -> None:
        self._objective, self._bounds = objective, bounds
        self.scale = scale
        self.evaluations = 0
        self.least = np.inf
        self.best: FloatArray | None = None

    def place(self, points: FloatArray) -> FloatArray:
        """Points (..., dim) in the objective's coordinates."""
        placed: FloatArray = points * self.scale
        if self._bounds is None:
            return placed
        return np.minimum(np.maximum(placed, self._bounds[0]), self._bounds[1])

    def inside(self, points: FloatArray) -> FloatArray:
        """Points (..., dim), those out of bounds moved onto them."""
        return points if self._bounds is None else self.place(points) / self.scale

    def of(self, points: FloatArray) -> FloatArray:
        """Costs (n,) of points (n, dim); infinite where there is none."""
        values = np.asarray(self._objective(self.place(points)), dtype=np.float64)
        self.evaluations += len(values)
        return np.where(np.isnan(values), np.inf, values)

    def visit(self, points: FloatArray) -> FloatArray:
        """Costs (n,) of points (n, dim), any of which may be what the search finds."""
        values = self.of(points)
        i = values.argmin()
        if values[i] < self.least:
            self.least, self.best = float(values[i]), points[i].copy()
        return values


def unit(vectors: FloatArray) -> FloatArray:
    """Vectors (n, dim) of length one; those without length stay as they are."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


def sign_of_difference(minuend: FloatArray, subtrahend: FloatArray) -> FloatArray:
    """Column (n, 1) of -1, 0 and 1; 0 where both are infinite."""
    return np.asarray((minuend > subtrahend) * 1.0 - (minuend < subtrahend) * 1.0)[:, None]
