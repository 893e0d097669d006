"""Range biases against known positions: a line over the distance for each anchor, with its uncertainty."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from estimators.messages import FloatArray, RangeFrame
from estimators.models.range_bias import RangeBias

SPEED_OF_LIGHT = 299_792_458.0
"""[m/s]."""
MIN_SPREAD = 0.5
"""Least standard deviation of the distances [m] with which growth over the distance is looked for."""
MIN_RANGES = 20
"""Fewer ranges than this are no calibration of an anchor."""
_TRIM = _SIGNIFICANT = 3.0
_ROUNDS = 20
_BLOCK = 1.0
"""Errors within a time like this [s] are alike; those further apart are taken for independent."""


@dataclass(frozen=True, slots=True, eq=False)
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


@dataclass(frozen=True, slots=True, eq=False)
class AnchorFit:
    """Bias of one anchor's ranges.

    Attributes:
        bias: of the line.
        constant_sigma: standard deviation of `bias.constant` [m].
        per_metre_sigma: standard deviation of `bias.per_metre`; 0 when it was not looked for.
        spread: standard deviation of the errors about the line, of the ranges used [m].
        used: ranges that the line was laid through.
        ranges: of the anchor, all of them.
    """

    bias: RangeBias
    constant_sigma: float
    per_metre_sigma: float
    spread: float
    used: int
    ranges: Ranges

    def residuals(self, calibrated: bool) -> FloatArray:
        """Measured or corrected range minus distance, (N,) [m]."""
        ranges = self.ranges
        if not calibrated:
            return ranges.measured - ranges.distances
        return np.array([self.bias.corrected(r) for r in ranges.measured.tolist()]) - ranges.distances


@dataclass(frozen=True, slots=True, eq=False)
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
    """Biases of anchors, each from its own ranges.

    Args:
        by_anchor: anchor id -> at least `MIN_RANGES` ranges; one anchor at least.

    Source: chen2019 section 1.1: mean of measured minus true distance in line of sight, fitted over it.
    """
    fits = {anchor_id: fit_anchor(ranges) for anchor_id, ranges in by_anchor.items()}
    return together(fits)


def together(fits: dict[int, AnchorFit]) -> Calibration:
    """Calibration of anchors whose fits are independent of each other."""
    sigmas = [fit.constant_sigma for fit in fits.values()]
    return Calibration(
        common=float(np.mean([fit.bias.constant for fit in fits.values()])),
        common_sigma=float(np.sqrt(np.sum(np.square(sigmas)))) / len(fits),
        anchors=fits,
    )


def fit_anchor(ranges: Ranges) -> AnchorFit:
    """Line through an anchor's errors over the distance, blocked and failed ranges left out.

    Growth with the distance is taken where it is three standard deviations from none; else the line is level:
    a growth that noise made would do harm at distances that the drive did not have.

    It begins at the mode of the errors. What is further from the line than `trim_limit` is left out, and the
    line laid again until nothing changes. The uncertainty is that of errors which are alike
    within a second (cluster-robust).

    Source: line and trimming: standard least squares; covariance: Liang and Zeger, Biometrika 73(1), 1986.
    """
    centre = float(ranges.distances.mean())
    level = np.ones((len(ranges.distances), 1))
    if ranges.distances.std() >= MIN_SPREAD:
        sloping = _fit_line(ranges, np.column_stack([level, ranges.distances - centre]), centre)
        if abs(sloping.bias.per_metre) > _SIGNIFICANT * sloping.per_metre_sigma:
            return sloping
    return _fit_line(ranges, level, centre)


def _fit_line(ranges: Ranges, design: FloatArray, centre: float) -> AnchorFit:
    errors = ranges.measured - ranges.distances
    line: FloatArray = np.zeros(design.shape[1])
    line[0] = half_sample_mode(errors)
    kept = np.ones(len(errors), dtype=bool)
    limit = np.inf
    for _ in range(_ROUNDS):
        off = errors - design @ line
        # Never wider than before: else blocked ranges lift the line, which lets in more of them.
        limit = min(limit, trim_limit(off))
        kept_now = np.abs(off) <= limit
        line[:] = np.linalg.lstsq(design[kept_now], errors[kept_now], rcond=None)[0]
        if (kept_now == kept).all():
            break
        kept = kept_now
    cov = _clustered_covariance(design[kept], (errors - design @ line)[kept], ranges.times[kept])
    sigmas = np.sqrt(np.diag(cov))
    has_slope = len(line) == 2
    return AnchorFit(
        RangeBias(float(line[0]), float(line[1]) if has_slope else 0.0, centre),
        float(sigmas[0]),
        float(sigmas[1]) if has_slope else 0.0,
        float((errors - design @ line)[kept].std()),
        int(kept.sum()),
        ranges,
    )


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


def _clustered_covariance(design: FloatArray, residuals: FloatArray, times: FloatArray) -> FloatArray:
    blocks = np.unique((times / _BLOCK).astype(np.int64), return_inverse=True)[1]
    scores = np.zeros((int(blocks.max()) + 1, design.shape[1]))
    np.add.at(scores, blocks, design * residuals[:, None])
    bread = np.linalg.pinv(design.T @ design)
    return np.asarray(bread @ (scores.T @ scores) @ bread)
