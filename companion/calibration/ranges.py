"""Range biases against known positions: a constant for each anchor, one growth with the distance for all."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from estimators.immutable import immutable
from estimators.messages import FloatArray, RangeFrame
from estimators.models.range_bias import RangeBias

SPEED_OF_LIGHT = 299_792_458.0
"""[m/s]."""
MIN_SPREAD = 0.5
"""Least standard deviation of the distances [m] with which growth over the distance is looked for."""
MIN_RANGES = 20
"""Fewer ranges than this are no calibration of an anchor."""
_TRIM = _SIGNIFICANT = 3.0
_ROUNDS, _GROWTH_ROUNDS = 20, 3
_BLOCK = 1.0
"""Errors within a time like this [s] are alike; those further apart are taken for independent."""


@immutable
class Ranges:
    """Ranges of one anchor beside the true distances.

    Attributes:
        times: (N,) [s] since the beginning of the log.
        measured: (N,) [m].
        distances: (N,) true [m], slant.
    """

    times: FloatArray
    measured: FloatArray
    distances: FloatArray


@immutable
class AnchorFit:
    """Bias of one anchor's ranges.

    Attributes:
        bias: of the line.
        constant_sigma: standard deviation of `bias.constant` [m].
        per_metre_sigma: standard deviation of `bias.per_metre`; 0 when there is none.
        spread: standard deviation of the errors about the line, of the ranges used [m].
        kept: (N,) True for the ranges that were used.
        ranges: of the anchor, all of them.
    """

    bias: RangeBias
    constant_sigma: float
    per_metre_sigma: float
    spread: float
    kept: NDArray[np.bool_]
    ranges: Ranges

    @property
    def used(self) -> int:
        """Number of the ranges that were used."""
        return int(self.kept.sum())

    def residuals(self, calibrated: bool) -> FloatArray:
        """Measured or corrected range minus distance, (N,) [m]."""
        ranges = self.ranges
        if not calibrated:
            return ranges.measured - ranges.distances
        return np.array([self.bias.corrected(r) for r in ranges.measured.tolist()]) - ranges.distances


@immutable
class Calibration:
    """Biases of all anchors.

    Attributes:
        common: mean of the anchors' biases, r_D of chen2019 [m].
        common_sigma: its standard deviation [m].
        anchors: anchor id -> fit.
    """

    common: float
    common_sigma: float
    anchors: dict[int, AnchorFit]

    @property
    def common_ns(self) -> float:
        """The common bias as a time [ns]."""
        return self.common / SPEED_OF_LIGHT * 1e9


def ranges_by_anchor(
    frames: list[RangeFrame], tags: FloatArray, anchors: Mapping[int, FloatArray], start_ns: int
) -> dict[int, Ranges]:
    """Ranges and true distances of every anchor of the site.

    Args:
        frames: N, as measured.
        tags: (N, 3) true positions of the tag [m], map frame; NaN where they are not known.
        anchors: id -> (3,) position [m].
        start_ns: beginning of the log.
    """
    rows: dict[int, list[tuple[float, float, float]]] = {i: [] for i in anchors}
    for frame, tag in zip(frames, tags, strict=True):
        if not np.isfinite(tag).all():
            continue
        time = (frame.stamp_ns - start_ns) * 1e-9
        for anchor_id, measured in zip(frame.anchor_ids.tolist(), frame.ranges.tolist(), strict=True):
            if anchor_id in anchors and 0.0 < measured < np.inf:
                distance = float(np.linalg.norm(tag - anchors[anchor_id]))
                rows[anchor_id].append((time, measured, distance))
    return {i: Ranges(*np.array(found).T) for i, found in rows.items() if len(found) >= MIN_RANGES}


def fit_biases(by_anchor: Mapping[int, Ranges]) -> Calibration:
    """Biases of anchors: a constant of each, and one growth with the distance for all.

    Growth comes from the receive level, on which modules of one kind depend alike; what a single anchor shows
    of it is easily the direction from which the tag saw it. It is taken where it is three standard deviations
    from none: a growth that noise made would do harm at distances that the drive did not have.

    Args:
        by_anchor: anchor id -> at least `MIN_RANGES` ranges; one anchor at least.

    Source: chen2019 section 1.1: mean of measured minus true distance in line of sight, fitted over it.
    """
    fits = {anchor_id: fit_anchor(ranges) for anchor_id, ranges in by_anchor.items()}
    for _ in range(_GROWTH_ROUNDS):
        growth, sigma = _common_growth(fits)
        if abs(growth) <= _SIGNIFICANT * sigma:
            return together({anchor_id: fit_anchor(ranges) for anchor_id, ranges in by_anchor.items()})
        fits = {anchor_id: fit_anchor(ranges, growth, sigma) for anchor_id, ranges in by_anchor.items()}
    return together(fits)


def together(fits: dict[int, AnchorFit]) -> Calibration:
    """Calibration of anchors whose fits are independent of each other."""
    sigmas = [fit.constant_sigma for fit in fits.values()]
    return Calibration(
        common=float(np.mean([fit.bias.constant for fit in fits.values()])),
        common_sigma=float(np.sqrt(np.sum(np.square(sigmas)))) / len(fits),
        anchors=fits,
    )


def fit_anchor(ranges: Ranges, growth: float = 0.0, growth_sigma: float = 0.0) -> AnchorFit:
    """Mean of an anchor's errors, blocked and failed ranges left out, beside a growth that is known.

    It begins at the mode of the errors. What is further from the line than `trim_limit` is left out, and the
    mean taken again until nothing changes. The uncertainty is that of errors which are alike within a second
    (cluster-robust).

    Args:
        ranges: of the anchor.
        growth: of the bias with the distance [m/m].
        growth_sigma: standard deviation of it.

    Source: trimming: standard least squares; covariance: Liang and Zeger, Biometrika 73(1), 1986.
    """
    centre = float(ranges.distances.mean())
    errors = ranges.measured - ranges.distances - growth * (ranges.distances - centre)
    constant = half_sample_mode(errors)
    kept = np.ones(len(errors), dtype=bool)
    limit = np.inf
    for _ in range(_ROUNDS):
        # Never wider than before: else blocked ranges lift the mean, which lets in more of them.
        limit = min(limit, trim_limit(errors - constant))
        kept_now = np.abs(errors - constant) <= limit
        constant = float(errors[kept_now].mean())
        if (kept_now == kept).all():
            break
        kept = kept_now
    off = errors[kept] - constant
    return AnchorFit(
        RangeBias(constant, growth, centre),
        float(np.linalg.norm(block_sums(off, ranges.times[kept]))) / len(off),
        growth_sigma,
        float(off.std()),
        kept,
        ranges,
    )


def _common_growth(fits: Mapping[int, AnchorFit]) -> tuple[float, float]:
    """Growth of all anchors' biases with the distance, and its standard deviation.

    The second is infinite when the distances of no anchor differ enough to show a growth.
    """
    information = product = scatter = 0.0
    told = []
    for fit in fits.values():
        distances = fit.ranges.distances[fit.kept]
        if len(distances) and distances.std() >= MIN_SPREAD:
            errors = fit.ranges.measured[fit.kept] - distances
            lever = distances - distances.mean()
            information += float(lever @ lever)
            product += float(lever @ errors)
            told.append((lever, errors - errors.mean(), fit.ranges.times[fit.kept]))
    if not told:
        return 0.0, np.inf
    growth = product / information
    for lever, errors, times in told:
        scatter += float((block_sums(lever * (errors - growth * lever), times) ** 2).sum())
    return growth, float(np.sqrt(scatter)) / information


def block_sums(scores: FloatArray, times: FloatArray) -> FloatArray:
    """Sums (B, ...) of scores (N, ...) over the blocks of time [s] in which errors are taken to be alike."""
    blocks = np.unique((times / _BLOCK).astype(np.int64), return_inverse=True)[1]
    sums = np.zeros((blocks.max() + 1, *scores.shape[1:]))
    np.add.at(sums, blocks, scores)
    return sums


def trim_limit(errors: FloatArray) -> float:
    """Size [m] above which an error is no noise: three standard deviations, judged by the negative errors.

    What blocks a range only lengthens it, so ranges that came straight are those on the short side.
    """
    short = -errors[errors <= 0.0]
    spread = float(np.median(short)) if len(short) else 0.0
    # A hair more than nothing: exact ranges have no spread at all.
    return _TRIM * 1.4826 * spread + 1e-6


def half_sample_mode(values: FloatArray) -> float:
    """Where values (N,) lie closest together: halved again and again to the densest half.

    Source: Bickel and Fruehwirth, Computational Statistics and Data Analysis 50(12), 2006.
    """
    ascending = np.sort(values).tolist()
    while len(ascending) > 3:
        half = (len(ascending) + 1) // 2
        begin = int(np.argmin(np.subtract(ascending[half - 1 :], ascending[: len(ascending) - half + 1])))
        ascending = ascending[begin : begin + half]
    return float(np.mean(ascending))
