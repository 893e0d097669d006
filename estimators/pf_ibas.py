"""Particle filter whose particles a beetle search moves to where the measurements are (PF-IBAS).

The consistent variant, `pf_ibas`, weighs particles as `pf` does. When too few of them keep any weight, it
writes the posterior of the pose down, searches it, and samples it anew:

    p(x | z) ~ N(x; m, P) exp(-1/2 sum_j ((z_j - h_j(x)) / sigma_j)^2)                        cf. Eq. (26)

with m and P of the cloud before the measurements. The first factor, the motion prior, is what the paper's
fitness leaves out.

1. The particles are the beetles. IBAS moves them up p, in coordinates where the cloud is a unit Gaussian.
2. A Gauss-Newton step from the best place gives the mode x* and the information matrix A there.
3. New particles x_i are drawn from q, a multivariate t distribution around x* of scatter A^-1: near p, but
   with heavier tails.
4. Weights w_i ~ p(x_i | z) / q(x_i) make them samples of p, wherever the search has ended.

What else a particle holds is that of an old one, moved along as far as it hangs together with the pose. It
remains an approximation that the cloud counts as Gaussian; one without a heading is therefore not searched.

The printed variant, `pf_ibas_printed`, does the paper's steps 1 to 7: particles go to the peak of the
likelihood alone and are weighted by it as if they were samples of the prior. Its covariance means little.
"""

import numpy as np
from pydantic import Field

from estimators.base import Setup
from estimators.beetle_antennae import PrintedImprovedBeetleAntennaeSearch
from estimators.messages import FloatArray
from estimators.particle_cloud import POSE, ParticleCloud, sigmas_of
from estimators.particle_filter import ParticleFilter
from estimators.resampling import systematic

_SEARCH_BELOW = 0.5
"""Share of effective particles above which the best of them is near enough to the mode without a search."""
_PRINTED_SEARCH = PrintedImprovedBeetleAntennaeSearch(step=0.15)
"""The paper gives the filter no step. Its benchmark's, 5 in domains of +-100, is this one in +-3 sigma."""
_ALL = slice(0, 12)
"""Columns of a particle."""


class PfIbas(ParticleFilter):
    """PF-IBAS with the motion prior in the fitness and weights that account for the move.

    Source: huang2024 Eq. (15)-(28), corrected; importance sampling around the mode: Doucet, Godsill and
    Andrieu, Statistics and Computing 10, 2000, II.D.
    """

    class Config(ParticleFilter.Config):
        """Settings of `pf_ibas`."""

        particles: int = Field(
            40, ge=10, le=100_000, description="number of particles, which are the beetles"
        )
        iterations: int = Field(2, ge=0, le=1000, description="moves of each beetle in a search")
        resample_below: float = Field(
            0.9, gt=0, le=1, description="sample anew when the effective sample size is below this share"
        )
        tail_freedom: float = Field(
            30.0, gt=2, le=1000, description="degrees of freedom of the t distribution drawn from"
        )

    def __init__(self, config: Config, setup: Setup) -> None:
        from estimators.kernels import posterior

        self._posterior = posterior
        self._iterations = config.iterations
        self._freedom = config.tail_freedom
        super().__init__(config, setup)

    def _noise_beside(self, columns: slice) -> FloatArray:  # noqa: ARG002
        return super()._noise_beside(_ALL)

    def _settle(
        self, before: FloatArray, effective: float, ranges: FloatArray, landmarks: FloatArray
    ) -> None:
        if self._count != self._usual_count or self._is_ring(before):
            super()._settle(before, effective, ranges, landmarks)
        elif effective < self._resample_below * self._count:
            sampled = self._sample_posterior(before, effective, ranges, landmarks)
            if not sampled:
                super()._settle(before, effective, ranges, landmarks)

    def _sample_posterior(
        self, before: FloatArray, effective: float, ranges: FloatArray, landmarks: FloatArray
    ) -> bool:
        """Take new particles if they serve better than the old ones do.

        Args:
            before: (N,) weights before the measurements.
            effective: sample size after them.
            ranges: (M, 4).
            landmarks: (L, 6).
        """
        mean, factor, gain = self._cloud.pose_law(self._particles, before)
        posterior = mean, factor, self._arm, ranges, landmarks
        iterations = self._iterations if effective < _SEARCH_BELOW * self._count else 0
        uniform = self._rng.random((iterations, 6 * self._count + 3))
        best = self._posterior.search(self._particles, uniform, posterior)
        mode, root = self._posterior.gauss_newton(best, posterior)
        stretch = np.sqrt(self._freedom / self._rng.chisquare(self._freedom, self._count))
        particles = self._particles[self._rng.permutation(self._indices(before, self._count, self._rng))]
        normal = self._rng.standard_normal((self._count, 3))
        self._cloud.match(normal, particles, np.full(self._count, 1.0 / self._count), _ALL.start, _ALL.stop)
        poses, weights, served = self._posterior.draw(mode, root, normal, stretch, self._freedom, posterior)
        if served < min(effective, 0.5 * self._count):
            return False
        self._particles, self._weights = particles, weights
        self._cloud.put(particles, poses, gain)
        return True


class PrintedPfIbas(ParticleCloud):
    """PF-IBAS, steps 1 to 7 as printed.

    Source: huang2024 Eq. (15)-(28).
    """

    class Config(ParticleCloud.Config):
        """Settings of `pf_ibas_printed`."""

        particles: int = Field(
            40, ge=10, le=100_000, description="number of particles, which are the beetles"
        )
        iterations: int = Field(5, ge=0, le=1000, description="moves of each beetle in a search")

    def __init__(self, config: Config, setup: Setup) -> None:
        self._iterations = config.iterations
        super().__init__(config, setup)

    def _settle(
        self,
        before: FloatArray,
        effective: float,  # noqa: ARG002
        ranges: FloatArray,
        landmarks: FloatArray,
    ) -> None:
        self._weights = before  # equal, step 2
        _, factor, gain = self._cloud.pose_law(self._particles, self._weights)
        sigmas = sigmas_of(ranges, landmarks)
        poses = self._particles[:, POSE].copy()
        # A swarm does not hold together along an axis that its fitness does not see.
        seen = 3 if len(landmarks) else 2

        def misfit(points: FloatArray) -> FloatArray:  # (26)
            poses_there = np.hstack([points, poses[: len(points), seen:]])
            scaled = self._likelihood.residuals(poses_there, self._arm, ranges, landmarks) / sigmas
            return np.asarray(0.5 * (scaled**2).sum(axis=1))

        found = _PRINTED_SEARCH.search(  # steps 3 to 5
            misfit,
            poses[:, :seen],
            self._iterations,
            self._rng,
            np.linalg.norm(factor[:seen], axis=1),
        )
        poses[:, :seen] = found.beetles
        self._cloud.put(self._particles, poses, gain)
        misfits = misfit(found.beetles)
        weights = np.exp(misfits.min() - misfits)
        self._particles = self._particles[
            systematic(weights / weights.sum(), self._count, self._rng)
        ]  # step 6, (28)
