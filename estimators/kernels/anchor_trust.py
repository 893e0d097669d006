"""Averaged residuals of anchors, and whether they contradict those of the others, see `AnchorTrust`."""

from math import exp, sqrt

import numpy as np

from estimators.kernels.blocked import NEVER
from estimators.kernels.compilation import INDICES, MATRIX, compiled, inlined
from estimators.messages import FloatArray, IntArray

SPAN = 30
"""Over about so many ranges of an anchor its residuals are averaged."""
LEAST = 60
"""Until so many were heard their mean is not known that well."""
CLIPPED = 2.0
"""Sigmas beyond which a residual counts no more: single outliers are no displacement."""
ALLOWED = 0.6
"""Share of a range's sigma by which residuals may err on average: some 5 sigmas of their mean."""
DOUBT = 3.0
"""Sigmas of the pose by which they may err besides."""
AGREES = 0.5
"""Share of what is allowed below which an anchor that is left out agrees again."""
PROBATION = 10.0
"""It must agree for so long [s] before it is believed again, twice as long at every further time."""
RECENT = 2.0
"""What was last heard longer ago [s], an anchor or odometry, is no witness."""
EXPLAINED = 2.0
"""Sigmas of a mean residual that noise explains; what is beyond them is the pose's or the anchor's error."""
FOLLOWED = 1.5
"""How far the pose may be off by such an error: it has followed the anchor, the residual is what remains."""
FADES = 10.0
"""Time constant of that doubt [s]: a pose that has followed a wrong anchor whole no longer contradicts it."""

COUNT, MEAN, BY_POSE, DOUBT_LEFT = 0, 1, 2, 3
"""Of an anchor's residuals: how many, mean [m], mean variance by the pose [m^2], doubt [m]."""
HEARD_NS, AGREES_SINCE_NS, TIMES = 0, 1, 2
"""When an anchor was last heard, since when it has agreed while it is left out, how often it was left out."""
ODOMETRY_NS, AGREE_SINCE_NS, HAVE_AGREED = 0, 1, 2
"""When odometry last came, since when all agree, whether they have for long enough."""


@compiled(f"void({MATRIX}, int64[:, ::1], {INDICES})")
def believe_all(residuals: FloatArray, heard: IntArray, common: IntArray) -> None:
    """Forget what was heard, in place; arguments as of `note`."""
    residuals[:] = 0.0
    heard[:, HEARD_NS] = heard[:, AGREES_SINCE_NS] = NEVER
    heard[:, TIMES] = 0
    common[ODOMETRY_NS] = common[AGREE_SINCE_NS] = NEVER
    common[HAVE_AGREED] = 0


@inlined
def _is_recent(stamp_ns: int, now_ns: int) -> bool:
    return stamp_ns != NEVER and (now_ns - stamp_ns) * 1e-9 <= RECENT


@inlined
def _faded(since_ns: int, now_ns: int) -> float:
    """What is left of a doubt."""
    return exp((since_ns - now_ns) * 1e-9 / FADES) if since_ns != NEVER else 0.0


@compiled(f"float64({MATRIX}, int64[:, ::1], int64)")
def doubt(residuals: FloatArray, heard: IntArray, stamp_ns: int) -> float:
    """How far the pose may be off because an anchor contradicts it, left out or not, [m].

    Whether the pose or the anchor is wrong is not known. So nobody can say that the pose is right.

    Args:
        residuals: as of `note`.
        heard: likewise.
        stamp_ns: now.
    """
    most = 0.0
    for i in range(len(residuals)):
        most = max(most, residuals[i, DOUBT_LEFT] * _faded(heard[i, HEARD_NS], stamp_ns))
    return most


@compiled(f"boolean({MATRIX}, int64[:, ::1], {INDICES}, int64, int64, float64, float64, float64)")
def note(
    residuals: FloatArray,
    heard: IntArray,
    common: IntArray,
    anchor: int,
    stamp_ns: int,
    residual: float,
    variance: float,
    sigma: float,
) -> bool:
    """Take a range that nothing seems to block.

    Args:
        residuals: (A, 4) a row of `COUNT`, `MEAN`, `BY_POSE`, `DOUBT_LEFT` of each anchor.
        heard: (A, 3) a row of `HEARD_NS`, `AGREES_SINCE_NS`, `TIMES` of each anchor.
        common: (3,) `ODOMETRY_NS`, `AGREE_SINCE_NS`, `HAVE_AGREED`.
        anchor: number of the anchor.
        stamp_ns: when it was measured.
        residual: measured minus predicted [m].
        variance: of the residual [m^2], the pose's share included.
        sigma: of the range alone [m].

    Returns:
        Whether the anchor is believed.
    """
    if not _is_recent(common[ODOMETRY_NS], stamp_ns):
        believe_all(residuals, heard, common)
        return True
    if common[AGREE_SINCE_NS] == NEVER:
        common[AGREE_SINCE_NS] = stamp_ns
    bound = CLIPPED * sqrt(variance)
    own, at = residuals[anchor], heard[anchor]
    own[DOUBT_LEFT] *= _faded(at[HEARD_NS], stamp_ns)
    at[HEARD_NS] = stamp_ns
    own[COUNT] += 1.0
    share = 1.0 / min(own[COUNT], SPAN)
    own[MEAN] += share * (min(max(residual, -bound), bound) - own[MEAN])
    own[BY_POSE] += share * (max(variance - sigma**2, 0.0) - own[BY_POSE])
    if own[COUNT] < LEAST:
        return bool(at[AGREES_SINCE_NS] == NEVER)
    noise = sqrt(sigma**2 / (2.0 * SPAN - 1.0) + own[BY_POSE])
    own[DOUBT_LEFT] = max(own[DOUBT_LEFT], FOLLOWED * (abs(own[MEAN]) - EXPLAINED * noise))
    witnesses, count, left_out, most = np.empty(len(residuals)), 0, 0, (len(residuals) - 2) // 2
    for i in range(len(residuals)):
        if heard[i, AGREES_SINCE_NS] != NEVER:
            left_out += 1
        elif i != anchor and residuals[i, COUNT] >= LEAST and _is_recent(heard[i, HEARD_NS], stamp_ns):
            witnesses[count] = residuals[i, MEAN]
            count += 1
    median = np.median(witnesses[:count]) if count else 0.0
    off = min(abs(own[MEAN]), abs(own[MEAN] - median)) / sqrt(
        (ALLOWED * sigma) ** 2 + DOUBT**2 * own[BY_POSE]
    )
    if at[AGREES_SINCE_NS] != NEVER:
        if off > AGREES:
            at[AGREES_SINCE_NS] = stamp_ns
        elif stamp_ns - at[AGREES_SINCE_NS] > PROBATION * 1e9 * 2.0 ** (at[TIMES] - 1):
            at[AGREES_SINCE_NS] = NEVER
    elif off > 1.0 and not common[HAVE_AGREED]:
        common[AGREE_SINCE_NS] = stamp_ns
    elif off > 1.0 and count and left_out < most:
        at[AGREES_SINCE_NS] = stamp_ns
        at[TIMES] += 1
    if stamp_ns - common[AGREE_SINCE_NS] > PROBATION * 1e9:
        common[HAVE_AGREED] = 1
    return bool(at[AGREES_SINCE_NS] == NEVER)
