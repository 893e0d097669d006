"""Anchors whose ranges contradict all others: moved, surveyed wrongly or misread, and left out for a while."""

from dataclasses import dataclass
from math import sqrt

SPAN = 30
"""Over about so many ranges of an anchor its residuals are averaged."""
LEAST = 10
"""A mean of fewer says nothing."""
CLIPPED = 3.0
"""Sigmas beyond which a residual counts no more: single outliers are no displacement."""
DOUBT = 3.0
"""Sigmas of the pose that a mean is allowed on top of the sigma of a range."""
AGREES = 0.5
"""Share of what is allowed below which an anchor that is left out agrees again."""
PROBATION = 10.0
"""It must agree for so long [s] before it is believed again, twice as long at every further time."""
RECENT = 2.0
"""An anchor that was last heard longer ago [s] is no witness against another."""
WITNESSES = 2
"""So many others must agree with the pose, or an anchor alone is not to blame."""


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

    def note(self, residual: float, variance: float, sigma: float) -> None:
        bound = CLIPPED * sqrt(variance)
        self.count += 1
        share = 1.0 / min(self.count, SPAN)
        self.mean += share * (min(max(residual, -bound), bound) - self.mean)
        self.by_pose += share * (max(variance - sigma**2, 0.0) - self.by_pose)


class AnchorTrust:
    """Leaves out an anchor whose ranges err by more than a range's sigma on average.

    A filter draws the pose towards an anchor that stands elsewhere than the site file says, and its residuals
    fade. But the odometry holds the pose for a while, so they do not fade at once, and the mean of some tens
    of them is known far better than a single one. Ranges of an anchor that is left out say how the pose,
    which then owes them nothing, agrees with it.

    With n anchors no more than (n - 2) / 2 are left out, and only while others agree. Beyond that nobody can
    tell whose fault it is, and no anchor is believed until the pose that odometry carries on agrees with it.

    Args:
        anchors: how many the site has.

    Source: fault detection and exclusion by averaged innovations, Diesel and Luu, "GPS/IRS AIME", ION GPS
    1995; how many can be told apart: the majority that a redundancy of n - 2 leaves.
    """

    def __init__(self, anchors: int) -> None:
        self._most = (anchors - 2) // 2
        self.reset()

    def reset(self) -> None:
        """Believe every anchor."""
        self._records: dict[int, _Record] = {}

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
        record = self._records.setdefault(anchor_id, _Record())
        record.note(residual, variance, sigma)
        record.stamp_ns = stamp_ns
        off = abs(record.mean) / sqrt(sigma**2 + DOUBT**2 * record.by_pose)
        if record.agrees_since_ns is None:
            if record.count >= LEAST and off > 1.0:
                self._leave_out(record, stamp_ns)
        elif off > AGREES:
            record.agrees_since_ns = stamp_ns
        elif stamp_ns - record.agrees_since_ns > PROBATION * 1e9 * 2 ** (record.times - 1):
            record.agrees_since_ns = None

    def _leave_out(self, record: _Record, stamp_ns: int) -> None:
        believed = [other for other in self._records.values() if other.agrees_since_ns is None]
        witnesses = [
            other
            for other in believed
            if other is not record and other.count >= LEAST and stamp_ns - other.stamp_ns <= RECENT * 1e9
        ]
        left_out = len(self._records) - len(believed)
        is_alone = left_out < self._most and len(witnesses) >= WITNESSES
        for blamed in [record] if is_alone else believed:
            blamed.agrees_since_ns = stamp_ns
            blamed.times += 1
