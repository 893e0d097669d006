"""A graph: its variables, and its factors as rows of numbers, many at once.

A variable is three numbers:

| variable | numbers | which are free |
|---|---|---|
| pose | x [m], y [m], yaw [rad], map frame | all |
| velocity | of the same, along the map's axes [m/s, rad/s] | all |
| landmark | x, y [m], none | the first two |
| anchor | x, y [m], bias of its ranges [m] | none, the bias, or all |

Variables have numbers. Anchors and landmarks come first, poses and velocities after them as time goes on:
a graph is solved fastest in this order. Residuals are measured minus predicted.

Where neither increments nor sightings are, yaw may be held fixed in all poses and velocities alike.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from estimators.graph.losses import GAUSSIAN, Loss
from estimators.immutable import immutable
from estimators.messages import FloatArray, IntArray

FIXED, ALL, PLACE, BIAS = (0, 0, 0), (1, 1, 1), (1, 1, 0), (0, 0, 1)
"""Which numbers of a variable are free."""

INCREMENT, RANGE, SIGHTING, MOTION, PRIOR = 17, 9, 8, 7, 14
"""Columns of each table."""
RANGE_LOSS = 7
"""Column of a range's loss."""


def increments(
    first: ArrayLike, second: ArrayLike, measured: ArrayLike, cov: ArrayLike, loss: Loss = GAUSSIAN
) -> FloatArray:
    """Factors on the motion between two poses: odometry, loop closures.

    Args:
        first: (M,) poses that the increments start at.
        second: (M,) poses that they lead to.
        measured: (M, 3) x [m], y [m], yaw [rad] of the second in the body frame of the first.
        cov: (M, 3, 3) or (3, 3) covariance of the same.
        loss: of the Mahalanobis distance.

    Returns:
        (M, 17) first, second, measured, information, loss and scale, weight.

    Source: huang2024 Eq. (30); model: `models.motion.increment`.
    """
    measured = np.atleast_2d(np.asarray(measured, dtype=np.float64))
    rows = np.empty((len(measured), INCREMENT))
    rows[:, 0], rows[:, 1], rows[:, 2:5] = first, second, measured
    rows[:, 5:14] = np.linalg.inv(np.asarray(cov, dtype=np.float64)).reshape(-1, 9)
    rows[:, 14:] = loss.kind, loss.scale, 1.0
    return rows


def ranges(
    pose: ArrayLike,
    anchor: ArrayLike,
    measured: ArrayLike,
    sigma: ArrayLike,
    arm: ArrayLike = (0.0, 0.0),
    height: ArrayLike = 0.0,
    loss: Loss = GAUSSIAN,
) -> FloatArray:
    """Factors on UWB ranges, with the bias of the anchor.

    Args:
        pose: (M,).
        anchor: (M,).
        measured: (M,) slant ranges [m].
        sigma: (M,) or one standard deviation [m].
        arm: (M, 2) or (2,) tag antenna in the body frame [m].
        height: (M,) or one height of the anchor above the tag [m].
        loss: of the residual.

    Returns:
        (M, 9) pose, anchor, measured, sigma, arm, height, loss and scale.

    Source: huang2024 Eq. (31); model: `models.range.slant_range`.
    """
    measured = np.atleast_1d(np.asarray(measured, dtype=np.float64))
    rows = np.empty((len(measured), RANGE))
    rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3] = pose, anchor, measured, sigma
    rows[:, 4:6], rows[:, 6], rows[:, 7:] = arm, height, (loss.kind, loss.scale)
    return rows


def sightings(
    pose: ArrayLike,
    landmark: ArrayLike,
    distance: ArrayLike,
    bearing: ArrayLike,
    range_sigma: ArrayLike,
    bearing_sigma: ArrayLike,
    loss: Loss = GAUSSIAN,
) -> FloatArray:
    """Factors on landmarks that are seen.

    Args:
        pose: (M,).
        landmark: (M,).
        distance: (M,) horizontal, from the body's origin [m].
        bearing: (M,) in the body frame [rad].
        range_sigma: (M,) or one [m].
        bearing_sigma: (M,) or one [rad].
        loss: of the Mahalanobis distance.

    Returns:
        (M, 8) pose, landmark, distance, bearing, sigmas, loss and scale.

    Source: huang2024 Eq. (32); model: `models.landmark.range_and_bearing`.
    """
    distance = np.atleast_1d(np.asarray(distance, dtype=np.float64))
    rows = np.empty((len(distance), SIGHTING))
    rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3] = pose, landmark, distance, bearing
    rows[:, 4], rows[:, 5], rows[:, 6:] = range_sigma, bearing_sigma, (loss.kind, loss.scale)
    return rows


def motions(
    first: ArrayLike, second: ArrayLike, dt: ArrayLike, accel_noise: float, yaw_accel_noise: float
) -> FloatArray:
    """Factors on constant velocity with white acceleration.

    The velocity of a pose is the variable after it.

    Args:
        first: (M,) earlier poses.
        second: (M,) later poses.
        dt: (M,) or one time between them [s], above zero.
        accel_noise: density of the white acceleration [m/s^2/sqrt(Hz)].
        yaw_accel_noise: density of the white angular acceleration [rad/s^2/sqrt(Hz)].

    Returns:
        (M, 7) earlier pose and velocity, later pose and velocity, time, densities.

    Source: model: `models.motion.constant_velocity`.
    """
    first, second = np.atleast_1d(first), np.atleast_1d(second)
    rows = np.empty((len(first), MOTION))
    rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3] = first, first + 1, second, second + 1
    rows[:, 4], rows[:, 5], rows[:, 6] = dt, accel_noise, yaw_accel_noise
    return rows


def motion(first: int, second: int, dt: float, accel_noise: float, yaw_accel_noise: float) -> FloatArray:
    """As `motions`, (1, 7), where they come one by one."""
    return np.array([[first, first + 1, second, second + 1, dt, accel_noise, yaw_accel_noise]])


def priors(variable: ArrayLike, at: ArrayLike, information: ArrayLike, is_pose: bool) -> FloatArray:
    """Factors on single variables: a start, a surveyed anchor, a measured heading.

    Args:
        variable: (M,).
        at: (M, 3) expected.
        information: (M, 3, 3) or (3, 3); a row and column of zeros where nothing is known.
        is_pose: whether the third number is an angle.

    Returns:
        (M, 14) variable, expectation, information, whether it is a pose.
    """
    at = np.atleast_2d(np.asarray(at, dtype=np.float64))
    rows = np.empty((len(at), PRIOR))
    rows[:, 0], rows[:, 1:4] = variable, at
    rows[:, 4:13] = np.asarray(information, dtype=np.float64).reshape(-1, 9)
    rows[:, 13] = is_pose
    return rows


def headings(pose: ArrayLike, yaw: ArrayLike, sigma: float) -> FloatArray:
    """Factors on measured headings: a compass, an attitude whose reference is known.

    Args:
        pose: (M,).
        yaw: (M,) in the map [rad].
        sigma: standard deviation [rad].

    Returns:
        (M, 14) as `priors`.
    """
    yaw = np.atleast_1d(np.asarray(yaw, dtype=np.float64))
    at = np.zeros((len(yaw), 3))
    at[:, 2] = yaw
    return priors(pose, at, np.diag([0.0, 0.0, sigma**-2]), is_pose=True)


@immutable
class DensePrior:
    """What is known of several variables together, as a quadratic.

    Attributes:
        variables: (K,).
        at: (K, 3) their values where it was linearised.
        information: (3 K, 3 K).
        gradient: (3 K,) of the negative cost there.
    """

    variables: IntArray
    at: FloatArray
    information: FloatArray
    gradient: FloatArray


NOTHING_KNOWN = DensePrior(np.empty(0, dtype=np.int64), np.empty((0, 3)), np.empty((0, 0)), np.empty(0))


def _none(columns: int) -> FloatArray:
    return np.empty((0, columns))


@dataclass(slots=True, eq=False)
class Graph:
    """Variables and factors.

    Attributes:
        values: (V, 3) where the variables are, or are thought to be before they are solved for.
        free: (V, 3) 1 where a number is to be found, 0 where it is known.
        increments: (M, 17), see `increments`; so are the other tables.
        ranges: (M, 9).
        sightings: (M, 8).
        motions: (M, 7).
        priors: (M, 14).
        dense: on several variables together.
        name: of a variable by its number, for errors.
    """

    values: FloatArray
    free: FloatArray
    increments: FloatArray = field(default_factory=lambda: _none(INCREMENT))
    ranges: FloatArray = field(default_factory=lambda: _none(RANGE))
    sightings: FloatArray = field(default_factory=lambda: _none(SIGHTING))
    motions: FloatArray = field(default_factory=lambda: _none(MOTION))
    priors: FloatArray = field(default_factory=lambda: _none(PRIOR))
    dense: DensePrior = NOTHING_KNOWN
    name: Callable[[int], str] = "variable {}".format
