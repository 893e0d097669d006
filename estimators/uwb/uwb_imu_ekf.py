"""UWB positions and inertial accelerations in a Kalman filter (filterpy), plain and with an adaptive gain.

State, (9,): position and velocity of the tag and its acceleration in the map, heading of the inertial
sensor's level frame in the map, and bias of its x and y axes. The sensor is taken to sit at the tag with its
axes along the body's.
"""

from typing import ClassVar, Literal

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
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

MOVING, ACCEL, PSI = slice(0, 6), slice(4, 6), 6
SPEED_SIGMA, ACCEL_SIGMA, BIAS_SIGMA = 0.5, 1.0, 0.1
"""Standard deviations of velocity [m/s], acceleration and bias [m/s^2] at the beginning, each axis."""
MAX_HEADING_SIGMA = 0.35
"""A start heading less certain than this [rad] is none: accelerations would be taken in a wrong direction."""
MAX_ATTITUDE_AGE = 0.5
"""An attitude older than this [s] no longer levels samples nor tells a heading."""


class UwbImuEkf:
    """Extended Kalman filter on solved UWB positions and levelled accelerations.

    Without attitude, or without a start heading, it is a filter on positions alone and knows no heading.

    Source: li2022, EKF with observation [UWB position, acceleration in the navigation frame]; state,
    Jacobians and noise are lost in the text, those here are ours and tested against finite differences.
    """

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
        self._filter = ExtendedKalmanFilter(dim_x=9, dim_z=2)
        self._filter.x = np.zeros(9)
        self._filter.P = np.diag([0.0] * 6 + [0.0] + [BIAS_SIGMA**2] * 2)

    @property
    def state(self) -> tuple[FloatArray, FloatArray]:
        """State (9,) and covariance (9, 9) at the newest measurement, for tests."""
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
        to_position = np.zeros((3, 9))
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

    def _scale(self, fix: TagFix) -> float:  # noqa: ARG002
        """Factor of the covariance of an observed position; constant noise here, as in the paper."""
        return 1.0

    def _update_ranges(self, frame: RangeFrame) -> Report:
        before = self._solver.fix
        report = self._solver.update(frame)
        self._predict_to(frame.stamp_ns)
        fix = self._solver.fix
        if fix is None or fix is before:
            return report
        if not self._is_placed:
            self._place(fix)
            return report
        H = np.zeros((2, 9))
        H[:, :2] = np.eye(2)
        self._correct(fix.position[:2], H, self._filter.x[:2], fix.cov[:2, :2] * self._scale(fix))
        return report

    def _place(self, fix: TagFix) -> None:
        self._filter.x[MOVING] = [*fix.position[:2], 0.0, 0.0, 0.0, 0.0]
        self._filter.P[MOVING, :] = self._filter.P[:, MOVING] = 0.0
        self._filter.P[:2, :2] = fix.widened_cov[:2, :2]
        self._filter.P[2:6, 2:6] = np.diag([SPEED_SIGMA**2] * 2 + [ACCEL_SIGMA**2] * 2)
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
        predicted, by_state = predicted_acceleration(x[ACCEL], x[PSI], x[7:9], R_level_body)
        H = np.zeros((2, 9))
        H[:, ACCEL], H[:, PSI:] = by_state[:, :2], by_state[:, 2:]
        measured = level_acceleration(R_level_body, sample.accel)
        self._correct(measured, H, predicted, np.eye(2) * self._config.imu_accel_sigma**2)
        return Verdict.ACCEPTED

    def _predict_to(self, stamp_ns: int) -> None:
        dt = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) * 1e-9
        self._stamp_ns = stamp_ns
        if dt > self._config.max_silence:
            # The next position places it anew.
            self._is_placed = False
        config = self._config
        F, Q = np.eye(9), np.zeros((9, 9))
        if self._is_placed:
            F[MOVING, MOVING], Q[MOVING, MOVING] = constant_acceleration(dt, config.jerk_noise)
        walks = [np.deg2rad(config.heading_walk_deg), config.bias_walk, config.bias_walk]
        Q[PSI:, PSI:] = np.diag(np.square(walks) * dt)
        self._filter.F, self._filter.Q = F, Q
        self._filter.predict()

    def _correct(self, measured: FloatArray, H: FloatArray, predicted: FloatArray, R: FloatArray) -> None:
        self._filter.update(measured, lambda _: H, lambda _: predicted, R=R)
        self._filter.x[PSI] = wrap_angle(self._filter.x[PSI])
        self._filter.P = 0.5 * (self._filter.P + self._filter.P.T)


class UwbImuAdaptiveEkf(UwbImuEkf):
    """The same filter, which takes less of positions that cannot be.

    The covariance of an observed position grows with the square of what exceeds either limit, so its gain,
    and even its pull, fades: where it is further from the predicted position than states and observations may
    be apart; where it is further from the position observed before than the robot can have come, three
    standard deviations of both allowed for. It grows, too, where the ranges disagree: what blocks a range
    stays for a while, so the positions of that while err alike and count as one.

    Source: li2022, adaptive function on the gain, from state-observation distance and from the top speed; its
    formulas are lost, the factors are ours, and so is that of the disagreement.
    """

    class Config(UwbImuEkf.Config):
        """Settings of `uwb_imu_adaptive_ekf`."""

        max_distance: float = Field(
            0.25, gt=0, le=100, description="state and observed position are at most so far apart [m]"
        )
        top_speed: float = Field(1.0, gt=0, le=50, description="of the robot [m/s]")
        blocked_time: float = Field(
            2.0, gt=0, le=60, description="positions of ranges that disagree err alike for so long [s]"
        )

    def __init__(self, config: Config, setup: Setup) -> None:
        self._limits = config
        super().__init__(config, setup)

    def reset(self) -> None:
        """Wait for the first position again."""
        super().reset()
        self._observed: TagFix | None = None

    def _place(self, fix: TagFix) -> None:
        super()._place(fix)
        self._observed = fix

    def _scale(self, fix: TagFix) -> float:
        before, self._observed = self._observed, fix
        assert before is not None
        apart = float(np.linalg.norm(fix.position[:2] - self._filter.x[:2]))
        step = float(np.linalg.norm(fix.position[:2] - before.position[:2]))
        variance = float(np.trace(fix.cov[:2, :2] + before.cov[:2, :2])) / 2.0
        dt = (fix.stamp_ns - before.stamp_ns) * 1e-9
        reach = self._limits.top_speed * dt + 3.0 * np.sqrt(variance)
        too_far = max(1.0, apart / self._limits.max_distance) * max(1.0, step / reach)
        alike = self._limits.blocked_time / min(max(dt, 1e-3), self._limits.blocked_time)
        return float(too_far**2 * (1.0 + (fix.disagreement - 1.0) * alike))


def _heading(R_level_body: FloatArray) -> float:
    """Heading of the body's x axis in the level frame [rad]."""
    return float(np.arctan2(R_level_body[1, 0], R_level_body[0, 0]))
