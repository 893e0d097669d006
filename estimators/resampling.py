"""Resampling of weighted particles."""

from collections.abc import Callable

import numpy as np

from estimators.messages import FloatArray, IntArray


def systematic(weights: FloatArray, count: int, rng: np.random.Generator) -> IntArray:
    """Particles to keep, by equally spaced points with one random offset.

    Args:
        weights: (N,) that sum to one.
        count: how many to choose.
        rng: source of the offset.

    Returns:
        (count,) indices, ascending; each occurs `count` times its weight, rounded up or down.

    Source: Kitagawa, J. Computational and Graphical Statistics 5(1), 1996.
    """
    return _indices(weights, np.full(count, rng.random()))


def stratified(weights: FloatArray, count: int, rng: np.random.Generator) -> IntArray:
    """Particles to keep, by one random point in each of equal shares.

    Args:
        weights: (N,) that sum to one.
        count: how many to choose.
        rng: source of the points.

    Returns:
        (count,) indices, ascending.

    Source: Kitagawa, J. Computational and Graphical Statistics 5(1), 1996; li2022, layered random resampling.
    """
    return _indices(weights, rng.random(count))


def _indices(weights: FloatArray, offsets: FloatArray) -> IntArray:
    count = len(offsets)
    cumulated = np.cumsum(weights)
    points = (np.arange(count) + offsets) * (cumulated[-1] / count)
    # Rounding must not leave the last point beyond the sum.
    indices = np.minimum(np.searchsorted(cumulated, points, side="right"), len(weights) - 1)
    return np.asarray(indices, dtype=np.int64)


RESAMPLING: dict[str, Callable[[FloatArray, int, np.random.Generator], IntArray]] = {
    "systematic": systematic,
    "stratified": stratified,
}
"""Name in a configuration -> method."""
