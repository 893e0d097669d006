"""Particle filter on solved positions: what momentum gradient descent finds, smoothed by a motion model."""

from dataclasses import replace
from math import exp

import numpy as np
from pydantic import Field

from estimators.base import Report, Setup
from estimators.geometry import lift
from estimators.messages import FloatArray, Measurement, PoseEstimate
from estimators.resampling import stratified
from estimators.uwb.frame_solver import TagFix
from estimators.uwb.gradient_descent import MomentumGradientDescent

TAIL_FREEDOM = 3.0
"""Degrees of freedom of the Student law of solved positions: a gross error must not decide alone."""
KEPT_SHARE = 0.1
"""Share of the resampled particles that are drawn whatever their weight."""
BLOCKED_TIME = 2.0
"""What blocks a range stays for about so long [s]."""
START_SPEED_SIGMA = 0.5
"""Standard deviation of each velocity of a tag that is seen for the first time [m/s]."""


class GdPf:
    """Particles of position and velocity, weighted by how close they are to the position of each frame.

    Heavy particles are kept by layered random resampling, and some light ones with them, which carry the
    weight that corrects for it. It knows no heading, like the solver that it is built on.

    Source: li2022 "GD-PF", steps 1-6; weights and motion noise chosen here, as the formulas are lost.
    """

    class Config(MomentumGradientDescent.Config):
        """Settings of `gd_pf`."""

        particles: int = Field(2000, ge=10, le=100_000, description="how many")
        accel_noise: float = Field(
            0.5,
            gt=0,
            le=100,
            description="density of white acceleration [m/s^2/sqrt(Hz)]: about the robot's acceleration "
            "times the square root of how long it lasts",
        )
        max_silence: float = Field(
            2.0, gt=0, le=60, description="after so long without a position it starts anew [s]"
        )
        seed: int = Field(1, ge=0, description="of the random numbers")

    def __init__(self, config: Config, setup: Setup) -> None:
        self._config = config
        self._setup = setup
        self._solver = MomentumGradientDescent(config, setup)
        self._lever_variance = float(setup.tag_in_body[:2] @ setup.tag_in_body[:2]) / 2.0
        self.reset()

    def reset(self) -> None:
        """Forget every particle and begin the random numbers again."""
        self._solver.reset()
        self._rng = np.random.default_rng(self._config.seed)
        self._stamp_ns: int | None = None
        self._common_sigma = 0.0
        self._reset_counter = -1

    @property
    def fix(self) -> TagFix | None:
        """Mean and covariance of the particles at the newest frame; None before the first.

        Its disagreement is not the frame's alone: what pulled the particles aside stays in their mean.
        """
        return self._fix if self._stamp_ns is not None else None

    def update(self, measurement: Measurement) -> Report:
        """Solve a RangeFrame of the one tag and move the particles to it; other measurements are not used."""
        before = self._solver.fix
        report = self._solver.update(measurement)
        solved = self._solver.fix
        if solved is not None and solved is not before:
            self._follow(solved)
        return report

    def pose_at(self, stamp_ns: int) -> PoseEstimate | None:
        """Mean of the particles moved to a time; None after `max_age`. Yaw variance is infinite."""
        fix = self.fix
        if fix is None or abs(dt := (stamp_ns - fix.stamp_ns) * 1e-9) > self._config.max_age:
            return None
        moved = self._positions + dt * self._velocities
        position, spread = _moments(moved, self._weights)
        # White acceleration over the time from the frame.
        growth = self._config.accel_noise**2 * abs(dt) ** 3 / 3.0
        cov = self._setup.lift_covariance(np.diag([self._lever_variance, self._lever_variance, np.inf]))
        d = len(position)
        cov[2, 2] = fix.cov[2, 2] if d == 2 else 0.0
        cov[:d, :d] += spread + growth * np.eye(d)
        if np.isinf(fix.cov[2, 2]):
            cov[2, :] = cov[:, 2] = 0.0
            cov[2, 2] = np.inf
        height = (position[2] if d == 3 else fix.position[2]) - self._setup.tag_in_body[2]
        return PoseEstimate(stamp_ns, lift(np.array([*position[:2], 0.0]), height), cov, self._reset_counter)

    def _follow(self, solved: TagFix) -> None:
        """One cycle of the filter: predict, weigh, resample, mean."""
        dt = 0.0 if self._stamp_ns is None else (solved.stamp_ns - self._stamp_ns) * 1e-9
        if self._stamp_ns is None or dt > self._config.max_silence:
            self._scatter(solved)
        else:
            self._predict(dt)
            self._weigh(solved)
        self._stamp_ns = solved.stamp_ns
        mean, spread = _moments(self._positions, self._weights)
        position, cov = solved.position.copy(), solved.cov.copy()
        position[: len(mean)], cov[: len(mean), : len(mean)] = mean, spread
        if np.isinf(solved.cov[2, 2]):
            cov[2, 2] = np.inf
        # The mean takes of what a frame errs by the filter's gain. A frame that agrees by chance while
        # something blocks a range takes nothing of it away.
        gain = min(1.0, float(np.trace(cov[:2, :2]) / np.trace(solved.widened_cov[:2, :2])))
        taken = (1.0 - gain) * self._common_sigma + gain * solved.common_sigma
        self._common_sigma = max(taken, self._common_sigma * exp(-dt / BLOCKED_TIME))
        disagreement = 1.0 + 2.0 * self._common_sigma**2 / float(np.trace(cov[:2, :2]))
        self._fix = replace(solved, position=position, cov=cov, disagreement=disagreement)
        self._resample()

    def _scatter(self, solved: TagFix) -> None:
        """Start anew about a position, with any walking speed."""
        count, dimensions = self._config.particles, self._config.dimensions
        cov = solved.widened_cov[:dimensions, :dimensions]
        cov = np.where(np.isfinite(cov), cov, self._setup.height_sigma**2)
        noise = self._rng.standard_normal((2, count, dimensions))
        self._positions = solved.position[:dimensions] + noise[0] @ np.linalg.cholesky(cov).T
        self._velocities = START_SPEED_SIGMA * noise[1]
        self._weights = np.full(count, 1.0 / count)
        self._reset_counter += 1

    def _predict(self, dt: float) -> None:
        """Constant velocity with white acceleration; position and velocity err together as it makes them."""
        noise = self._rng.standard_normal((2, *self._positions.shape))
        density = self._config.accel_noise
        gained = density * np.sqrt(dt) * noise[0]
        self._positions = (
            self._positions
            + dt * (self._velocities + 0.5 * gained)
            + density * np.sqrt(dt**3 / 12.0) * noise[1]
        )
        self._velocities = self._velocities + gained

    def _weigh(self, solved: TagFix) -> None:
        known = solved.dimensions
        off = self._positions[:, :known] - solved.position[:known]
        information = np.linalg.inv(solved.widened_cov[:known, :known])
        squares = np.einsum("ni,ij,nj->n", off, information, off)
        tails = (TAIL_FREEDOM + known) / 2.0 * np.log1p(squares / TAIL_FREEDOM)
        log_weights = np.log(self._weights) - tails
        weights = np.exp(log_weights - log_weights.max())
        # What is too light to be a number keeps a weight, so that its logarithm is one.
        self._weights = np.maximum(weights / weights.sum(), 1e-300)

    def _resample(self) -> None:
        count = len(self._weights)
        share = (1.0 - KEPT_SHARE) * self._weights + KEPT_SHARE / count
        kept = stratified(share, count, self._rng)
        self._positions, self._velocities = self._positions[kept], self._velocities[kept]
        weights = self._weights[kept] / share[kept]
        self._weights = weights / weights.sum()


def _moments(points: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weighted mean (D,) and covariance (D, D) of points (N, D)."""
    mean = weights @ points
    off = points - mean
    return mean, (weights[:, None] * off).T @ off
