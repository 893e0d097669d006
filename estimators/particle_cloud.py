"""Particles that follow odometry increments and are held against UWB ranges and known landmarks.

A particle is a row of 9 numbers: pose (x, y, yaw) and velocity (vx, vy, yaw rate) in the map, and the pose at
which the odometry's current keyframe was taken. It moves with constant velocity and white acceleration; an
increment corrects how it moved since the keyframe (`kernels.motion.take_increment`), by which no particle
gains on another. Ranges, landmarks and scans do weigh the particles.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar, TypeAlias

import numpy as np
from pydantic import Field

from estimators.base import Report, Setup, Sketch, Verdict
from estimators.fix_taker import FixTaker
from estimators.immutable import immutable
from estimators.lidar.keyframes import START_SPEED_SIGMA
from estimators.messages import (
    FloatArray,
    LandmarkFrame,
    PoseEstimate,
    PoseIncrement,
    RangeFrame,
)
from estimators.range_gate import Candidates, RangeGate

POSE, VELOCITY, KEYFRAME = slice(0, 3), slice(3, 6), slice(6, 9)
_NO_RANGES, _NO_LANDMARKS = np.empty((0, 4)), np.empty((0, 6))


Likelihood: TypeAlias = Callable[[FloatArray], FloatArray]
"""Particles (N, 9) -> negative logarithm (N,) of how likely they make a measurement."""


@immutable
class Fixes:
    """Ranges and landmarks that passed their gates, as `estimators.kernels` has them: a `Likelihood`."""

    misfits: Callable[[FloatArray, FloatArray, FloatArray, FloatArray], FloatArray]
    arm: FloatArray
    ranges: FloatArray
    landmarks: FloatArray

    def __call__(self, particles: FloatArray) -> FloatArray:
        """Misfits (N,) of particles (N, 3 or more)."""
        return self.misfits(particles, self.arm, self.ranges, self.landmarks)


class ParticleCloud(FixTaker):
    """Motion, gating and output of every particle filter; how measurements change it is the subclass's.

    Every range of a frame, and every landmark, is gated by its NIS against the cloud before any of them
    counts. What a tag's ranges add by bearing is taken off at the mean pose, for all particles alike.
    """

    class Config(FixTaker.Config):
        """Settings of every particle filter."""

        PARAMETER: ClassVar[str] = "particles"

        particles: int = Field(200, ge=10, le=100_000, description="number of particles")
        seed: int = Field(1, ge=0, description="of everything random in the filter")

    def __init__(self, config: Config, setup: Setup) -> None:
        # Numba loads slowly: only who makes a filter waits for it.
        from estimators.kernels import cloud, likelihood, motion, scan

        super().__init__(config, setup)
        self._cloud, self._likelihood, self._motion, self._scan = cloud, likelihood, motion, scan
        self._count = config.particles
        self._seed = config.seed
        self._arm = setup.tag_in_body
        self.reset()

    def reset(self) -> None:
        """Stand at the start again, trust every anchor, and draw the same numbers again."""
        self.judged: Candidates | None = None
        """The newest frame of ranges; their sigmas are those they were used with, infinite without."""
        self._rng = np.random.default_rng(self._seed)
        super().reset()

    @property
    def particles(self) -> tuple[FloatArray, FloatArray]:
        """Particles (N, 9) and weights (N,) at the newest measurement, for tests and pictures."""
        return self._particles.copy(), self._weights.copy()

    def sketch(self) -> Sketch:
        """The particles' poses at the newest measurement."""
        return Sketch(particles=self._particles[:, POSE].copy())

    @property
    def mean(self) -> FloatArray:
        """Mean pose (3,) at the newest measurement: x [m], y [m], yaw [rad], map frame."""
        mean, _ = self._cloud.moments(self._particles, self._weights, 3)
        return mean

    @property
    def gate(self) -> RangeGate:
        """What judges ranges, for those who take up where the cloud leaves off."""
        return self._gate

    def pose_at(self, stamp_ns: int) -> PoseEstimate | None:
        """Mean and covariance, predicted with constant velocity; None before the first measurement."""
        if self._stamp_ns is None or not self._reaches(stamp_ns):
            return None
        mean, cov = self._cloud.moments(self._particles, self._weights, 6)
        dt = 0.0 if self._stands else (stamp_ns - self._stamp_ns) * 1e-9
        mean, cov = self._motion.predicted(mean, cov, dt, *self._accel_noise)
        cov.flat[::7] += self._cloud.LEAST_VARIANCE
        return self._estimate(stamp_ns, mean, cov)

    @abstractmethod
    def _take(self, misfits: FloatArray, measured: Likelihood) -> None:
        """Take measurements into the cloud.

        Args:
            misfits: (N,) what `measured` says of the particles as they are.
            measured: says the same of others.
        """

    def _place(self, pose: FloatArray, cov: FloatArray) -> None:
        self._gate.reset()
        self._particles = np.zeros((self._count, 9))
        self._weights = np.full(self._count, 1.0 / self._count)
        self._particles[:, POSE] = pose + self._matched_noise() @ root(cov).T
        self._particles[:, KEYFRAME] = self._particles[:, POSE]

    def _noise(self) -> FloatArray:
        return self._rng.standard_normal((self._count, 3))

    def _matched_noise(self) -> FloatArray:
        noise = self._noise()
        self._cloud.match(noise, self._particles, self._weights)
        return noise

    def _set_speed_free(self) -> None:
        self._particles[:, VELOCITY] = START_SPEED_SIGMA * self._matched_noise()

    def _move(self, dt: float) -> None:
        if dt > 0.0:
            self._motion.move(self._particles, self._weights, self._noise(), dt, *self._accel_noise)

    def _follow(self, measured: PoseIncrement) -> Report:
        nis = self._motion.take_increment(
            self._particles,
            self._weights,
            self._noise(),
            measured.increment,
            measured.cov,
            self._increment_gate,
        )
        verdict = Verdict.ACCEPTED if nis <= self._increment_gate else Verdict.GATED
        return Report((verdict,), np.full(1, np.nan), np.array([nis]))

    def _take_reference(self) -> None:
        self._particles[:, KEYFRAME] = self._particles[:, POSE]

    def _update_ranges(self, frame: RangeFrame) -> Report:
        pose, spread = self._cloud.moments(self._particles, self._weights, 3)
        candidates = self._gate.horizontal.of(frame, pose, spread[2, 2])
        arm = self._setup.arm(frame.tag_id)
        expected = self._likelihood.expected_residuals(self._particles, self._weights, arm, candidates.rows)
        report = self._gate.judge_together(candidates, *expected)
        self.judged = candidates
        if any(verdict.is_used for verdict in report.verdicts):
            fixes = Fixes(self._likelihood.misfits, arm, candidates.rows, _NO_LANDMARKS)
            self._take(fixes(self._particles), fixes)
        return report

    def _update_landmarks(self, frame: LandmarkFrame) -> Verdict:
        landmarks = self._landmark_gate.usable(frame)
        if isinstance(landmarks, Verdict):
            return landmarks
        _, misfits = self._likelihood.gated_misfits(
            self._particles, self._weights, landmarks, self._landmark_gate.limit
        )
        if np.isinf(landmarks[:, 4]).all():
            return Verdict.GATED
        self._take(misfits, Fixes(self._likelihood.misfits, self._arm, _NO_RANGES, landmarks))
        return Verdict.ACCEPTED


def root(cov: FloatArray) -> FloatArray:
    """Matrix whose product with its transpose is a covariance, which may be singular."""
    values, vectors = np.linalg.eigh(cov)
    root: FloatArray = vectors * np.sqrt(np.maximum(values, 0.0))
    return root
