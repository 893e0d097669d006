"""Anchors whose ranges contradict those of the others: moved or surveyed wrongly; left out for a while."""

from dataclasses import dataclass
from math import sqrt
from statistics import median

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


@dataclass(slots=True)
class _Record:
    """Residuals of an anchor: how many, mean [m], mean variance by the pose [m^2], when the last was noted.

    Besides, since when it has agreed while it is left out, and how often it was left out.
    """

    count: int = 0
    mean: float = 0.0
    by_pose: float = 0.0
    stamp_ns: int = 0
    agrees_since_ns: int | None = None
    times: int = 0

    def note(self, stamp_ns: int, residual: float, variance: float, sigma: float) -> None:
        bound = CLIPPED * sqrt(variance)
        self.stamp_ns = stamp_ns
        self.count += 1
        share = 1.0 / min(self.count, SPAN)
        self.mean += share * (min(max(residual, -bound), bound) - self.mean)
        self.by_pose += share * (max(variance - sigma**2, 0.0) - self.by_pose)


class AnchorTrust:
    """Leaves out an anchor whose ranges err otherwise than those of the others on average.

    A filter draws the pose towards an anchor that stands elsewhere than the site file says, and its residuals
    fade. But odometry holds the pose for a while, so they do not fade at once, and the mean of some tens of
    them is known far better than a single one. Without odometry nothing holds the pose, and every anchor is
    believed. What all anchors err by alike is a bias of the tag, and no anchor's fault.

    A pose that was wrong from the start contradicts anchors, too. So none is left out before all have agreed
    with it for a while.

    With n anchors at most (n - 2) / 2 are left out: more cannot be told from a wrong pose. Ranges of an
    anchor that is left out show whether the pose, which owes them nothing, agrees with it again.

    Args:
        anchors: how many the site has.

    Source: Diesel and Luu, "GPS/IRS AIME: Calculation of thresholds and protection radius using chi-square
    methods", ION GPS 1995, for averaged innovations that inertial memory keeps honest.
    """

    def __init__(self, anchors: int) -> None:
        self._most = max((anchors - 2) // 2, 0)
        self.reset()

    def reset(self) -> None:
        """Believe every anchor."""
        self._records: dict[int, _Record] = {}
        self._odometry_ns: int | None = None
        self._agree_since_ns: int | None = None
        self._have_agreed = False

    def note_odometry(self, stamp_ns: int) -> None:
        """Odometry came."""
        self._odometry_ns = stamp_ns

    def believes(self, anchor_id: int) -> bool:
        """Whether an anchor's ranges may be used."""
        record = self._records.get(anchor_id)
        return record is None or record.agrees_since_ns is None

    def note(self, anchor_id: int, stamp_ns: int, residual: float, variance: float, sigma: float) -> None:
        """Take a range that nothing seems to block.

        Args:
            anchor_id: whose it is.
            stamp_ns: when it was measured.
            residual: measured minus predicted [m].
            variance: of the residual [m^2], the pose's share included.
            sigma: of the range alone [m].
        """
        if not self._most:
            return
        if self._odometry_ns is None or not _is_recent(self._odometry_ns, stamp_ns):
            self.reset()
            return
        if self._agree_since_ns is None:
            self._agree_since_ns = stamp_ns
        record = self._records.setdefault(anchor_id, _Record())
        record.note(stamp_ns, residual, variance, sigma)
        if record.count < LEAST:
            return
        witnesses = [
            other.mean
            for other in self._records.values()
            if other is not record
            and other.agrees_since_ns is None
            and other.count >= LEAST
            and _is_recent(other.stamp_ns, stamp_ns)
        ]
        common = median(witnesses) if witnesses else 0.0
        off = min(abs(record.mean), abs(record.mean - common)) / sqrt(
            (ALLOWED * sigma) ** 2 + DOUBT**2 * record.by_pose
        )
        if record.agrees_since_ns is not None:
            self._try(record, off, stamp_ns)
        elif off > 1.0 and not self._have_agreed:
            self._agree_since_ns = stamp_ns
        elif off > 1.0 and witnesses and self._left_out() < self._most:
            record.agrees_since_ns = stamp_ns
            record.times += 1
        self._have_agreed |= stamp_ns - self._agree_since_ns > PROBATION * 1e9

    def _left_out(self) -> int:
        return sum(record.agrees_since_ns is not None for record in self._records.values())

    def _try(self, record: _Record, off: float, stamp_ns: int) -> None:
        """Believe an anchor again that has agreed for long enough."""
        assert record.agrees_since_ns is not None
        if off > AGREES:
            record.agrees_since_ns = stamp_ns
        elif stamp_ns - record.agrees_since_ns > PROBATION * 1e9 * 2 ** (record.times - 1):
            record.agrees_since_ns = None


def _is_recent(stamp_ns: int, now_ns: int) -> bool:
    return (now_ns - stamp_ns) * 1e-9 <= RECENT
