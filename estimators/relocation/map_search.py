"""The pose of a robot that stands still, from its newest scan in a saved map."""

import numpy as np

from estimators.base import Setup
from estimators.geometry import compose, inverse
from estimators.lidar.floor_map import FloorMap
from estimators.lidar.relocalisation import Candidate, Finding, Relocaliser
from estimators.lidar.scan_preparation import ScanPreparation
from estimators.messages import FloatArray, PoseIncrement, RangeFrame, Scan

STILL = np.array([0.02, 0.02, 0.02])
"""A robot that moves by less from scan to scan [m, m, rad] stands: nothing of a scan need be put straight."""
PERIOD_NS = 2_000_000_000
"""A search takes some tenths of a second: no more often."""
MOST_CELLS = 250_000
"""25 m x 25 m in cells of 5 cm. In a larger map a search would hold everything else up for seconds."""
FRESH_NS = 500_000_000
"""Ranges that are older than the scan by more were perhaps measured elsewhere."""
LEAST_RANGES = 3
"""With fewer, one that is blocked could decide between places that look alike."""
ALONE_AFTER_NS = 2_000_000_000
"""Without ranges nothing is looked for earlier: they may still come."""


class MapSearch:
    """Holds what a search in the map needs, and carries it out when it is time.

    Args:
        floor: the map.
        range_sigma: standard deviation of a range [m].
        setup: geometry of the site.

    Attributes:
        flaw: why the scan of this standstill has no place; empty when it was not looked for.
    """

    def __init__(self, floor: FloorMap, range_sigma: float, setup: Setup) -> None:
        self._relocaliser = Relocaliser(Relocaliser.Config(range_sigma=range_sigma), floor, setup)
        self._preparation = ScanPreparation(setup.scan_preparation, setup.lidar_in_body)
        self._across = floor.cell * float(np.hypot(*floor.occupied.shape))
        self.reset()

    def reset(self) -> None:
        """Forget everything but the map."""
        self.flaw = ""
        self._scan: Scan | None = None
        self._ranges: RangeFrame | None = None
        self._last: PoseIncrement | None = None
        self._first_ns: int | None = None
        self._searched_ns: int | None = None
        self._stands = False

    def add_scan(self, scan: Scan) -> None:
        """Keep the newest scan."""
        self._scan = scan

    def add_ranges(self, frame: RangeFrame) -> None:
        """Keep the newest frame, which must have `LEAST_RANGES` usable ranges."""
        self._ranges = frame

    def add_increment(self, measured: PoseIncrement) -> None:
        """Note whether the robot stands, from an increment that is known to be good."""
        if self._first_ns is None:
            self._first_ns = measured.stamp_ns
        step = _step(self._last, measured)
        self._last = measured
        self._stands = step is not None and bool((np.abs(step) < STILL).all())
        if not self._stands:
            self.flaw = ""

    def search(self, now_ns: int) -> Candidate | None:
        """The one place where the scan of this instant fits; None without, with the reason in `flaw`.

        Args:
            now_ns: stamp of the newest increment.
        """
        scan = self._scan
        is_due = self._searched_ns is None or now_ns - self._searched_ns >= PERIOD_NS
        if not (self._stands and is_due) or scan is None or scan.end_stamp_ns != now_ns:
            return None
        ranges = self._ranges
        if ranges is None or abs(now_ns - ranges.stamp_ns) > FRESH_NS:
            ranges = None
            if self._first_ns is None or now_ns - self._first_ns < ALONE_AFTER_NS:
                return None
        self._searched_ns = now_ns
        points = self._preparation.prepare(scan).points
        # What is further away than the map is wide is not in it, and would make the search slow.
        near = points[np.hypot(points[:, 0], points[:, 1]) <= self._across]
        if 2 * len(near) < len(points):
            near = near[:0]
        result = self._relocaliser.locate(near, ranges)
        if result.finding is Finding.FOUND:
            self.flaw = ""
            return result.candidates[0]
        if result.finding is Finding.AMBIGUOUS:
            self.flaw = f"{len(result.candidates)} places look alike, drive a metre"
        else:
            self.flaw = "scan not in the map, drive a metre"
        return None


def _step(last: PoseIncrement | None, measured: PoseIncrement) -> FloatArray | None:
    """Motion (3,) since the last increment; None when the two do not hang together."""
    if last is None:
        return None
    if measured.from_stamp_ns == last.stamp_ns != measured.stamp_ns:
        return measured.increment
    if measured.from_stamp_ns == last.from_stamp_ns != last.stamp_ns:
        return compose(inverse(last.increment), measured.increment)
    return None
