"""Planar motion: constant velocity with white acceleration, and the odometry increment between two poses."""

from math import cos, pi, sin

import numpy as np

from estimators.geometry import between, compose
from estimators.messages import FloatArray


def constant_velocity(dt: float, accel_noise: float, yaw_accel_noise: float) -> tuple[FloatArray, FloatArray]:
    """Transition and process noise of (x, y, yaw, vx, vy, yaw rate), velocities along the map axes.

    Args:
        dt: time step [s]; negative steps look back, their noise is that of the positive step.
        accel_noise: density of the white acceleration [m/s^2/sqrt(Hz)].
        yaw_accel_noise: density of the white angular acceleration [rad/s^2/sqrt(Hz)].

    Returns:
        F (6, 6) and Q (6, 6).

    Source: Bar-Shalom et al., Estimation with Applications to Tracking and Navigation, 6.2.2.
    """
    F = np.eye(6)
    F[0, 3] = F[1, 4] = F[2, 5] = dt
    step = abs(dt)
    Q = np.zeros((6, 6))
    for i, density in enumerate((accel_noise, accel_noise, yaw_accel_noise)):
        power = density * density
        Q[i, i] = power * step**3 / 3.0
        Q[i, i + 3] = Q[i + 3, i] = power * step * dt / 2.0
        Q[i + 3, i + 3] = power * step
    return F, Q


def smooth_motion(
    dt: float, accel_noise: float, yaw_accel_noise: float, bandwidth: float
) -> tuple[FloatArray, FloatArray]:
    """`constant_velocity` for a body whose acceleration hardly changes within a step.

    White acceleration lets the body sway within a step as much as from step to step. With an acceleration
    that changes as a sine of the given frequency does at most, the way of a step deviates from the mean of
    the velocities at its ends by no more than ``2 pi bandwidth dt**2 / 12`` times the change of the velocity.

    Args:
        dt: time step [s], positive.
        accel_noise: density of the white acceleration [m/s^2/sqrt(Hz)].
        yaw_accel_noise: density of the white angular acceleration [rad/s^2/sqrt(Hz)].
        bandwidth: highest frequency of the swaying [Hz].

    Returns:
        F (6, 6) and Q (6, 6).
    """
    F, Q = constant_velocity(dt, accel_noise, yaw_accel_noise)
    white = dt * dt / 12.0
    deviation = min(white, (2.0 * pi * bandwidth * white) ** 2)
    for i in range(3):
        Q[i, i] += (deviation - white) * Q[i + 3, i + 3]
    return F, Q


def cubic_between(share: FloatArray, dt: float) -> FloatArray:
    """Weights of two poses and their velocities in the poses between them.

    Args:
        share: (N,) of the way in time from the first to the second, 0 to 1.
        dt: time from the first to the second [s].

    Returns:
        (N, 4) weights of the first pose, its velocity, the second pose, its velocity.

    Source: Hermite cubic; it is the mean of a motion under white acceleration between two known states:
    Barfoot, Tong and Sarkka, "Batch continuous-time trajectory estimation", RSS 2014.
    """
    second, rest = share * share * (3.0 - 2.0 * share), 1.0 - share
    return np.column_stack([1.0 - second, dt * share * rest * rest, second, -dt * share * share * rest])


def increment(reference: FloatArray, pose: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Increment that odometry should report, with its Jacobians.

    Args:
        reference: (3,) earlier pose in the map.
        pose: (3,) newer pose in the map.

    Returns:
        Increment (3,) in the reference's body frame, its derivative by the reference (3, 3) and by
        the pose (3, 3).

    Source: chen2019 Eq. (5)-(20), displacement and rotation as one planar motion; Jacobians chosen here.
    """
    value = between(reference, pose)
    c, s = cos(reference[2]), sin(reference[2])
    by_pose = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    by_reference = -by_pose
    by_reference[0, 2] = value[1]
    by_reference[1, 2] = -value[0]
    return value, by_reference, by_pose


def constant_acceleration(dt: float, jerk_noise: float) -> tuple[FloatArray, FloatArray]:
    """Transition and process noise of (x, y, vx, vy, ax, ay).

    Args:
        dt: time step [s]; negative steps look back, their noise is that of the positive step.
        jerk_noise: density of the white jerk [m/s^3/sqrt(Hz)].

    Returns:
        F (6, 6) and Q (6, 6).

    Source: Bar-Shalom et al., Estimation with Applications to Tracking and Navigation, 6.2.3.
    """
    F = np.eye(6)
    F[[0, 1, 2, 3], [2, 3, 4, 5]] = dt
    F[[0, 1], [4, 5]] = dt * dt / 2.0
    step, sign = abs(dt), np.sign(dt)
    by_axis = jerk_noise**2 * np.array(
        [
            [step**5 / 20.0, sign * step**4 / 8.0, step**3 / 6.0],
            [sign * step**4 / 8.0, step**3 / 3.0, sign * step**2 / 2.0],
            [step**3 / 6.0, sign * step**2 / 2.0, step],
        ]
    )
    Q: FloatArray = np.kron(by_axis, np.eye(2)).astype(np.float64)
    return F, Q


def chained(
    moved: FloatArray, cov: FloatArray, step: FloatArray, step_cov: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """A motion and a further one as a single motion, their errors being independent.

    Args:
        moved: (3,) first motion.
        cov: (3, 3) its covariance.
        step: (3,) further motion, in the body frame at the end of the first.
        step_cov: (3, 3) its covariance.

    Returns:
        Both as one (3,), and its covariance (3, 3).

    Source: Smith, Self and Cheeseman, "Estimating uncertain spatial relationships in robotics", 1990, 3.2.
    """
    c, s = cos(moved[2]), sin(moved[2])
    by_moved, by_step = np.eye(3), np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    by_moved[0, 2], by_moved[1, 2] = -s * step[0] - c * step[1], c * step[0] - s * step[1]
    return compose(moved, step), by_moved @ cov @ by_moved.T + by_step @ step_cov @ by_step.T
