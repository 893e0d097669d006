"""Particle filter with the motion as its proposal."""

from math import sqrt
from typing import Literal

import numpy as np
from pydantic import Field

from estimators.base import Setup
from estimators.geometry import wrap_angles
from estimators.messages import FloatArray
from estimators.particle_cloud import POSE, ParticleCloud, sigmas_of
from estimators.resampling import RESAMPLING

MAX_HEADING_SIGMA = 0.35
"""With a less certain heading [rad] a cloud is a ring, not a Gaussian, and needs more particles."""
_LEAST_OF_A_RING = 500
_SHARES_BELOW = 0.25
"""Measurements that would leave a smaller share of effective particles are not taken at once."""
_SHARE_LEAVES = 0.5
"""Share of effective particles that each step leaves then."""


class ParticleFilter(ParticleCloud):
    """Sequential importance resampling with three remedies for few particles.

    Resampled particles are spread by a kernel that keeps their mean and covariance. Measurements that would
    leave hardly any particle are taken a share at a time. Noise has the moments that it should have exactly.

    Source: Arulampalam et al., IEEE Trans. Signal Processing 50(2), 2002, Algorithm 4; weights huang2024
    Eq. (26) and (28); kernel: Liu and West, shares: Musso, Oudjane and Le Gland, both in Sequential Monte
    Carlo Methods in Practice, 2001, 10.3 and 12.4; noise: `kernels.cloud.match`.
    """

    class Config(ParticleCloud.Config):
        """Settings of `pf`."""

        resampling: Literal["systematic", "stratified"] = Field("systematic", description="method")
        resample_below: float = Field(
            0.5, gt=0, le=1, description="resample when the effective sample size is below this share"
        )
        bandwidth: float = Field(
            1.0,
            ge=0,
            le=1,
            description="width of the kernel that spreads resampled particles, in units of what is best "
            "for a Gaussian; 0: not at all",
        )

    def __init__(self, config: Config, setup: Setup) -> None:
        self._indices = RESAMPLING[config.resampling]
        self._resample_below = config.resample_below
        self._bandwidth = config.bandwidth
        super().__init__(config, setup)

    def _settle(
        self, before: FloatArray, effective: float, ranges: FloatArray, landmarks: FloatArray
    ) -> None:
        count = max(self._usual_count, _LEAST_OF_A_RING) if self._is_ring(before) else self._usual_count
        if count != self._count:
            self._weights = before
            self._resample(count)
            self._weigh_in_shares(ranges, landmarks)
        elif effective < _SHARES_BELOW * count:
            self._weights = before
            self._weigh_in_shares(ranges, landmarks)
        elif effective < self._resample_below * count:
            self._resample(count)

    def _is_ring(self, weights: FloatArray) -> bool:
        _, cov = self._cloud.moments(self._particles, weights, 3)
        return bool(cov[2, 2] > MAX_HEADING_SIGMA**2)

    def _weigh_in_shares(self, ranges: FloatArray, landmarks: FloatArray) -> None:
        """Take measurements a share at a time, resampling in between."""
        sigmas, left = sigmas_of(ranges, landmarks), 1.0
        while True:
            residuals = self._residuals(ranges, landmarks)
            left -= self._likelihood.reweigh_partly(
                self._weights, residuals, sigmas, left, _SHARE_LEAVES * self._count
            )
            if left <= 0.0:
                return
            self._resample(self._count)

    def _resample(self, count: int) -> None:
        """Go on with so many particles of equal weight."""
        mean, factor, gain = self._cloud.pose_law(self._particles, self._weights)
        self._particles = self._particles[self._indices(self._weights, count, self._rng)]
        self._count = count
        self._weights = np.full(count, 1.0 / count)
        if self._bandwidth > 0.0:
            deviations = self._particles[:, POSE] - mean
            deviations[:, 2] = wrap_angles(deviations[:, 2])
            width = self._bandwidth * _best_width(count)
            shift = width * self._noise_beside(POSE) @ factor.T
            self._cloud.put(self._particles, mean + sqrt(1.0 - width**2) * deviations + shift, gain)


def _best_width(count: int) -> float:
    """Width of the Gaussian kernel, in standard deviations, that shows a three-dimensional Gaussian best.

    Source: Silverman, Density Estimation for Statistics and Data Analysis, 1986, Eq. (4.14).
    """
    return float((4.0 / (5.0 * count)) ** (1.0 / 7.0))
