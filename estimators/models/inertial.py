"""Acceleration from an inertial sensor: body frame to a level frame, gravity removed."""

from math import hypot, isfinite

import numpy as np
from scipy.spatial.transform import Rotation

from estimators.messages import Attitude, FloatArray, ImuSample

GRAVITY = 9.80665
"""Standard gravity [m/s^2]."""
MAX_ACCEL, MAX_GYRO = 200.0, 100.0
"""Beyond these [m/s^2, rad/s] on any axis a sample is no measurement of a robot."""


def is_possible(sample: ImuSample) -> bool:
    """Whether a sample is finite and within what a robot can do."""
    # Comparisons with NaN are false.
    return bool((np.abs(sample.accel) <= MAX_ACCEL).all() and (np.abs(sample.gyro) <= MAX_GYRO).all())


class Leveller:
    """Orientation of a device in its local level frame: its own attitude, carried on by its gyro.

    The level frame has z up; its x axis points where the device's attitude filter put it.
    """

    def __init__(self) -> None:
        self._rotation: Rotation | None = None
        self._attitude_ns = self._stamp_ns = 0

    def take_attitude(self, attitude: Attitude) -> bool:
        """Take the device's attitude; False when it is no rotation."""
        norm = hypot(*attitude.quat_wxyz.tolist())
        if not isfinite(norm) or abs(norm - 1.0) > 0.01:
            return False
        self._rotation = Rotation.from_quat(attitude.quat_wxyz, scalar_first=True)
        self._attitude_ns = self._stamp_ns = attitude.stamp_ns
        return True

    def carry_on(self, sample: ImuSample) -> None:
        """Turn with the gyro up to a possible sample."""
        if self._rotation is not None and sample.stamp_ns > self._stamp_ns:
            turn = sample.gyro * ((sample.stamp_ns - self._stamp_ns) * 1e-9)
            self._rotation = self._rotation * Rotation.from_rotvec(turn)
            self._stamp_ns = sample.stamp_ns

    def matrix(self, stamp_ns: int, max_age: float) -> FloatArray | None:
        """`R_level_body`, (3, 3); None when the last attitude is further than `max_age` [s] away."""
        if self._rotation is None or abs(stamp_ns - self._attitude_ns) > max_age * 1e9:
            return None
        return np.asarray(self._rotation.as_matrix())


def level_acceleration(R_level_body: FloatArray, accel: FloatArray) -> FloatArray:
    """Horizontal acceleration, (2,) [m/s^2], level frame.

    Args:
        R_level_body: (3, 3) orientation of the device.
        accel: (3,) specific force [m/s^2], body frame.

    Source: li2022, body to navigation frame; gravity has no horizontal part in a level frame.
    """
    horizontal: FloatArray = R_level_body[:2] @ accel
    return horizontal


def predicted_acceleration(
    accel: FloatArray, psi: float, bias: FloatArray, R_level_body: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Horizontal acceleration that a sensor should give in its level frame, with its Jacobian.

    Args:
        accel: (2,) acceleration of the sensor [m/s^2], map frame.
        psi: heading of the level frame in the map [rad].
        bias: (2,) of the accelerometer's x and y axes [m/s^2], body frame.
        R_level_body: (3, 3) orientation of the device.

    Returns:
        (2,) [m/s^2], level frame; its derivative by (acceleration, psi, bias), (2, 5).

    Source: li2022, observation [UWB position, acceleration in the navigation frame]; heading and bias as
    states are ours.
    """
    c, s = np.cos(psi), np.sin(psi)
    R_level_map = np.array([[c, s], [-s, c]])
    value = R_level_map @ accel
    jacobian = np.empty((2, 5))
    jacobian[:, :2] = R_level_map
    jacobian[:, 2] = value[1], -value[0]
    jacobian[:, 3:] = R_level_body[:2, :2]
    return value + R_level_body[:2, :2] @ bias, jacobian
