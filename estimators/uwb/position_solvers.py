"""Solvers of a position from ranges, in the plane or in space: closed form, gradient descent, momentum.

All of them look for the least mean squared range residual, ``J(p) = mean((|p - a_i| - d_i)^2)``; the closed
form comes near it, the descents reach it.
"""

from collections.abc import Callable

import numpy as np

from estimators.immutable import immutable
from estimators.messages import FloatArray

COPLANAR_LIMIT = 0.1
"""Least spread [m] of the anchors across their best-fit plane; below it above and below look the same."""


@immutable
class Solution:
    """Where a solver ended.

    Attributes:
        position: (D,) [m].
        iterations: steps that it took; 0 for a closed form.
    """

    position: FloatArray
    iterations: int


Solver = Callable[[FloatArray, FloatArray, FloatArray], Solution]
"""Anchors (N, D) [m], ranges (N,) [m], start (D,) [m] to a solution."""


def spans_space(anchors: FloatArray) -> bool:
    """Whether anchors (N, 3) [m] tell all three coordinates: four at least, not within one plane."""
    if len(anchors) < 4:
        return False
    local = anchors - anchors.mean(axis=0)
    return bool(np.abs(local @ np.linalg.svd(local)[2][2]).max() >= COPLANAR_LIMIT)


def closed_form(anchors: FloatArray, ranges: FloatArray) -> FloatArray:
    """Position that solves the differences of the squared ranges, which are linear in it.

    Args:
        anchors: (N, D) positions [m] that span the D dimensions.
        ranges: (N,) distances in these dimensions [m].

    Returns:
        (D,) [m].

    Source: li2022 Eq. (1)-(2), "least squares"; huang2024 Eq. (4).
    """
    centre = anchors.mean(axis=0)
    local = anchors - centre
    square = (local**2).sum(axis=1) - ranges**2
    solution, *_ = np.linalg.lstsq(2.0 * local, square - square.mean(), rcond=None)
    position: FloatArray = centre + solution
    return position


def unit_vectors(anchors: FloatArray, position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Directions (N, D) from anchors to a position, the derivatives of the distances (N,) [m]."""
    offset = position - anchors
    distance: FloatArray = np.maximum(np.sqrt(np.einsum("ni,ni->n", offset, offset)), 1e-9)
    return offset / distance[:, None], distance


def gradient_descent(step: float, tolerance: float, max_iterations: int) -> Solver:
    """Solver that goes down the gradient of J with a fixed step.

    The curvature of J is below 2 in any layout, so a step below 1 cannot swing up, and 0.5 is the largest
    that never overshoots.

    Args:
        step: factor of the gradient.
        tolerance: it ends where the gradient is smaller [m].
        max_iterations: it ends after so many steps in any case.

    Source: li2022, gradient descent on the mean squared error; step size and end chosen here.
    """

    def solve(anchors: FloatArray, ranges: FloatArray, start: FloatArray) -> Solution:
        position = start
        for iterations in range(max_iterations):
            units, distance = unit_vectors(anchors, position)
            gradient = (distance - ranges) @ units * (2.0 / len(ranges))
            if gradient @ gradient <= tolerance * tolerance:
                return Solution(position, iterations)
            position = position - step * gradient
        return Solution(position, max_iterations)

    return solve


def momentum_descent(memory: float, tolerance: float, max_iterations: int) -> Solver:
    """Solver that follows an exponentially weighted average of the gradients with a step of its own.

    The step is the one that ends in the lowest point along the averaged gradient of J with linear ranges.

    Args:
        memory: weight of the former average, the newest gradient has the rest.
        tolerance: it ends where the gradient is smaller [m].
        max_iterations: it ends after so many steps in any case.

    Source: li2022, improved momentum gradient descent: exponential weighting and variable step; the paper's
    formulas are lost, those here are ours.
    """

    def solve(anchors: FloatArray, ranges: FloatArray, start: FloatArray) -> Solution:
        position = start
        average = np.zeros_like(start)
        for iterations in range(max_iterations):
            units, distance = unit_vectors(anchors, position)
            gradient = (distance - ranges) @ units * (2.0 / len(ranges))
            if gradient @ gradient <= tolerance * tolerance:
                return Solution(position, iterations)
            average = memory * average + (1.0 - memory) * gradient
            if average @ gradient <= 0.0:  # the past leads uphill by now
                average = gradient
            change = units @ average
            curvature = 2.0 / len(ranges) * (change @ change)
            # Next to no curvature: the ranges say nothing along this direction.
            curvature = max(curvature, 1e-6 * (average @ average))
            position = position - (average @ gradient) / curvature * average
        return Solution(position, max_iterations)

    return solve
