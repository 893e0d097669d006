"""Figures of a track against truth: trajectory error, drift, integrity.

Source: Zhang and Scaramuzza, "A Tutorial on Quantitative Trajectory Evaluation for Visual(-Inertial)
Odometry", IROS 2018, for the errors and alignments.
"""

from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2

from companion.alignment import Alignment
from companion.evaluate import Errors
from estimators.geometry import compose, inverse, wrap_angle
from estimators.messages import FloatArray, IntArray

RPE_DISTANCE = 1.0
"""Drift is measured over stretches of this length [m]."""
THREE_SIGMA = 0.9973
"""Share of a normal law within three standard deviations."""
NEES_CONFIDENCE = 0.95


def alignment_of(poses: FloatArray, truth: FloatArray, alignment: Alignment) -> FloatArray:
    """Motion that brings a track onto the truth.

    Args:
        poses: (N, 3) estimated x [m], y [m], yaw [rad], N >= 1.
        truth: (N, 3) the same, true; its yaw matters to `FIRST_POSE` alone.
        alignment: what may be moved.

    Returns:
        (3,) x [m], y [m], yaw [rad]; aligned poses are this composed with the estimated ones.

    Source: Umeyama, IEEE Trans. PAMI 13(4), 1991, Eq. (34)-(43), in the plane and without scale.
    """
    if alignment is Alignment.NONE:
        return np.zeros(3)
    if alignment is Alignment.FIRST_POSE:
        return compose(truth[0], inverse(poses[0]))
    mean_pose, mean_truth = poses[:, :2].mean(axis=0), truth[:, :2].mean(axis=0)
    x, y = (poses[:, :2] - mean_pose).T
    true_x, true_y = (truth[:, :2] - mean_truth).T
    yaw = float(np.arctan2((x * true_y - y * true_x).sum(), (x * true_x + y * true_y).sum()))
    turned = compose(np.array([0.0, 0.0, yaw]), np.array([*mean_pose, 0.0]))
    return np.array([*(mean_truth - turned[:2]), yaw])


def trajectory_error(errors: Errors, alignment: Alignment) -> float:
    """Absolute trajectory error: root mean square of the horizontal distance after alignment [m]."""
    x, y, yaw = alignment_of(errors.pose, errors.truth, alignment)
    c, s = np.cos(yaw), np.sin(yaw)
    aligned_x = x + c * errors.pose[:, 0] - s * errors.pose[:, 1]
    aligned_y = y + s * errors.pose[:, 0] + c * errors.pose[:, 1]
    distance2 = (aligned_x - errors.truth[:, 0]) ** 2 + (aligned_y - errors.truth[:, 1]) ** 2
    return float(np.sqrt(distance2.mean()))


def relative_errors(errors: Errors, distance: float = RPE_DISTANCE) -> FloatArray:
    """Relative pose errors over consecutive stretches of the true path.

    Args:
        errors: of the track; heading and its truth must be known.
        distance: least length of a stretch [m].

    Returns:
        (K, 3) motion over a stretch as estimated, seen from the true one: x [m], y [m], yaw [rad].
        Empty when the robot does not get as far.
    """
    ends = _stretches(errors.truth[:, :2], distance)
    found = np.empty((max(len(ends) - 1, 0), 3))
    for k in range(len(found)):
        begin, end = ends[k], ends[k + 1]
        estimated = compose(inverse(errors.pose[begin]), errors.pose[end])
        true = compose(inverse(errors.truth[begin]), errors.truth[end])
        found[k] = compose(inverse(true), estimated)
        found[k, 2] = wrap_angle(float(found[k, 2]))
    return found


def _stretches(positions: FloatArray, distance: float) -> list[int]:
    """Indices between which the path is at least so long; the path begins anew at each."""
    steps = np.hypot(*np.diff(positions, axis=0).T)
    ends, walked = [0], 0.0
    for i, step in enumerate(steps.tolist(), start=1):
        walked += step
        if walked >= distance:
            ends.append(i)
            walked = 0.0
    return ends


def integrity_violations(errors: Errors, healthy_ns: Sequence[int] | IntArray) -> float | None:
    """Share of the outputs flagged healthy whose error is beyond 3 sigma of what they claim.

    Beyond means outside the ellipsoid that holds 99.73 % of a normal law, as 3 sigma do on one axis: an
    honest covariance violates it 0.27 % of the time, whatever its dimension.

    Args:
        errors: of the track.
        healthy_ns: stamps of the outputs that were flagged healthy.

    Returns:
        The share; None when none of the outputs with truth was healthy.
    """
    healthy = np.isin(errors.stamps_ns, healthy_ns)
    if not healthy.any():
        return None
    return float((errors.nees[healthy] > chi2.ppf(THREE_SIGMA, errors.nees_dof)).mean())


def chi2_mean_bounds(dofs: Sequence[int]) -> tuple[float, float]:
    """Two-sided 95 % bounds on a mean of independent chi-square values, as NEES and NIS are.

    Args:
        dofs: degrees of freedom of each, its expectation.

    Source: Bar-Shalom et al., Estimation with Applications to Tracking and Navigation, 5.4.2: the sum of
    independent NEES is chi-square with the sum of their degrees of freedom.
    """
    tail = (1.0 - NEES_CONFIDENCE) / 2.0
    law = chi2(sum(dofs))
    return float(law.ppf(tail)) / len(dofs), float(law.ppf(1.0 - tail)) / len(dofs)
