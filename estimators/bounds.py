"""The least error that any estimator can have: the posterior Cramer-Rao bound along a true path."""

from collections.abc import Iterable, Sequence
from math import hypot

import numpy as np
from numpy.typing import NDArray

from estimators.base import Setup
from estimators.messages import FloatArray
from estimators.models.landmark import range_and_bearing
from estimators.models.motion import increment
from estimators.models.range import horizontal_range


def posterior_bound(
    start_cov: FloatArray, poses: FloatArray, increment_covs: Sequence[FloatArray], information: FloatArray
) -> FloatArray:
    """Bound on the error covariance of the newest pose, given everything measured up to it.

    The increments are all that is known of the motion: an estimator whose motion model fits the walk knows
    more, and may get below.

    Args:
        start_cov: (3, 3) covariance of the first pose before any measurement.
        poses: (K, 3) true x [m], y [m], yaw [rad], map frame.
        increment_covs: K - 1 of (3, 3), covariance of the increment from each pose to the next, in the
            body frame of the earlier.
        information: (K, 3, 3) Fisher information on (x, y, yaw) of everything else measured at each pose.

    Returns:
        (K, 3, 3) bound on the covariance of (x, y, yaw).

    Source: Tichavsky, Muravchik and Nehorai, IEEE Trans. Signal Processing 46(5), 1998, Eq. (21), for
    Gaussian noise and at the true path, written with covariances (matrix inversion lemma).
    """
    bounds = np.empty((len(poses), 3, 3))
    bounds[0] = np.linalg.inv(np.linalg.inv(start_cov) + information[0])
    for k, cov in enumerate(increment_covs):
        _, by_reference, by_pose = increment(poses[k], poses[k + 1])
        # The increment fixes the newer pose as a function of the earlier one and of its own noise.
        G = np.linalg.inv(by_pose)
        F = -G @ by_reference
        predicted = F @ bounds[k] @ F.T + G @ cov @ G.T
        bounds[k + 1] = np.linalg.inv(np.linalg.inv(predicted) + information[k + 1])
    return bounds


def range_information(pose: FloatArray, setup: Setup, anchor_ids: Iterable[int], sigma: float) -> FloatArray:
    """Fisher information of slant ranges on the pose at which they are taken.

    Args:
        pose: (3,) true x [m], y [m], yaw [rad], map frame.
        setup: anchors, lever arm and heights.
        anchor_ids: of the ranges that count; a blocked one has an excess of unknown law, leave it out.
        sigma: standard deviation of a range [m].

    Returns:
        (3, 3) on (x, y, yaw).
    """
    information = np.zeros((3, 3))
    for anchor_id in anchor_ids:
        anchor = setup.anchors[anchor_id]
        horizontal, by_pose = horizontal_range(pose, anchor, setup.tag_in_body)
        slant_by_pose = by_pose * (horizontal / hypot(horizontal, setup.height_to(anchor)))
        information += np.outer(slant_by_pose, slant_by_pose) / sigma**2
    return information


def seen_from(pose: FloatArray, other: FloatArray, information: FloatArray) -> FloatArray:
    """What tells of one pose as information on another, the motion between the two being known.

    Args:
        pose: (3,) true x [m], y [m], yaw [rad] that is asked for, map frame.
        other: (3,) true pose that the information is on.
        information: (3, 3) on (x, y, yaw) of the other.

    Returns:
        (3, 3) on (x, y, yaw) of the first.
    """
    dx, dy = other[:2] - pose[:2]
    by_pose = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    shifted: FloatArray = by_pose.T @ information @ by_pose
    return shifted


def position_information(
    points: FloatArray, anchors: FloatArray, counts: NDArray[np.bool_], sigma: float
) -> FloatArray:
    """Fisher information of one slant range to each anchor on the horizontal position of the tag.

    Its inverse is the bound of a single epoch: what ranges alone can tell without any memory.

    Args:
        points: (N, 3) of the tag [m], map frame.
        anchors: (M, 3) [m], map frame.
        counts: (N, M) whether a range counts; a blocked one has an excess of unknown law, leave it out.
        sigma: standard deviation of a range [m].

    Returns:
        (N, 2, 2) on (x, y).
    """
    offsets = points[:, None, :] - anchors
    towards = offsets[..., :2] / np.linalg.norm(offsets, axis=2, keepdims=True)
    towards = np.where(counts[..., None], towards, 0.0) / sigma
    information: FloatArray = np.einsum("nmi,nmj->nij", towards, towards)
    return information


def landmark_information(
    pose: FloatArray, setup: Setup, landmark_ids: Iterable[int], range_sigma: float, bearing_sigma: float
) -> FloatArray:
    """Fisher information of landmarks on the pose from which they are seen.

    Args:
        pose: (3,) true x [m], y [m], yaw [rad], map frame.
        setup: positions of the landmarks.
        landmark_ids: of those that are seen.
        range_sigma: standard deviation of a range [m].
        bearing_sigma: standard deviation of a bearing [rad].

    Returns:
        (3, 3) on (x, y, yaw).
    """
    weight = np.diag([range_sigma**-2, bearing_sigma**-2])
    information = np.zeros((3, 3))
    for landmark_id in landmark_ids:
        _, by_pose = range_and_bearing(pose, setup.landmarks[landmark_id])
        information += by_pose.T @ weight @ by_pose
    return information
