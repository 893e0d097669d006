"""Where the match of a scan begins, and what comes out of it."""

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from estimators.immutable import immutable
from estimators.messages import FloatArray, IntArray

if TYPE_CHECKING:
    from estimators.lidar.line_map import LineMap, Surface

LEAST_INFORMATION = 1.0
"""Information [1/m^2, 1/rad^2] that every direction has: what nothing observes comes out with sigma 1."""
UNKNOWN_SPEED_SIGMA = 1.0
"""Standard deviation of each velocity [m/s, rad/s] before a scan was matched."""
MOST_STEPS = np.array([3, 3, 20])
"""So many steps are searched at most to either side along x, y and in yaw."""
CLEARLY_BETTER = 1.25
"""A start must fit so many times better than the predicted one to be taken in its place."""
STARTING_POINTS = 100
"""With about so many points the start of a match is looked for."""
NEWEST = np.arange(6, 9)
"""Where in both states (12,) the newer pose is: pose and velocity before, pose and velocity now."""


@immutable
class Fit:
    """A scan in place.

    Attributes:
        states: (12,) pose and velocity at the end of the scan before, and at the end of this one.
        cov: (6, 6) of the newer pose and velocity, the prior included.
        held: (3, 3) projection of a change of the pose on what walls hold.
        increment: (3,) newer pose without what the motion model added.
        increment_cov: (3, 3) of it.
        share: of the surface points that are matched.
        rows: (N, 6) of the surface points, as `LineMap.match` gives them.
        index: (N,) likewise.
    """

    states: FloatArray
    cov: FloatArray
    held: FloatArray
    increment: FloatArray
    increment_cov: FloatArray
    share: float
    rows: FloatArray
    index: IntArray


def search_start(
    keyframe: "LineMap",
    found: "Surface",
    basis: FloatArray,
    predicted: FloatArray,
    doubt: FloatArray,
    dt: float,
    greatest: float,
    reach: float,
) -> FloatArray:
    """States (12,) near which a match is looked for: the predicted ones, or what fits best round about.

    The search covers twice the doubt of the prediction in steps as wide as a point may be off. With many
    scans a second, and walls near by, there is nothing to search.

    Args:
        keyframe: to match against.
        found: surface points of the scan.
        basis: (N, 4) their weights of the states.
        predicted: (12,) states.
        doubt: (3,) standard deviations of the newer pose.
        dt: time between the states [s].
        greatest: distance of a point from the body [m].
        reach: how far a point may be off [m].

    Source: Olson, "Real-time correlative scan matching", ICRA 2009.
    """
    if 2.0 * max(doubt[0], doubt[1], doubt[2] * max(greatest, reach)) < reach:
        return predicted
    distances = np.hypot(found.points[:, 0], found.points[:, 1])
    most = 3 * len(distances) // 4
    far = float(np.partition(distances, most)[most])
    steps = reach / np.array([1.0, 1.0, max(far, reach)])
    x, y, yaw = np.minimum(2.0 * doubt // steps, MOST_STEPS).astype(int)
    if not (x or y or yaw):
        return predicted
    thin = slice(None, None, -(-len(basis) // STARTING_POINTS))
    points, normals, few = (
        np.ascontiguousarray(column[thin]) for column in (found.points, found.normals, basis)
    )
    best, best_score = predicted, 0.0
    for offset in sorted(product(range(-x, x + 1), range(-y, y + 1), range(-yaw, yaw + 1)), key=_size):
        states = predicted.copy()
        states[NEWEST] += steps * offset
        # The acceleration that leads there is constant.
        states[9:] += steps * offset * (2.0 / dt)
        rows, index = keyframe.match(points, normals, few, states)
        score = float((1.0 / (1.0 + (rows[index >= 0, 0] * (4.0 / reach)) ** 2)).sum())
        # The prediction comes first: only what fits clearly better is taken, so nothing slides along a wall.
        if score > best_score * (CLEARLY_BETTER if best is predicted else 1.0):
            best, best_score = states if any(offset) else predicted, score
    return best


def _size(offset: tuple[int, int, int]) -> int:
    return sum(step * step for step in offset)
