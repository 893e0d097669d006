"""Gauss-Newton on the states at both ends of a scan, and what of its result the scan alone says."""

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from estimators.geometry import wrap_angle
from estimators.messages import FloatArray

if TYPE_CHECKING:
    from estimators.lidar.line_map import LineMap, Surface

HELD_RATIO = 5.0
"""Walls hold a direction when a scan says so many times more of it than noise of the normals feigns."""
LEAST_INFORMATION = 1.0
"""Information [1/m^2, 1/rad^2] that every direction has: what nothing observes comes out with sigma 1."""
UNKNOWN_SPEED_SIGMA = 1.0
"""Standard deviation of each velocity [m/s, rad/s] before a scan was matched."""
LEAST_MATCHED = 10
"""With fewer matched points there is no match."""
CONVERGED = 1e-4
"""A step of the pose that is smaller [m, rad] is the last."""
MOST_ITERATIONS = 20
MOST_STEPS = np.array([3, 3, 20])
"""So many steps are searched at most to either side along x, y and in yaw."""
CLEARLY_BETTER = 1.25
"""A start must fit so many times better than the predicted one to be taken in its place."""
STARTING_POINTS = 100
"""With about so many points the start of a match is looked for."""
NEWEST = np.arange(6, 9)
"""Where in both states (12,) the newer pose is: pose and velocity before, pose and velocity now."""

_OTHERS = np.delete(np.arange(12), NEWEST)


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A scan in place.

    Attributes:
        states: (12,) pose and velocity at the end of the scan before, and at the end of this one.
        information: (12, 12) inverse of their covariance, the prior's included.
        held: (3, 3) projection of a change of the pose on what walls hold.
        keyframe_cov: (3, 3) share of the map's own noise in the covariance of the newer pose.
        share: of the surface points that are matched.
    """

    states: FloatArray
    information: FloatArray
    held: FloatArray
    keyframe_cov: FloatArray
    share: float


def search_start(
    keyframe: "LineMap",
    found: "Surface",
    basis: FloatArray,
    predicted: FloatArray,
    doubt: FloatArray,
    dt: float,
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
        reach: how far a point may be off [m].

    Source: Olson, "Real-time correlative scan matching", ICRA 2009.
    """
    if not len(found.points):
        return predicted
    far = float(np.percentile(np.hypot(found.points[:, 0], found.points[:, 1]), 75))
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


def settle(
    keyframe: "LineMap",
    found: "Surface",
    basis: FloatArray,
    prior: FloatArray,
    predicted: FloatArray,
    start: FloatArray,
    sigma: float,
    spread: float,
) -> Fit | None:
    """Minimise the distances of surface points from their lines and the deviation from the prediction.

    Args:
        keyframe: to match against.
        found: surface points of the scan.
        basis: (N, 4) their weights of the states.
        prior: (12, 12) information on the states beforehand.
        predicted: (12,) states beforehand.
        start: (12,) states to begin with.
        sigma: least standard deviation of a distance [m].
        spread: how far points may be off at the start [m]; at first nothing nearer is taken for an outlier.

    Returns:
        The fit; None when hardly a point is near a line.

    Source: Yang et al., "Graduated non-convexity for robust spatial perception", RA-L 2020, for the spread.
    """
    states = start
    for _ in range(MOST_ITERATIONS):
        rows, index = keyframe.match(found.points, found.normals, basis, states)
        distances = np.abs(rows[index >= 0, 0])
        if len(distances) < LEAST_MATCHED:
            return None
        # Cauchy weight; its scale is the noise of two scans, or what the distances say when larger.
        middle = len(distances) // 2
        scale = max(2.0 * sigma, 1.5 * float(np.partition(distances, middle)[middle]))
        sums = keyframe.sums(basis, rows, index, max(scale, spread))
        held = held_directions(sums.pose_hessian, sums.feigned)
        of_all = np.zeros((12, 12))
        for k in range(0, 12, 3):
            of_all[k : k + 3, k : k + 3] = held
        # Half of the squares is noise of the keyframe, which does not average out from scan to scan.
        variance = max(sigma**2, 0.5 * sums.squares / sums.weight)
        information = prior + of_all @ sums.hessian @ of_all / variance
        gradient = of_all @ sums.gradient / variance + prior @ (states - predicted)
        # What nothing holds goes on as predicted; else the least doubt of its direction would move it.
        step = of_all @ np.linalg.solve(information, -gradient)
        states = states + step
        if float(np.abs(step[NEWEST]).max()) < CONVERGED and spread <= scale:
            break
        spread *= 0.5
    gain = np.linalg.pinv(held @ sums.pose_hessian @ held, rcond=1e-9, hermitian=True)
    keyframe_cov = variance * gain @ keyframe.gradient_noise(sums.by_line) @ gain
    return Fit(states, information, held, keyframe_cov, len(distances) / len(found.points))


def said_by_scan(prior: FloatArray, predicted: FloatArray, fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Newer pose (3,) and its covariance (3, 3) without what the motion model added.

    Args:
        prior: (12, 12) information on the states beforehand.
        predicted: (12,) states beforehand.
        fit: what they became.

    Source: Bar-Shalom et al., Tracking and Data Fusion, 9.5: tracklets by decorrelation.
    """
    expected, known = _marginal(prior), _marginal(fit.information)
    # What walls hold tells of the rest by what the motion model thinks of both: that is not the scan's.
    gained = fit.held @ (known - expected) @ fit.held
    cov = np.asarray(np.linalg.inv(gained + LEAST_INFORMATION * np.eye(3)), dtype=np.float64)
    correction = cov @ known @ (fit.states[NEWEST] - predicted[NEWEST])
    pose = predicted[NEWEST] + correction @ fit.held
    pose[2] = wrap_angle(pose[2])
    return pose, cov + fit.keyframe_cov


def held_directions(pose_hessian: FloatArray, feigned: FloatArray) -> FloatArray:
    """Projection (3, 3) of a change of the pose [m, rad] on what walls hold.

    Along a bare corridor the information is not zero: normals are noisy, so every line seems to hold a
    little. How much that is on average is known; a direction with hardly more than that is held by nothing.

    Args:
        pose_hessian: (3, 3) by the pose, for distances of unit variance.
        feigned: (3, 3) share of it that noise of the normals has on average.

    Source: after Zhang, Kaess and Singh, "On degeneracy of optimization-based state estimation problems",
    ICRA 2016; here noise is the measure.
    """
    root = np.linalg.cholesky(feigned + 1e-9 * np.trace(feigned) * np.eye(3))
    half = np.linalg.solve(root, pose_hessian)
    values, vectors = np.linalg.eigh(np.linalg.solve(root, half.T))
    if values[0] > HELD_RATIO:
        return np.eye(3)
    free, _ = np.linalg.qr(np.linalg.solve(root.T, vectors[:, values <= HELD_RATIO]))
    held: FloatArray = np.eye(3) - free @ free.T
    return held


def _marginal(information: FloatArray) -> FloatArray:
    """Information (3, 3) on the newest pose in that on both states (12, 12)."""
    across = information[np.ix_(_OTHERS, NEWEST)]
    others = np.linalg.solve(information[np.ix_(_OTHERS, _OTHERS)], across)
    own: FloatArray = information[np.ix_(NEWEST, NEWEST)] - across.T @ others
    return own
