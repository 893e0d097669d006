"""Ranges in the plane, and the verdicts on them, see `estimators.range_gate`.

What is remembered of A anchors goes together as a tuple: ``known_ns`` and ``known`` of `blocked.prior`, then
``residuals``, ``heard`` and ``common`` of `anchor_trust.note`. So do the settings: greatest NIS that passes,
mean excess of a blocked range [m], memory [s], middle of the powers [dB], greatest log-likelihood ratio of a
look along the line of sight, 0 when nobody looks; whether residuals count, powers count, and doubtful ranges
are weighed instead of rejected.
"""

from math import cos, hypot, isfinite, isnan, sin, sqrt
from typing import TypeAlias

import numpy as np

from estimators.base import Verdict
from estimators.kernels.anchor_trust import note
from estimators.kernels.blocked import (
    PRIOR,
    excess_log_ratio,
    power_log_ratio,
    prior,
    remember,
    sigma_factor,
)
from estimators.kernels.compilation import INDICES, MATRIX, VECTOR, compiled
from estimators.messages import FloatArray, IntArray
from estimators.models.range import MIN_HORIZONTAL_RANGE, NOWHERE

State: TypeAlias = tuple[IntArray, FloatArray, FloatArray, IntArray, IntArray]
Settings: TypeAlias = tuple[float, float, float, float, float, bool, bool, bool]

_STATE = f"Tuple(({INDICES}, {VECTOR}, {MATRIX}, int64[:, ::1], {INDICES}))"
_SETTINGS = "Tuple((float64, float64, float64, float64, float64, boolean, boolean, boolean))"

ACCEPTED, DOWNWEIGHTED, GATED, CONTRADICTS, TOO_LONG, WEAK_FIRST_PATH, OBSTRUCTED, SUSPECT = range(8)
VERDICTS = (
    Verdict.ACCEPTED,
    Verdict.DOWNWEIGHTED,
    Verdict.GATED,
    Verdict.CONTRADICTS,
    Verdict.TOO_LONG,
    Verdict.WEAK_FIRST_PATH,
    Verdict.OBSTRUCTED,
    Verdict.SUSPECT,
    Verdict.IMPOSSIBLE,
    Verdict.UNKNOWN_ANCHOR,
)
"""What a number says; the last two also as negative numbers in place of an anchor's."""
IMPOSSIBLE, UNKNOWN_ANCHOR = -2, -1
LOOK = -3
"""There is no verdict before somebody has looked along the line of sight."""


@compiled(f"void({INDICES}, {VECTOR}, {INDICES}, {MATRIX}, float64, float64, {INDICES}, {MATRIX})")
def reduce_heights(
    anchor_ids: IntArray,
    slants: FloatArray,
    site_ids: IntArray,
    site: FloatArray,
    lift: float,
    sigma: float,
    anchors: IntArray,
    rows: FloatArray,
) -> None:
    """Height reduction of a frame's ranges, as `models.range.reduce_height` does it.

    Args:
        anchor_ids: (N,) whose ranges they are.
        slants: (N,) distances [m].
        site_ids: (A,) known anchors.
        site: (A, 3) their x [m] and y [m], map frame, and height above the first tag [m].
        lift: height of the tag above the first one [m].
        sigma: standard deviation of a distance [m].
        anchors: (N,) filled in with each one's number among the known, `IMPOSSIBLE` or `UNKNOWN_ANCHOR`.
        rows: (N, 4) zeros, filled in with the ranges; of infinite sigma where they are good for nothing.

    Source: huang2024 Eq. (3).
    """
    for i in range(len(anchor_ids)):
        anchors[i], rows[i, 3] = UNKNOWN_ANCHOR, np.inf
        for k in range(len(site_ids)):
            if site_ids[k] == anchor_ids[i]:
                height = site[k, 2] - lift
                square = slants[i] * slants[i] - height * height
                anchors[i] = IMPOSSIBLE
                if isfinite(square) and slants[i] > 0.0 and square >= MIN_HORIZONTAL_RANGE**2:
                    anchors[i] = k
                    rows[i, 0], rows[i, 1] = site[k, 0], site[k, 1]
                    rows[i, 2] = sqrt(square)
                    rows[i, 3] = sigma * slants[i] / rows[i, 2]
                break


@compiled(
    f"Tuple(({VECTOR}, {MATRIX}, {MATRIX}))"
    f"({INDICES}, {MATRIX}, {MATRIX}, {VECTOR}, {MATRIX}, float64, float64)"
)
def expected_at(
    anchors: IntArray,
    rows: FloatArray,
    bias_by_pose: FloatArray,
    pose: FloatArray,
    cov: FloatArray,
    arm_x: float,
    arm_y: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Ranges against those predicted by `models.range.horizontal_range` for a pose and its covariance.

    Args:
        anchors: (N,) of `reduce_heights`.
        rows: (N, 4) likewise.
        bias_by_pose: (N, 3) derivative by the pose of what was taken off the ranges.
        pose: (3,) x [m], y [m], yaw [rad] of the body in the map.
        cov: (K, K) beginning with that of the pose.
        arm_x: tag antenna in the body frame [m].
        arm_y: likewise.

    Returns:
        Measured minus predicted (N,) [m]; derivative of what is predicted by the pose (N, 3); its covariance
        (N, N) [m^2]. Zero where something is wrong with a range.
    """
    count = len(anchors)
    residuals, by_pose, spread = np.zeros(count), np.zeros((count, 3)), np.zeros((count, count))
    c, s = cos(pose[2]), sin(pose[2])
    x, y = c * arm_x - s * arm_y, s * arm_x + c * arm_y
    for i in range(count):
        if anchors[i] < 0:
            continue
        dx, dy = pose[0] + x - rows[i, 0], pose[1] + y - rows[i, 1]
        distance = max(hypot(dx, dy), NOWHERE)
        residuals[i] = rows[i, 2] - distance
        ux, uy = dx / distance, dy / distance
        by_pose[i, 0], by_pose[i, 1], by_pose[i, 2] = ux, uy, uy * x - ux * y
        for a in range(3):
            by_pose[i, a] += bias_by_pose[i, a]
        for k in range(i + 1):
            for a in range(3):
                for b in range(3):
                    spread[i, k] += by_pose[i, a] * cov[a, b] * by_pose[k, b]
            spread[k, i] = spread[i, k]
    return residuals, by_pose, spread


@compiled("int64(float64, float64, float64)")
def _reason(by_residual: float, by_power: float, by_look: float) -> int:
    """What spoke most for a blocked range; its anchor's past when nothing of now did."""
    strongest = max(by_residual, by_power, by_look)
    if not strongest > 0.0:
        return SUSPECT
    if by_residual == strongest:
        return TOO_LONG
    return WEAK_FIRST_PATH if by_power == strongest else OBSTRUCTED


@compiled(
    f"Tuple((int64, float64))({_STATE}, {_SETTINGS}, int64, int64, float64, float64, float64, float64,"
    " float64, float64)"
)
def judged(
    state: State,
    settings: Settings,
    anchor: int,
    stamp_ns: int,
    rx_power: float,
    fp_power: float,
    sigma: float,
    residual: float,
    nis: float,
    looked: float,
) -> tuple[int, float]:
    """Verdict on a range, and by how much its sigma is to be multiplied when it is used.

    Args:
        state: of all anchors; what is learnt is added to it, though not with `LOOK`.
        settings: of the gate.
        anchor: number of the anchor.
        stamp_ns: when the range was measured.
        rx_power: of everything received [dBm].
        fp_power: of the first path [dBm].
        sigma: standard deviation of the range [m].
        residual: measured minus predicted [m], before the range is used.
        nis: normalised innovation squared, likewise.
        looked: log-likelihood ratio by what lies in the line of sight; NaN if nobody has looked.
    """
    known_ns, known, residuals, heard, common = state
    limit, excess, memory, middle, most_seen, predicts, compares, weighs = settings
    code, factor = GATED, 1.0
    # Nothing shortens a range: rather is the pose wrong, which says nothing of what stands between.
    if not (nis > limit and residual < 0.0):
        before = prior(known_ns, known, anchor, stamp_ns, memory) if predicts else PRIOR
        by_power = power_log_ratio(rx_power, fp_power, middle) if compares else 0.0
        by_residual, by_look = 0.0, 0.0
        if predicts or weighs:
            spread = abs(residual) / sqrt(nis) if nis > 0.0 else sigma
            by_residual = excess_log_ratio(residual, spread, excess)
        log_odds = before + by_power + by_residual
        is_rejected = nis > limit and not weighs
        if most_seen > 0.0 and not is_rejected and (weighs or log_odds + most_seen > 0.0):
            if isnan(looked):
                return LOOK, 1.0
            by_look = looked
            log_odds += looked
        if predicts:
            remember(known_ns, known, anchor, stamp_ns, before + by_residual)
        if is_rejected:
            code = TOO_LONG if predicts else GATED
        elif weighs:
            code = DOWNWEIGHTED if log_odds > 0.0 else ACCEPTED
            factor = sigma_factor(log_odds)
        elif log_odds > 0.0:
            code = _reason(by_residual, by_power, by_look)
        else:
            code = ACCEPTED
        if code in (TOO_LONG, WEAK_FIRST_PATH, OBSTRUCTED, SUSPECT):
            return code, factor
    variance = residual**2 / nis if nis > 0.0 else sigma**2
    if not note(residuals, heard, common, anchor, stamp_ns, residual, variance, sigma):
        return CONTRADICTS, 1.0
    return code, factor


@compiled(
    f"int64({_STATE}, {_SETTINGS}, int64, {INDICES}, {VECTOR}, {VECTOR}, {MATRIX}, {VECTOR}, {MATRIX},"
    f" {INDICES}, {MATRIX}, int64)"
)
def judge_together(
    state: State,
    settings: Settings,
    stamp_ns: int,
    anchors: IntArray,
    rx_power: FloatArray,
    fp_power: FloatArray,
    rows: FloatArray,
    mean: FloatArray,
    cov: FloatArray,
    codes: IntArray,
    report: FloatArray,
    begin: int,
) -> int:
    """Verdicts on ranges that are expected together: what is used corrects those after it.

    Args:
        state: as of `judged`.
        settings: likewise.
        stamp_ns: when they were measured.
        anchors: (N,) numbers of `reduce_heights`.
        rx_power: (N,) [dBm].
        fp_power: (N,) [dBm].
        rows: (N, 4) of `reduce_heights`; their sigmas become those they are used with, infinite without.
        mean: (N,) measured minus predicted [m], corrected in place.
        cov: (N, N) of the predictions [m^2], likewise.
        codes: (N,) verdicts, filled in.
        report: (3, N) residuals and NIS, NaN so far, filled in where there are any; `looked` of `judged`.
        begin: first range to be judged.

    Returns:
        N, or the range whose line of sight is to be looked along before the rest can be judged.
    """
    count = len(anchors)
    for k in range(begin, count):
        if anchors[k] < 0:
            codes[k] = anchors[k]
            continue
        residual, sigma = mean[k], rows[k, 3]
        nis = residual**2 / (cov[k, k] + sigma**2)
        code, factor = judged(
            state,
            settings,
            anchors[k],
            stamp_ns,
            rx_power[k],
            fp_power[k],
            sigma,
            residual,
            nis,
            report[2, k],
        )
        if code == LOOK:
            return k
        codes[k], report[0, k], report[1, k] = code, residual, nis
        if code not in (ACCEPTED, DOWNWEIGHTED):
            rows[k, 3] = np.inf
            continue
        rows[k, 3] = factor * sigma
        # As in a Kalman filter.
        for j in range(k + 1, count):
            gain = cov[j, k] / (cov[k, k] + rows[k, 3] ** 2)
            mean[j] -= gain * residual
            for m in range(k + 1, count):
                cov[j, m] -= gain * cov[k, m]
    return count
