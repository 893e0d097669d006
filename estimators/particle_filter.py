"""Particle filter with the motion as its proposal."""

from math import isfinite
from typing import Literal

import numpy as np
from pydantic import Field

from estimators import chi2
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
            description="what tells the motion: increments alone, or the gyroscope's yaw rate as well (the "
            "tag's axes are the body's)",
        )
        gyro_sigma: float = Field(
            0.03, gt=0, le=1, description="standard deviation of the gyroscope, bias included [rad/s]"
        )
        scan_likelihood: bool = Field(
            False,
            description="scans weigh the particles by their distance from the obstacles of the site's map, "
            "or without one from its walls",
        )
        scan_sigma: float = Field(
            0.05, gt=0, le=1, description="standard deviation of that distance, the map's errors included [m]"
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
        self._gyro_sigma = config.gyro_sigma
        self._gyro_gate = float(chi2.ppf(config.increment_gate, 1))
        self._field = _field_of(setup) if config.scan_likelihood else None
        self._scan_sigma = config.scan_sigma
        super().__init__(config, setup)

    @property
    def takes(self) -> frozenset[type[Measurement]]:
        """As every filter, and inertial samples if they tell the motion."""
        return super().takes | {ImuSample} if self._uses_imu else super().takes

    def update(self, measurement: Measurement) -> Report:
        """Predict to the measurement's time and take it."""
        if isinstance(measurement, Scan) and self._field is not None:
            return Report((self._update_scan(measurement, self._field),))
        if isinstance(measurement, ImuSample) and self._uses_imu:
            return self._update_rate(measurement)
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

    def _update_rate(self, sample: ImuSample) -> Report:
        """Correct every particle's yaw rate, and how it turned since the keyframe, as by an increment."""
        if self._is_late(sample.stamp_ns):
            return Report((Verdict.LATE,))
        measured = float(sample.gyro[2])
        if not isfinite(measured):
            return Report((Verdict.IMPOSSIBLE,))
        self._predict_to(sample.stamp_ns)
        if self._stands:
            return Report((Verdict.NOT_USED,))
        rates, turned = self._particles[:, 5], wrap_angles(self._particles[:, 2] - self._particles[:, 8])
        mean = float(self._weights @ rates)
        deviations = self._weights * (rates - mean)
        variance = float(deviations @ rates) + self._gyro_sigma**2
        nis = (measured - mean) ** 2 / variance
        report = np.full(1, np.nan), np.array([nis])
        if nis > self._gyro_gate:
            return Report((Verdict.GATED,), *report)
        innovations = measured + self._gyro_sigma * self._matched_noise()[:, 2] - rates
        by_turn, by_rate = float(deviations @ turned), float(deviations @ rates)
        self._particles[:, 2] = wrap_angles(self._particles[:, 2] + by_turn / variance * innovations)
        self._particles[:, 5] += by_rate / variance * innovations
        return Report((Verdict.ACCEPTED,), *report)

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


def _field_of(setup: Setup) -> LikelihoodField:
    if setup.floor_map is not None:
        return LikelihoodField.from_floor(setup.floor_map)
    return LikelihoodField.from_walls(setup.walls)


def _best_width(count: int) -> float:
    """Width of the Gaussian kernel, in standard deviations, that shows a three-dimensional Gaussian best.

    Source: Silverman, Density Estimation for Statistics and Data Analysis, 1986, Eq. (4.14).
    """
    return float((4.0 / (5.0 * count)) ** (1.0 / 7.0))
