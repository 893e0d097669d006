"""UWB positions and inertial accelerations in a Kalman filter (filterpy).

State, (9,): position and velocity of the tag and its acceleration in the map, heading of the inertial
sensor's level frame in the map, and bias of its x and y axes. The sensor is taken to sit at the tag with its
axes along the body's.
"""

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from estimators.base import Report, Setup, Verdict
from estimators.geometry import lift, rotation, wrap_angle
from estimators.lidar.keyframes import FURTHEST_NS
from estimators.messages import (
    Attitude,
    FloatArray,
    ImuSample,
    Measurement,
    PoseEstimate,
    RangeFrame,
    measurement_stamp_ns,
)
from estimators.models.inertial import Leveller, is_possible, level_acceleration, predicted_acceleration
from estimators.models.motion import constant_acceleration
from estimators.uwb.frame_solver import TagFix
from estimators.uwb.gd_pf import GdPf
from estimators.uwb.gradient_descent import MomentumGradientDescent

MOVING, ACCEL, PSI, BIAS = slice(0, 6), slice(4, 6), 6, slice(7, 9)
SPEED_SIGMA, ACCEL_SIGMA, BIAS_SIGMA = 0.5, 1.0, 0.1
"""Standard deviations of velocity [m/s], acceleration and bias [m/s^2] at the beginning, each axis."""
MAX_HEADING_SIGMA = 0.35
"""A start heading less certain than this [rad] is none: accelerations would be taken in a wrong direction."""
ANYWHERE_SIGMA = 100.0
"""Standard deviation of each coordinate of a tag of which nothing is known before its first position [m]."""
MAX_ATTITUDE_AGE = 0.5
"""An attitude older than this [s] no longer levels samples nor tells a heading."""


class UwbImuEkf:
    """Extended Kalman filter on solved UWB positions and levelled accelerations.

    Without attitude, or without a start heading, it is a filter on positions alone and knows no heading.

    Source: li2022, EKF with observation [UWB position, acceleration in the navigation frame]; state,
    Jacobians and noise are lost in the text, those here are ours and tested against finite differences.
    """

    STATES: ClassVar[int] = 9
    """How many unknowns it has, those of subclasses behind its own."""

    class Config(GdPf.Config):
        """Settings of `uwb_imu_ekf`."""

        PARAMETER: ClassVar[str] = "positions"

        dimensions: Literal[2] = Field(2, description="in the plane alone")
        positions: Literal["momentum_gd", "gd_pf"] = Field(
            "momentum_gd", description="whose positions are observed; gd_pf as in li2022"
        )
        jerk_noise: float = Field(2.0, gt=0, le=1000, description="density of white jerk [m/s^3/sqrt(Hz)]")
        imu_accel_sigma: float = Field(
            0.15,
            gt=0,
            le=10,
            description="standard deviation of a levelled acceleration [m/s^2]: of the sensor, and of its "
            "tilt times gravity",
        )
        bias_walk: float = Field(
            0.002, ge=0, le=1, description="density of the walk of the bias [m/s^2/sqrt(s)]"
        )
        heading_walk_deg: float = Field(
            0.1, ge=0, le=90, description="density of the walk of the attitude's heading [deg/sqrt(s)]"
        )

    def __init__(self, config: Config, setup: Setup) -> None:
        self._config = config
        self._setup = setup
        self._solver: MomentumGradientDescent | GdPf
        if config.positions == "gd_pf":
            self._solver = GdPf(config, setup)
        else:
            self._solver = MomentumGradientDescent(config, setup)
        self.reset()

    def reset(self) -> None:
        """Wait for the first position again."""
        self._solver.reset()
        self._leveller = Leveller()
        self._stamp_ns: int | None = None
        self._is_placed = False
        self._heading_known = False
        self._reset_counter = -1
        # Filterpy loads slowly, with SciPy's statistics: only who makes a filter waits for it.
        from filterpy.kalman import ExtendedKalmanFilter

        self._filter = ExtendedKalmanFilter(dim_x=self.STATES, dim_z=2)
        self._filter.x = np.zeros(self.STATES)
        self._filter.P = np.zeros((self.STATES, self.STATES))
        self._filter.P[BIAS, BIAS] = np.eye(2) * BIAS_SIGMA**2

    @property
    def state(self) -> tuple[FloatArray, FloatArray]:
        """State (N,) and covariance (N, N) at the newest measurement, for tests."""
        return self._filter.x.copy(), self._filter.P.copy()

    def update(self, measurement: Measurement) -> Report:
        """Take ranges, inertial samples and attitudes; other measurements are not used."""
        count = len(measurement.ranges) if isinstance(measurement, RangeFrame) else 1
        if not isinstance(measurement, RangeFrame | ImuSample | Attitude):
            return Report((Verdict.NOT_USED,))
        stamp_ns = measurement_stamp_ns(measurement)
        if self._stamp_ns is not None and stamp_ns < self._stamp_ns:
            return Report((Verdict.LATE,) * count)
        if isinstance(measurement, RangeFrame):
            return self._update_ranges(measurement)
        if isinstance(measurement, Attitude):
            return Report((self._take_attitude(measurement),))
        return Report((self._update_imu(measurement),))

    def pose_at(self, stamp_ns: int) -> PoseEstimate | None:
        """Pose predicted with constant acceleration; None before the first position.

        The variance of yaw is infinite while there is no attitude or no start heading; then the body is
        taken to be at the tag.
        """
        if not self._is_placed or self._stamp_ns is None or abs(stamp_ns - self._stamp_ns) > FURTHEST_NS:
            return None
        dt = (stamp_ns - self._stamp_ns) * 1e-9
        F, Q = constant_acceleration(dt, self._config.jerk_noise)
        position = (F @ self._filter.x[MOVING])[:2]
        to_position = np.zeros((3, self.STATES))
        to_position[:2, MOVING] = F[:2]
        lever = self._setup.tag_in_body[:2]
        R_level_body = self._leveller.matrix(stamp_ns, MAX_ATTITUDE_AGE)
        planar = np.zeros((3, 3))
        planar[:2, :2] = Q[:2, :2]
        if R_level_body is None or not self._heading_known:
            planar += to_position @ self._filter.P @ to_position.T
            planar[:2, :2] += np.eye(2) * float(lever @ lever) / 2.0
            planar[2, 2] = np.inf
            pose = np.array([*position, 0.0])
        else:
            yaw = wrap_angle(self._filter.x[PSI] + _heading(R_level_body))
            arm = rotation(yaw) @ lever
            to_position[:, PSI] = arm[1], -arm[0], 1.0
            planar += to_position @ self._filter.P @ to_position.T
            pose = np.array([*(position - arm), yaw])
        T_map_body = lift(pose, self._setup.height)
        return PoseEstimate(stamp_ns, T_map_body, self._setup.lift_covariance(planar), self._reset_counter)

    def _observation(self, fix: TagFix) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Jacobian (2, N), predicted position (2,) and noise (2, 2) of a fix, constant as in li2022."""
        H = np.zeros((2, self.STATES))
        H[:, :2] = np.eye(2)
        return H, self._filter.x[:2], fix.cov[:2, :2]

    def _update_ranges(self, frame: RangeFrame) -> Report:
        before = self._solver.fix
        report = self._solver.update(frame)
        self._predict_to(frame.stamp_ns)
        fix = self._solver.fix
        if fix is None or fix is before:
            return report
        if not self._is_placed:
            self._place(fix)
        H, predicted, R = self._observation(fix)
        self._correct(fix.position[:2], H, predicted, R)
        return report

    def _place(self, fix: TagFix) -> None:
        """Begin at the start, or later and without a start heading where the fix is, which then decides."""
        start, lever = self._setup.start, self._setup.tag_in_body[:2]
        if self._reset_counter < 0 and start.sigma[2] <= MAX_HEADING_SIGMA:
            position = start.pose[:2] + rotation(start.pose[2]) @ lever
            variance = start.sigma[:2] ** 2 + float(lever @ lever) * start.sigma[2] ** 2
        else:
            position, variance = fix.position[:2], np.full(2, ANYWHERE_SIGMA**2)
        self._filter.x[MOVING] = [*position, 0.0, 0.0, 0.0, 0.0]
        self._filter.P[MOVING, :] = self._filter.P[:, MOVING] = 0.0
        self._filter.P[MOVING, MOVING] = np.diag([*variance, *[SPEED_SIGMA**2] * 2, *[ACCEL_SIGMA**2] * 2])
        self._is_placed = True
        self._reset_counter += 1

    def _take_attitude(self, attitude: Attitude) -> Verdict:
        if not self._leveller.take_attitude(attitude):
            return Verdict.IMPOSSIBLE
        self._predict_to(attitude.stamp_ns)
        start = self._setup.start
        if not self._heading_known and start.sigma[2] <= MAX_HEADING_SIGMA:
            R_level_body = self._leveller.matrix(attitude.stamp_ns, MAX_ATTITUDE_AGE)
            assert R_level_body is not None
            self._filter.x[PSI] = wrap_angle(start.pose[2] - _heading(R_level_body))
            self._filter.P[PSI, PSI] = start.sigma[2] ** 2
            self._heading_known = True
        return Verdict.ACCEPTED

    def _update_imu(self, sample: ImuSample) -> Verdict:
        if not is_possible(sample):
            return Verdict.IMPOSSIBLE
        self._leveller.carry_on(sample)
        self._predict_to(sample.stamp_ns)
        R_level_body = self._leveller.matrix(sample.stamp_ns, MAX_ATTITUDE_AGE)
        if R_level_body is None or not self._heading_known or not self._is_placed:
            return Verdict.NOT_USED
        x = self._filter.x
        predicted, by_state = predicted_acceleration(x[ACCEL], x[PSI], x[BIAS], R_level_body)
        H = np.zeros((2, self.STATES))
        H[:, ACCEL], H[:, PSI : BIAS.stop] = by_state[:, :2], by_state[:, 2:]
        measured = level_acceleration(R_level_body, sample.accel)
        self._correct(measured, H, predicted, np.eye(2) * self._config.imu_accel_sigma**2)
        return Verdict.ACCEPTED

    def _predict_to(self, stamp_ns: int) -> None:
        dt = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) * 1e-9
        self._stamp_ns = stamp_ns
        if dt > self._config.max_silence:
            # The next position places it anew.
            self._is_placed = False
        self._filter.F, self._filter.Q = self._motion(dt)
        self._filter.predict()

    def _motion(self, dt: float) -> tuple[FloatArray, FloatArray]:
        """Transition (N, N) of the state over a time [s], and its noise (N, N)."""
        config = self._config
        F, Q = np.eye(self.STATES), np.zeros((self.STATES, self.STATES))
        if self._is_placed:
            F[MOVING, MOVING], Q[MOVING, MOVING] = constant_acceleration(dt, config.jerk_noise)
        Q[PSI, PSI] = np.deg2rad(config.heading_walk_deg) ** 2 * dt
        Q[BIAS, BIAS] = np.eye(2) * config.bias_walk**2 * dt
        return F, Q

    def _correct(self, measured: FloatArray, H: FloatArray, predicted: FloatArray, R: FloatArray) -> None:
        self._filter.update(measured, lambda _: H, lambda _: predicted, R=R)
        self._filter.x[PSI] = wrap_angle(self._filter.x[PSI])
        self._filter.P = 0.5 * (self._filter.P + self._filter.P.T)


def _heading(R_level_body: FloatArray) -> float:
    """Heading of the body's x axis in the level frame [rad]."""
    return float(np.arctan2(R_level_body[1, 0], R_level_body[0, 0]))
