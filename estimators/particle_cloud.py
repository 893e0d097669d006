"""Particles that follow odometry increments and are held against UWB ranges and known landmarks.

A particle is a row of 12 numbers: pose (x, y, yaw) and velocity (vx, vy, yaw rate) in the map, the pose at
which the odometry's current keyframe was taken, and the pose at the last increment. An increment puts it
where ``keyframe pose (+) (increment + noise)`` is, with noise drawn anew from the increment's covariance;
what ranges said of the keyframe's pose stays in the weights. In between, it moves with constant velocity.
"""

from abc import abstractmethod
from math import isfinite
from typing import ClassVar

import numpy as np
from pydantic import Field
from scipy.stats import chi2

from estimators.base import Report, Setup, Verdict
from estimators.geometry import lift
from estimators.lidar.keyframes import START_SPEED_SIGMA, KeyframeTracker
from estimators.messages import (
    FloatArray,
    LandmarkFrame,
    Measurement,
    PoseEstimate,
    PoseIncrement,
    RangeFrame,
)
from estimators.models.motion import constant_velocity
from estimators.range_gate import Candidate, RangeGate

POSE, VELOCITY, KEYFRAME, LAST = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
_NO_RANGES, _NO_LANDMARKS = np.empty((0, 4)), np.empty((0, 6))


class ParticleCloud(KeyframeTracker):
    """Motion, gating and output of every particle filter; how measurements change it is the subclass's.

    Every range of a frame, and every landmark, is gated by its NIS against the cloud before any of them
    counts.
    """

    class Config(RangeGate.Config, KeyframeTracker.Config):
        """Settings of every particle filter."""

        PARAMETER: ClassVar[str] = "particles"

        particles: int = Field(200, ge=10, le=100_000, description="number of particles")
        landmark_gate: float = Field(
            0.99999, gt=0.5, lt=1, description="share of good landmark ranges and bearings that pass"
        )
        seed: int = Field(1, ge=0, description="of everything random in the filter")

    def __init__(self, config: Config, setup: Setup) -> None:
        # Numba loads slowly: only who makes a filter waits for it.
        from estimators.kernels import cloud, likelihood

        super().__init__(config, setup)
        self._cloud, self._likelihood = cloud, likelihood
        self._usual_count = config.particles
        self._seed = config.seed
        self._gate = RangeGate(config, setup)
        self._landmark_gate = float(chi2.ppf(config.landmark_gate, 1))
        self._landmarks = {i: tuple(position.tolist()) for i, position in setup.landmarks.items()}
        self._arm = setup.tag_in_body
        self.reset()

    def reset(self) -> None:
        """Stand at the start again, trust every anchor, and draw the same numbers again."""
        super().reset()
        self._gate.reset()
        self._rng = np.random.default_rng(self._seed)
        self._count = self._usual_count
        self._particles = np.zeros((self._count, 12))
        self._weights = np.full(self._count, 1.0 / self._count)
        start = self._setup.start
        self._particles[:, POSE] = start.pose + start.sigma * self._noise_beside(POSE)
        self._particles[:, KEYFRAME] = self._particles[:, LAST] = self._particles[:, POSE]
        self._last_ns = 0

    @property
    def particles(self) -> tuple[FloatArray, FloatArray]:
        """Particles (N, 12) and weights (N,) at the newest measurement, for tests and pictures."""
        return self._particles.copy(), self._weights.copy()

    def update(self, measurement: Measurement) -> Report:
        """Predict to the measurement's time and take it; scans only show what blocks ranges."""
        if isinstance(measurement, RangeFrame):
            if self._is_late(measurement.stamp_ns):
                return Report((Verdict.LATE,) * len(measurement.ranges))
            self._predict_to(measurement.stamp_ns)
            return self._update_ranges(measurement)
        if isinstance(measurement, LandmarkFrame):
            if self._is_late(measurement.stamp_ns):
                return Report((Verdict.LATE,))
            self._predict_to(measurement.stamp_ns)
            return Report((self._update_landmarks(measurement),))
        report = super().update(measurement)
        self._gate.see(measurement, self.pose_at)
        return report

    def pose_at(self, stamp_ns: int) -> PoseEstimate | None:
        """Mean and covariance, predicted with constant velocity; None before the first measurement."""
        if self._stamp_ns is None:
            return None
        mean, cov = self._cloud.moments(self._particles, self._weights, 6)
        dt = 0.0 if self._stands else (stamp_ns - self._stamp_ns) * 1e-9
        F, Q = constant_velocity(dt, *self._accel_noise)
        planar = (F @ cov @ F.T + Q)[POSE, POSE]
        cov = self._setup.lift_covariance(0.5 * (planar + planar.T) + self._cloud.LEAST_VARIANCE * np.eye(3))
        return PoseEstimate(stamp_ns, lift((F @ mean)[POSE], self._setup.height), cov, reset_counter=0)

    @abstractmethod
    def _settle(
        self, before: FloatArray, effective: float, ranges: FloatArray, landmarks: FloatArray
    ) -> None:
        """Do what follows when measurements have been taken into the weights.

        Args:
            before: (N,) weights without them.
            effective: sample size with them.
            ranges: (M, 4) as in `estimators.kernels`; those with infinite sigma do not count.
            landmarks: (L, 6) likewise.
        """

    def _noise_beside(self, columns: slice) -> FloatArray:
        """Standard normal numbers (N, 3) beside columns of the particles, see `kernels.cloud.match`."""
        noise = self._rng.standard_normal((self._count, 3))
        self._cloud.match(noise, self._particles, self._weights, columns.start, columns.stop)
        return noise

    def _set_speed_free(self) -> None:
        self._particles[:, VELOCITY] = START_SPEED_SIGMA * self._noise_beside(POSE)

    def _move(self, dt: float) -> None:
        if dt > 0.0:
            self._cloud.move(self._particles, self._noise_beside(POSE), dt, *self._accel_noise)

    def _follow(self, measured: PoseIncrement) -> Report:
        residuals = self._cloud.increment_residuals(self._particles, measured.increment)
        innovation = self._weights @ residuals
        deviations = residuals - innovation
        S = (self._weights * deviations.T) @ deviations + measured.cov
        nis = float(innovation @ np.linalg.solve(S, innovation))
        report = np.full(1, np.nan), np.array([nis])
        if nis > self._increment_gate:
            return Report((Verdict.GATED,), *report)
        values, vectors = np.linalg.eigh(measured.cov)
        noise = self._noise_beside(KEYFRAME) @ (vectors * np.sqrt(values)).T
        assert self._stamp_ns is not None
        dt = (self._stamp_ns - self._last_ns) * 1e-9
        self._cloud.follow(self._particles, measured.increment + noise, dt)
        self._last_ns = self._stamp_ns
        return Report((Verdict.ACCEPTED,), *report)

    def _take_reference(self) -> None:
        assert self._stamp_ns is not None
        self._particles[:, KEYFRAME] = self._particles[:, LAST] = self._particles[:, POSE]
        self._last_ns = self._stamp_ns

    def _update_ranges(self, frame: RangeFrame) -> Report:
        count = len(frame.ranges)
        verdicts = [Verdict.ACCEPTED] * count
        innovations, nis = np.full(count, np.nan), np.full(count, np.nan)
        candidates: dict[int, Candidate] = {}
        mean, _ = self._cloud.moments(self._particles, self._weights, 3)
        for i, item in enumerate(self._gate.candidates(frame, mean)):
            if isinstance(item, Verdict):
                verdicts[i] = item
            else:
                candidates[i] = item
        if not candidates:
            return Report(tuple(verdicts), innovations, nis)
        used = list(candidates)
        ranges = np.array([(c.anchor[0], c.anchor[1], c.measured, c.sigma) for c in candidates.values()])
        doubted = np.array([c.log_odds > 0.0 for c in candidates.values()])
        residuals = self._residuals(ranges, _NO_LANDMARKS)
        innovations[used], nis[used] = self._likelihood.innovations(
            residuals, self._weights, ranges[:, 3].copy(), self._gate.limit, doubted
        )
        for k, (i, candidate) in enumerate(candidates.items()):
            verdicts[i], factor = self._gate.judge(candidate, innovations[i], nis[i])
            ranges[k, 3] *= factor if verdicts[i].is_used else np.inf
        if any(verdict.is_used for verdict in verdicts):
            self._weigh(residuals, ranges, _NO_LANDMARKS)
        return Report(tuple(verdicts), innovations, nis)

    def _update_landmarks(self, frame: LandmarkFrame) -> Verdict:
        seen = zip(frame.landmark_ids.tolist(), frame.ranges.tolist(), frame.bearings.tolist(), strict=True)
        known = [
            (*self._landmarks[i], r, b, frame.range_sigma, frame.bearing_sigma)
            for i, r, b in seen
            if i in self._landmarks
        ]
        if not known:
            return Verdict.NOT_USED
        landmarks = np.array([row for row in known if _is_possible(*row[2:])]).reshape(-1, 6)
        if len(landmarks) == 0:
            return Verdict.IMPOSSIBLE
        residuals = self._residuals(_NO_RANGES, landmarks)
        doubted = np.zeros(residuals.shape[1], dtype=np.bool_)
        sigmas = landmarks[:, 4:].ravel()
        _, nis = self._likelihood.innovations(residuals, self._weights, sigmas, self._landmark_gate, doubted)
        passed = (nis.reshape(-1, 2) <= self._landmark_gate).all(axis=1)
        if not passed.any():
            return Verdict.GATED
        landmarks[~passed, 4:] = np.inf
        self._weigh(residuals, _NO_RANGES, landmarks)
        return Verdict.ACCEPTED

    def _residuals(self, ranges: FloatArray, landmarks: FloatArray) -> FloatArray:
        residuals: FloatArray = self._likelihood.residuals(self._particles, self._arm, ranges, landmarks)
        return residuals

    def _weigh(self, residuals: FloatArray, ranges: FloatArray, landmarks: FloatArray) -> None:
        """Take measurements, as `estimators.kernels` has them; those with infinite sigma do not count."""
        before = self._weights.copy()
        effective = self._likelihood.reweigh(self._weights, residuals, sigmas_of(ranges, landmarks))
        self._settle(before, effective, ranges, landmarks)


def _is_possible(distance: float, bearing: float, range_sigma: float, bearing_sigma: float) -> bool:
    """Whether a landmark's numbers are numbers, and positive where they must be."""
    return (
        0.0 < distance < np.inf
        and isfinite(bearing)
        and 0.0 < range_sigma < np.inf
        and 0.0 < bearing_sigma < np.inf
    )


def sigmas_of(ranges: FloatArray, landmarks: FloatArray) -> FloatArray:
    """Standard deviations (M + 2 L,) of measurements, in the order of their residuals."""
    return np.concatenate([ranges[:, 3], landmarks[:, 4:].ravel()])
