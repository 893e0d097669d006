"""Range biases by the direction from which a tag sees an anchor, against known poses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from companion.calibration.ranges import Ranges, block_sums, fit_anchor, ranges_by_anchor
from estimators.base import Setup
from estimators.messages import FloatArray, RangeFrame
from estimators.models.range_bias import BearingBias, without_bearing_bias

_SIGNIFICANT = 13.8
"""Chi-square of two numbers [-] that noise alone exceeds once in a thousand times."""
_CONDITION, _ROUNDS = 1e-6, 3


@dataclass(frozen=True, slots=True)
class BearingFit:
    """What one tag's ranges add by the bearing of the anchor.

    Attributes:
        bias: of the tag.
        cosine_sigma: standard deviation of `bias.cosine` [m].
        sine_sigma: of `bias.sine` [m].
    """

    bias: BearingBias
    cosine_sigma: float
    sine_sigma: float


def fit_bearings(
    frames: Sequence[RangeFrame],
    poses: FloatArray,
    tags: FloatArray,
    anchors: Mapping[int, FloatArray],
    start_ns: int,
) -> dict[int, BearingFit]:
    """Parts of the range biases that depend on the bearing, of the tags whose ranges show one beyond noise.

    The two numbers of a tag are found beside a constant of each anchor and one growth with the distance, so
    that neither is taken for the other. A tag that did not turn against the anchors shows none.

    Args:
        frames: N, as measured.
        poses: (N, 3) true x [m], y [m], yaw [rad] of the body; NaN where they are not known.
        tags: (N, 3) true positions of the frame's tag [m], map frame; NaN where they are not known.
        anchors: id -> (3,) position [m].
        start_ns: beginning of the log.

    Source: standard least squares; covariance: Liang and Zeger, Biometrika 73(1), 1986, with their number of
        clusters less that of the parameters.
    """
    ids = np.array([frame.tag_id for frame in frames])
    found = {}
    for name in np.unique(ids).tolist():
        own = np.flatnonzero((ids == name) & np.isfinite(poses).all(axis=1)).tolist()
        by_anchor = ranges_by_anchor([frames[i] for i in own], tags[own], anchors, start_ns)
        times, yaws = np.array([(frames[i].stamp_ns - start_ns) * 1e-9 for i in own]), poses[own, 2]
        seen = []
        for anchor_id, ranges in by_anchor.items():
            at = np.searchsorted(times, ranges.times)
            seen.append((ranges, _regressors(ranges.distances, yaws[at], tags[own][at], anchors[anchor_id])))
        fit = _fit(seen) if seen else None
        if fit is not None:
            found[name] = fit
    return found


def without_bearings(
    frames: Sequence[RangeFrame], poses: FloatArray, fits: Mapping[int, BearingFit], setup: Setup
) -> list[RangeFrame]:
    """Frames without what depends on the bearing, at known poses (N, 3) of the body."""
    return [
        without_bearing_bias(frame, fits[frame.tag_id].bias, pose, setup.anchors, setup.arm(frame.tag_id))
        if frame.tag_id in fits
        else frame
        for frame, pose in zip(frames, poses, strict=True)
    ]


def _regressors(distances: FloatArray, yaws: FloatArray, tags: FloatArray, anchor: FloatArray) -> FloatArray:
    """What an anchor's ranges may depend on, (M, 3): cos 2b, sin 2b, distance."""
    to_anchor = anchor[:2] - tags[:, :2]
    twice = 2.0 * (np.arctan2(to_anchor[:, 1], to_anchor[:, 0]) - yaws)
    return np.column_stack([np.cos(twice), np.sin(twice), distances])


def _fit(seen: Sequence[tuple[Ranges, FloatArray]]) -> BearingFit | None:
    """The two numbers; None where they are not significant, or cannot be told from constants and growth."""
    solution = np.zeros(3)
    for _ in range(_ROUNDS):
        # What is left out depends on what the ranges are held against, and the other way round.
        times, A, errors = _used(seen, solution)
        information = A.T @ A
        if np.linalg.eigvalsh(information)[0] < _CONDITION * len(A):
            return None
        inverse = np.linalg.inv(information)
        solution = inverse @ A.T @ errors
    sums = block_sums(A * (errors - A @ solution)[:, None], times)
    free = len(sums) - A.shape[1]
    if free <= 0:
        return None
    cov = (inverse @ (sums.T @ sums) @ inverse * (len(sums) / free))[:2, :2]
    pair = solution[:2]
    if pair @ np.linalg.solve(cov, pair) <= _SIGNIFICANT:
        return None
    cosine_sigma, sine_sigma = np.sqrt(np.diag(cov)).tolist()
    return BearingFit(BearingBias(*pair.tolist()), cosine_sigma, sine_sigma)


def _used(
    seen: Sequence[tuple[Ranges, FloatArray]], solution: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times (K,), regressors (K, 3) and errors (K,) of the ranges that are not blocked, about their means."""
    parts = []
    for ranges, A in seen:
        kept = fit_anchor(replace(ranges, measured=ranges.measured - A @ solution)).kept
        errors = (ranges.measured - ranges.distances)[kept]
        parts.append((ranges.times[kept], A[kept] - A[kept].mean(axis=0), errors - errors.mean()))
    times, regressors, errors = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return times, regressors, errors
