"""Particle filter with the motion as its proposal."""

from typing import Literal

import numpy as np
from pydantic import Field

from estimators.base import Report, Setup, Verdict
from estimators.geometry import wrap_angles
from estimators.lidar.likelihood_field import LikelihoodField, beams_of
from estimators.messages import FloatArray, ImuSample, Measurement, Scan
from estimators.particle_cloud import Likelihood, ParticleCloud
from estimators.resampling import RESAMPLING

_INDEPENDENT_BEAMS = 10
"""All beams of a scan count as this many: they err together, by the map and by how level the LiDAR is."""
_STRAYS = 0.1
"""Share of beams that end on what the map does not have."""
_MAX_RATE = 100.0
"""No robot turns faster [rad/s]."""
_RATE_HOLDS_NS = 200_000_000
"""A yaw rate this old no longer says how the robot turns."""
_GYRO_DRIFT = 0.05
"""Density of the random walk of the yaw rate's error, the gyroscope's noise included [rad/s^2/sqrt(Hz)]."""


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
        motion: Literal["increments", "imu"] = Field(
            "increments",
            description="what is expected between increments: constant velocity; or the yaw rate of the "
            "gyroscope, where it comes (the tag's axes are the body's)",
        )
        gyro_bias: float = Field(
            0.02, gt=0, le=1, description="standard deviation of the gyroscope's bias [rad/s]"
        )
        scan_likelihood: bool = Field(
            False, description="scans weigh the particles by their distance from the walls of the site"
        )
        scan_sigma: float = Field(
            0.05, gt=0, le=1, description="standard deviation of that distance, walls' errors included [m]"
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
        self._uses_imu = config.motion == "imu"
        self._gyro_bias = config.gyro_bias
        self._field = LikelihoodField.from_walls(setup.walls) if config.scan_likelihood else None
        self._scan_sigma = config.scan_sigma
        super().__init__(config, setup)

    def reset(self) -> None:
        """Stand at the start again, trust every anchor, and draw the same numbers again."""
        self._rate = 0.0
        self._rate_ns: int | None = None
        super().reset()

    def update(self, measurement: Measurement) -> Report:
        """Predict to the measurement's time and take it."""
        if isinstance(measurement, Scan) and self._field is not None:
            return Report((self._update_scan(measurement, self._field),))
        if isinstance(measurement, ImuSample) and self._uses_imu:
            return Report((self._update_rate(measurement),))
        return super().update(measurement)

    def _update_scan(self, scan: Scan, field: LikelihoodField) -> Verdict:
        if self._is_late(scan.end_stamp_ns):
            return Verdict.LATE
        beams = beams_of(scan)
        if len(beams) == 0:
            return Verdict.IMPOSSIBLE
        self._predict_to(scan.end_stamp_ns)
        share = min(1.0, _INDEPENDENT_BEAMS / len(beams))

        def likelihood(particles: FloatArray) -> FloatArray:
            misfits: FloatArray = self._scan.scan_misfits(
                particles,
                beams,
                self._setup.lidar_in_body,
                field.distances,
                field.resolution,
                field.origin,
                self._scan_sigma,
                _STRAYS,
            )
            return share * misfits

        self._take(likelihood(self._particles), likelihood)
        return Verdict.ACCEPTED

    def _update_rate(self, sample: ImuSample) -> Verdict:
        """Take the change of the yaw rate: its bias is in each particle's own rate, and so is learned."""
        if self._is_late(sample.stamp_ns):
            return Verdict.LATE
        rate = float(sample.gyro[2])
        if not abs(rate) < _MAX_RATE:
            return Verdict.IMPOSSIBLE
        is_continued = self._has_rate(sample.stamp_ns)
        self._predict_to(sample.stamp_ns)
        change, since_ns = rate - self._rate, self._rate_ns
        self._rate, self._rate_ns = rate, sample.stamp_ns
        if self._stands:
            return Verdict.ACCEPTED
        if is_continued and since_ns is not None:
            dt = (sample.stamp_ns - since_ns) * 1e-9
            self._particles[:, 5] += change
            self._particles[:, 2] = wrap_angles(self._particles[:, 2] + 0.5 * change * dt)
        else:
            self._set_rate()
        return Verdict.ACCEPTED

    def _has_rate(self, stamp_ns: int) -> bool:
        return self._rate_ns is not None and stamp_ns - self._rate_ns < _RATE_HOLDS_NS

    def _set_rate(self) -> None:
        self._particles[:, 5] = self._rate + self._gyro_bias * self._matched_noise()[:, 2]

    def _set_speed_free(self) -> None:
        super()._set_speed_free()
        if self._stamp_ns is not None and self._has_rate(self._stamp_ns):
            self._set_rate()

    def _noise_densities(self) -> tuple[float, float]:
        accel_noise, yaw_accel_noise = super()._noise_densities()
        assert self._stamp_ns is not None
        return accel_noise, _GYRO_DRIFT if self._has_rate(self._stamp_ns) else yaw_accel_noise

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
