"""Odometry increments from a known start, in stamp order: what every estimator on them does alike."""

from abc import ABC, abstractmethod
from math import isfinite

import numpy as np
from pydantic import Field

from estimators import chi2
from estimators.base import Report, Setup, Verdict
from estimators.geometry import lift
from estimators.messages import FloatArray, Measurement, PoseEstimate, PoseIncrement, RangeFrame
from estimators.models.motion_settings import WhiteAcceleration

FURTHEST_NS = 600_000_000_000
"""Further than this from the newest measurement nothing is said of the pose: it may be kilometres away."""
START_SPEED_SIGMA = 0.3
"""Standard deviation of each velocity when the robot sets off [m/s, rad/s]."""


class KeyframeTracker(ABC):
    """Follows increments that start at keyframes; the robot may stand still at first.

    What is held of the pose, and how it is moved and corrected, is the subclass's.
    """

    class Config(WhiteAcceleration):
        """Settings of every estimator on increments."""

        increment_gate: float = Field(
            0.99999, gt=0.5, lt=1, description="share of good increments that pass the NIS gate"
        )

    def __init__(self, config: Config, setup: Setup) -> None:
        self._setup = setup
        self._accel_noise = (config.accel_noise, config.yaw_accel_noise)
        self._increment_gate = float(chi2.ppf(config.increment_gate, 3))

    def reset(self) -> None:
        """Stand at the start again; the first measurement sets the clock."""
        self._stamp_ns: int | None = None
        self._stands_until_ns: int | None = None
        self._reference_stamp_ns: int | None = None
        self._stands = True
        self._reset_counter = 0
        start = self._setup.start
        self._place(start.pose, np.diag(start.sigma**2))

    def start_at(self, stamp_ns: int, pose: FloatArray, cov: FloatArray) -> None:
        """Forget the past: at this moment the robot is here, and moves freely from then on.

        Increments that start at this moment are followed; those from earlier keyframes no longer are.

        Args:
            stamp_ns: the moment; it may be earlier than measurements already taken.
            pose: (3,) x [m], y [m], yaw [rad] of the body, map frame.
            cov: (3, 3) covariance of the same.
        """
        self._stamp_ns = self._stands_until_ns = self._reference_stamp_ns = stamp_ns
        self._stands = False
        self._reset_counter += 1
        self._place(pose, cov)
        self._set_speed_free()

    def update(self, measurement: Measurement) -> Report:
        """Predict to an increment's time and take it; other measurements are not used."""
        if isinstance(measurement, PoseIncrement):
            if self._is_late(measurement.stamp_ns):
                return Report((Verdict.LATE,))
            report = self._update_increment(measurement)
            if measurement.is_keyframe:
                if report.verdicts != (Verdict.ACCEPTED,):
                    self._begin_anew()  # the new reference is tied to no earlier one
                self._take_reference()
                self._reference_stamp_ns = measurement.stamp_ns
            return report
        count = len(measurement.ranges) if isinstance(measurement, RangeFrame) else 1
        return Report((Verdict.NOT_USED,) * count)

    @abstractmethod
    def pose_at(self, stamp_ns: int) -> PoseEstimate | None:
        """Pose at an instant; None before the first measurement or further than `FURTHEST_NS` away."""

    @abstractmethod
    def _place(self, pose: FloatArray, cov: FloatArray) -> None:
        """Forget everything: the pose, which is the reference too, is this, and the speed zero."""

    @abstractmethod
    def _set_speed_free(self) -> None:
        """The robot, which stood, may have any speed from here on."""

    @abstractmethod
    def _move(self, dt: float) -> None:
        """Predict by a time step [s] that is not negative."""

    @abstractmethod
    def _follow(self, measured: PoseIncrement) -> Report:
        """Gate an increment from the held reference and take it."""

    @abstractmethod
    def _take_reference(self) -> None:
        """The pose of now is where later increments start."""

    def _begin_anew(self) -> None:  # noqa: B027
        """An odometry without an earlier reference begins now."""

    def _set_off(self) -> None:
        """From here on the robot may move: a start heading that is held until now must not fade before."""
        if self._stands:
            self._stands = False
            self._set_speed_free()

    def _estimate(
        self, stamp_ns: int, state: FloatArray, cov: FloatArray, heading_known: bool = True
    ) -> PoseEstimate:
        """What is given out of a state.

        Args:
            stamp_ns: for which it holds.
            state: (6,) x [m], y [m], yaw [rad] and their rates, along the map's axes.
            cov: (6, 6) of the same.
            heading_known: False makes the variance of yaw infinite.
        """
        planar = cov[:3, :3].copy()
        planar.flat[:5:4] += self._doubt(stamp_ns) ** 2
        if not heading_known:
            planar[2, :2] = planar[:2, 2] = 0.0
            planar[2, 2] = np.inf
        # It walks level: what it does upward is as uncertain as its height within a second.
        velocity, velocity_cov = np.zeros(3), np.zeros((3, 3))
        velocity[:2], velocity_cov[:2, :2] = state[3:5], cov[3:5, 3:5]
        velocity_cov[2, 2] = self._setup.height_sigma**2
        return PoseEstimate(
            stamp_ns,
            lift(state[:3], self._setup.height),
            self._setup.lift_covariance(planar),
            self._reset_counter,
            velocity,
            velocity_cov,
        )

    def _doubt(self, stamp_ns: int) -> float:  # noqa: ARG002
        """How far the position may be off besides what the state's covariance says [m]."""
        return 0.0

    def _reaches(self, stamp_ns: int) -> bool:
        """Whether anything is said of the pose at a time."""
        return self._stamp_ns is not None and abs(stamp_ns - self._stamp_ns) <= FURTHEST_NS

    def _is_late(self, stamp_ns: int) -> bool:
        return self._stamp_ns is not None and stamp_ns < self._stamp_ns

    def _predict_to(self, stamp_ns: int) -> None:
        if self._stamp_ns is None or self._stands_until_ns is None:
            self._stamp_ns = stamp_ns
            self._stands_until_ns = stamp_ns + round(self._setup.start.still_for * 1e9)
        if stamp_ns > self._stands_until_ns:
            self._set_off()
        if not self._stands:
            self._move((stamp_ns - self._stamp_ns) * 1e-9)
        self._stamp_ns = stamp_ns

    def _update_increment(self, measured: PoseIncrement) -> Report:
        founds = measured.from_stamp_ns == measured.stamp_ns
        has_reference = measured.from_stamp_ns == self._reference_stamp_ns
        is_possible = bool(np.isfinite(measured.increment).all()) and is_covariance(measured.cov)
        if has_reference and is_possible and not founds:
            self._set_off()
        self._predict_to(measured.stamp_ns)
        if founds:
            self._begin_anew()
            return Report((Verdict.ACCEPTED,))
        if not (has_reference and is_possible):
            return Report((Verdict.NO_REFERENCE if is_possible else Verdict.IMPOSSIBLE,))
        return self._follow(measured)


def is_covariance(cov: FloatArray) -> bool:
    """Whether a matrix (3, 3) is finite and positive definite: its pivots are positive."""
    numbers = cov.ravel().tolist()
    if not all(map(isfinite, numbers)):
        return False
    xx, _, _, xy, yy, _, xz, yz, zz = numbers
    if xx <= 0.0:
        return False
    second = yy - xy * xy / xx
    return second > 0.0 and zz - xz * xz / xx - (yz - xy * xz / xx) ** 2 / second > 0.0
