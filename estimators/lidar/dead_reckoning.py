"""Increments chained from a known start: what a LiDAR says by itself, without filter or motion model."""

import numpy as np

from estimators.base import Report, Setup, Verdict
from estimators.geometry import between, compose, exponential, lift, logarithm
from estimators.messages import FloatArray, Measurement, PoseEstimate, PoseIncrement, RangeFrame
from estimators.models.motion import increment

START_SIGMA = 1e-6
"""Standard deviation of the known start [m, rad]: next to nothing, but no singular covariance."""


class DeadReckoning:
    """Sum of the increments, and the covariance that they claim in sum.

    It is told the true start, so that all of its error is drift. Between increments it goes on with the
    velocity of the last one, and its covariance stays that of the increments.

    Args:
        setup: of the site; its start does not count.
        start: (3,) true x [m], y [m], yaw [rad] at the beginning, map frame.

    Source: huang2024 experiment 2, Table 4, column "LiDAR".
    """

    def __init__(self, setup: Setup, start: FloatArray) -> None:
        self._setup = setup
        self._start = start
        self.reset()

    def reset(self) -> None:
        """Stand at the start again."""
        self._pose = self._reference = self._start
        self._cov = self._reference_cov = START_SIGMA**2 * np.eye(3)
        self._stamp_ns: int | None = None
        self._reference_stamp_ns: int | None = None
        self._velocity = np.zeros(3)

    def update(self, measurement: Measurement) -> Report:
        """Add an increment; other measurements are not used."""
        if not isinstance(measurement, PoseIncrement):
            count = len(measurement.ranges) if isinstance(measurement, RangeFrame) else 1
            return Report((Verdict.NOT_USED,) * count)
        stamp_ns = measurement.stamp_ns
        if self._stamp_ns is not None and stamp_ns < self._stamp_ns:
            return Report((Verdict.LATE,))
        if not (np.isfinite(measurement.increment).all() and np.isfinite(measurement.cov).all()):
            return Report((Verdict.IMPOSSIBLE,))
        if measurement.from_stamp_ns == stamp_ns:
            self._pose = self._extrapolated(stamp_ns)
        elif measurement.from_stamp_ns == self._reference_stamp_ns:
            self._add(measurement)
        else:
            return Report((Verdict.NO_REFERENCE,))
        self._stamp_ns = stamp_ns
        if measurement.is_keyframe:
            self._reference, self._reference_cov = self._pose, self._cov
            self._reference_stamp_ns = stamp_ns
        return Report((Verdict.ACCEPTED,))

    def pose_at(self, stamp_ns: int) -> PoseEstimate | None:
        """The sum at the newest increment, carried on with its velocity; None before the first."""
        if self._stamp_ns is None:
            return None
        T_map_body = lift(self._extrapolated(stamp_ns), self._setup.height)
        return PoseEstimate(stamp_ns, T_map_body, self._setup.lift_covariance(self._cov), 0)

    def _extrapolated(self, stamp_ns: int) -> FloatArray:
        dt = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) * 1e-9
        return compose(self._pose, exponential(self._velocity * dt))

    def _add(self, measured: PoseIncrement) -> None:
        assert self._stamp_ns is not None
        pose = compose(self._reference, measured.increment)
        dt = (measured.stamp_ns - self._stamp_ns) * 1e-9
        self._velocity = logarithm(between(self._pose, pose)) / dt if dt else np.zeros(3)
        _, by_reference, by_pose = increment(self._reference, pose)
        G = np.linalg.inv(by_pose)
        F = -G @ by_reference
        self._pose = pose
        self._cov = F @ self._reference_cov @ F.T + G @ measured.cov @ G.T
