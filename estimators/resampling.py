"""Resampling of weighted particles."""

from collections.abc import Callable

import numpy as np

from estimators.messages import FloatArray, IntArray


def systematic(weights: FloatArray, rng: np.random.Generator) -> IntArray:
    """Particles to keep, by equally spaced points with one random offset.

    Args:
        weights: (N,) that sum to one.
        rng: source of the offset.

    Returns:
        (N,) indices, ascending; each occurs N times its weight, rounded up or down.

    Source: Kitagawa, J. Computational and Graphical Statistics 5(1), 1996.
    """
    return _indices(weights, np.full(len(weights), rng.random()))


def stratified(weights: FloatArray, rng: np.random.Generator) -> IntArray:
    """Particles to keep, by one random point in each of N equal shares.

    Args:
        weights: (N,) that sum to one.
        rng: source of the points.

    Returns:
        (N,) indices, ascending.

    Source: Kitagawa, J. Computational and Graphical Statistics 5(1), 1996; li2022, layered random resampling.
    """
    return _indices(weights, rng.random(len(weights)))


def _indices(weights: FloatArray, offsets: FloatArray) -> IntArray:
    count = len(weights)
    cumulated = np.cumsum(weights)
    # Rounding must not leave the last point beyond the sum.
    indices = np.searchsorted(cumulated, (np.arange(count) + offsets) * (cumulated[-1] / count), side="right")
    return np.asarray(np.minimum(indices, count - 1), dtype=np.int64)


RESAMPLING: dict[str, Callable[[FloatArray, np.random.Generator], IntArray]] = {
    "systematic": systematic,
    "stratified": stratified,
}
"""Name in a configuration -> method."""
