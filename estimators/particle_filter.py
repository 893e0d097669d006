"""Particle filter with the motion as its proposal."""

from typing import Literal

import numpy as np
from pydantic import Field

from estimators.base import Setup
from estimators.messages import FloatArray
from estimators.particle_cloud import Likelihood, ParticleCloud
from estimators.resampling import RESAMPLING


class ParticleFilter(ParticleCloud):
    """Sequential importance resampling with three remedies for few particles.

    Measurements that would leave too few effective particles are taken a share at a time, with resampling in
    between. Resampled particles are spread by a kernel that keeps their mean and covariance. Noise has the
    moments that it should have exactly.

    Source: Arulampalam et al., IEEE Trans. Signal Processing 50(2), 2002, Algorithm 4; weights huang2024
    Eq. (26) and (28); kernel: Liu and West, shares: Musso, Oudjane and Le Gland, both in Sequential Monte
    Carlo Methods in Practice, 2001, 10.3 and 12.4; noise: `kernels.cloud.match`.
    """

    class Config(ParticleCloud.Config):
        """Settings of `pf`."""

        resampling: Literal["systematic", "stratified"] = Field("systematic", description="method")
        resample_below: float = Field(
            0.5, gt=0, lt=1, description="resample when the effective sample size would fall below this share"
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

    def _take(self, misfits: FloatArray, measured: Likelihood) -> None:
        left = 1.0
        while True:
            least = self._resample_below * len(self._weights)
            left -= self._likelihood.temper(self._weights, misfits, left, least)
            if left <= 0.0:
                return
            self._resample()
            misfits = measured(self._particles)

    def _resample(self) -> None:
        count = len(self._weights)
        kept = self._indices(self._weights, count, self._rng)
        width = self._bandwidth * _best_width(count)
        self._particles = self._cloud.resampled(self._particles, self._weights, kept, self._noise(), width)
        self._weights = np.full(count, 1.0 / count)


def _best_width(count: int) -> float:
    """Width of the Gaussian kernel, in standard deviations, that shows a three-dimensional Gaussian best.

    Source: Silverman, Density Estimation for Statistics and Data Analysis, 1986, Eq. (4.14).
    """
    return float((4.0 / (5.0 * count)) ** (1.0 / 7.0))
