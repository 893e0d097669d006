"""LiDAR alone: dead reckoning from the start pose on the scan matcher's increments.

State, (9,): pose (x, y, yaw) and velocity (vx, vy, yaw rate) in the map, and the pose at which the
odometry's current keyframe was taken. Keeping that pose in the state (a stochastic clone) makes an
increment exactly what it is, a measurement between two poses that are both uncertain and correlated.
"""

import numpy as np

from estimators.base import Report, Setup, Verdict
from estimators.geometry import wrap_angle
from estimators.lidar.keyframes import START_SPEED_SIGMA, KeyframeTracker
from estimators.messages import FloatArray, PoseEstimate, PoseIncrement
from estimators.models.motion import constant_velocity, increment

POSE = slice(0, 3)
MOVING = slice(0, 6)
REFERENCE = slice(6, 9)
MAX_HEADING_SIGMA = 0.35
"""An odometry that begins anew with a heading less certain than this [rad] leaves the heading unknown.

Beyond some 20 deg a filter that is linear in the heading grows sure of a wrong one. A gap in the scans is no
such case while the matcher finds its old keyframe again: then the reference, and its heading, is still held.
"""

_WIDEST = np.square([1e3, 1e3, 2.0 * np.pi, 1e3, 1e3, 1e3, 1e3, 1e3, 2.0 * np.pi])
"""Variances [m^2, rad^2, m^2/s^2, rad^2/s^2] of a state of which nothing is known.

Without a measurement they would in time grow so much that of a range's own variance rounding leaves nothing.
"""


class LidarOdometry(KeyframeTracker):
    """Kalman filter (filterpy) on increments only; what drifts here is what UWB must hold.

    Source: huang2024 Table 4, row "LiDAR"; stochastic cloning: Roumeliotis and Burdick, ICRA 2002.
    """

    class Config(KeyframeTracker.Config):
        """Settings of `lidar_odometry`."""

    def __init__(self, config: Config, setup: Setup) -> None:
        # Numba loads slowly: only who makes an estimator waits for it.
        from estimators.kernels.motion import predicted

        super().__init__(config, setup)
        self._predicted = predicted
        self.reset()

    @property
    def state(self) -> tuple[FloatArray, FloatArray]:
        """State (9,) and covariance (9, 9) at the newest measurement, for tests."""
        return self._filter.x.copy(), self._filter.P.copy()

    def pose_at(self, stamp_ns: int) -> PoseEstimate | None:
        """Pose predicted with constant velocity; None before the first measurement.

        The variance of yaw is infinite once the heading was lost (see `MAX_HEADING_SIGMA`), until reset.
        """
        if self._stamp_ns is None or not self._reaches(stamp_ns):
            return None
        dt = 0.0 if self._stands else (stamp_ns - self._stamp_ns) * 1e-9
        mean, cov = self._predicted(
            self._filter.x, np.ascontiguousarray(self._filter.P), dt, *self._accel_noise
        )
        return self._estimate(stamp_ns, mean[MOVING], cov[MOVING, MOVING], self._heading_known)

    def _place(self, pose: FloatArray, cov: FloatArray) -> None:
        # Filterpy loads slowly, with SciPy's statistics: only who makes a filter waits for it.
        from filterpy.kalman import ExtendedKalmanFilter

        self._filter = ExtendedKalmanFilter(dim_x=9, dim_z=3)
        self._filter.x = np.concatenate([pose, np.zeros(3), pose])
        self._filter.P = np.zeros((9, 9))
        for rows in (POSE, REFERENCE):
            for columns in (POSE, REFERENCE):
                self._filter.P[rows, columns] = cov
        self._heading_known = True

    def _set_speed_free(self) -> None:
        self._filter.P[3:6, 3:6] = np.eye(3) * START_SPEED_SIGMA**2

    def _move(self, dt: float) -> None:
        F, Q = np.eye(9), np.zeros((9, 9))
        F[MOVING, MOVING], Q[MOVING, MOVING] = constant_velocity(dt, *self._accel_noise)
        self._filter.F, self._filter.Q = F, Q
        self._filter.predict()
        variances = np.diag(self._filter.P)
        if (variances > _WIDEST).any():
            scale = np.sqrt(_WIDEST / np.maximum(variances, _WIDEST))
            self._filter.P *= np.outer(scale, scale)

    def _begin_anew(self) -> None:
        self._heading_known &= bool(self._filter.P[2, 2] < MAX_HEADING_SIGMA**2)

    def _follow(self, measured: PoseIncrement) -> Report:
        predicted, by_reference, by_pose = increment(self._filter.x[REFERENCE], self._filter.x[POSE])
        H = np.zeros((3, 9))
        H[:, POSE], H[:, REFERENCE] = by_pose, by_reference
        innovation = measured.increment - predicted
        innovation[2] = wrap_angle(innovation[2])
        S = H @ self._filter.P @ H.T + measured.cov
        nis = float(innovation @ np.linalg.solve(S, innovation))
        report = np.full(1, np.nan), np.array([nis])
        if nis > self._increment_gate:
            return Report((Verdict.GATED,), *report)
        self._correct(innovation, H, measured.cov)
        return Report((Verdict.ACCEPTED,), *report)

    def _correct(self, innovation: FloatArray, H: FloatArray, R: FloatArray) -> None:
        self._filter.update(innovation, lambda _: H, lambda _: np.zeros_like(innovation), R=R)
        for i in (2, 8):  # headings of the pose and of the reference
            self._filter.x[i] = wrap_angle(self._filter.x[i])
        self._filter.P = 0.5 * (self._filter.P + self._filter.P.T)

    def _take_reference(self) -> None:
        copy = np.eye(9)
        copy[REFERENCE, REFERENCE] = 0.0
        copy[REFERENCE, POSE] = np.eye(3)
        self._filter.x = copy @ self._filter.x
        self._filter.P = copy @ self._filter.P @ copy.T
