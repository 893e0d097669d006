"""A device's own clock on the host's time line, so that a stamp does not wait for its bytes.

Bytes arrive late by a delay that varies: operating system, USB adapter, busy host. No delay is negative, so
the least ones in a stretch of time lie on a line, whose slope is the drift between the two clocks. Times read
off that line are free of the variation; what is left is the least delay, which is constant.

Source: lower envelope as in E. Olson, "A Passive Solution to the Sensor Synchronization Problem", IROS 2010;
drift from the convex hull as in Moon, Skelly and Towsley, "Estimation and Removal of Clock Skew from Network
Delay Measurements", INFOCOM 1999.
"""

from collections import deque
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from estimators.messages import IntArray

_MS = 1_000_000
_BLOCK_NS = 250 * _MS  # one least delay is kept for each
_BLOCKS = 40  # 10 s: quartz drifts little in that time, and stalls do not last as long
_LEAST_SPAN_NS = 1000 * _MS  # before that the drift would be guessed from jitter
_MAX_DRIFT = 0.02  # of a sample duration that a device rounds or a driver had to assume
_MAX_STEP_NS = 500 * _MS  # a delay that changes by more is another clock, or the same one set anew
_MAX_LATE_NS = 1000 * _MS  # how long every arrival may be that late before this is believed


class ClockLine(NamedTuple):
    """Host times of a device's counter, on a line.

    Attributes:
        zero_ns: device time of the reading 0.
        tick_ns: from one reading to the next.
        at_ns: device time of one point on the line.
        delay_ns: host time less device time there.
        drift: by which that rises with device time.
    """

    zero_ns: int
    tick_ns: int
    at_ns: int
    delay_ns: int
    drift: float

    def host_ns(self, ticks: int) -> int:
        """Host time at which the counter had this value."""
        device_ns = self.zero_ns + ticks * self.tick_ns
        return device_ns + self.delay_ns + round(self.drift * (device_ns - self.at_ns))

    def host_times(self, ticks: IntArray) -> IntArray:
        """Host times [ns] of several readings, (N,); the same as those of each."""
        device_ns = self.zero_ns + ticks * self.tick_ns
        times: IntArray = device_ns + self.delay_ns
        times += np.rint(self.drift * (device_ns - self.at_ns)).astype(np.int64)
        return times


class DeviceClock:
    """Host times for the readings of a counter on a device.

    Args:
        tick_ns: time from one count to the next [ns].
        wrap: the counter starts again from 0 when it reaches this.
    """

    def __init__(self, tick_ns: int, wrap: int) -> None:
        self._tick_ns = tick_ns
        self._wrap = wrap
        self._last_stamp_ns: int | None = None
        self._drift = 0.0
        self.restart()

    def restart(self) -> None:
        """The counter has lost its relation to time (reset, lost bytes); the drift is kept."""
        self._last_ticks: int | None = None
        self._device_ns = 0  # unwrapped reading
        self._runs = False
        self._late_since_ns: int | None = None
        self._blocks: deque[tuple[int, int]] = deque(maxlen=_BLOCKS)  # (device time, least delay)
        self._line = (0, 0)  # device time and delay of one point on it; its slope is the drift

    def observe(self, ticks: int, arrival_ns: int) -> None:
        """Learn from a reading and the arrival of its bytes.

        Of several readings in one chunk the newest is enough: it waited least.
        """
        if self._last_ticks is not None:
            half = self._wrap // 2
            advance = (ticks - self._last_ticks + half) % self._wrap - half
            device_ns = self._device_ns + advance * self._tick_ns
            delay_ns = arrival_ns - device_ns
            early_ns = self._delay_ns(device_ns) - delay_ns
            if advance * self._tick_ns < -_MAX_STEP_NS or early_ns > _MAX_STEP_NS:
                self.restart()
            elif early_ns >= -_MAX_STEP_NS:
                self._late_since_ns = None
            elif self._late_since_ns is None:
                self._late_since_ns = arrival_ns
            elif arrival_ns - self._late_since_ns > _MAX_LATE_NS:
                self.restart()
        if self._last_ticks is None:
            self._line = (0, arrival_ns)
            self._blocks.append((0, arrival_ns))
        else:
            self._runs = self._runs or advance > 0
            self._device_ns = device_ns
            if early_ns > 0:
                self._line = (device_ns, delay_ns)
            self._add(device_ns, delay_ns)
        self._last_ticks = ticks

    @property
    def line(self) -> ClockLine:
        """Host times of readings near the last one observed."""
        assert self._last_ticks is not None, "no reading was observed yet"
        zero_ns = self._device_ns - self._last_ticks * self._tick_ns
        return ClockLine(zero_ns, self._tick_ns, *self._line, self._drift)

    def stamp(self, ticks: int, arrival_ns: int) -> int:
        """Host time of one reading; never falls from one call to the next and never exceeds the arrival.

        A counter that stands still tells nothing: then the stamp is the arrival.
        """
        self.observe(ticks, arrival_ns)
        stamp_ns = (
            min(self._device_ns + self._delay_ns(self._device_ns), arrival_ns) if self._runs else arrival_ns
        )
        if self._last_stamp_ns is not None:
            stamp_ns = max(stamp_ns, self._last_stamp_ns)
        self._last_stamp_ns = stamp_ns
        return stamp_ns

    def _delay_ns(self, device_ns: int) -> int:
        return self._line[1] + round(self._drift * (device_ns - self._line[0]))

    def _add(self, device_ns: int, delay_ns: int) -> None:
        """Keep the least delay of each block; the line is drawn anew when a block is complete."""
        newest_ns, least_ns = self._blocks[-1]
        blocks = device_ns // _BLOCK_NS - newest_ns // _BLOCK_NS
        if blocks == 0 and delay_ns < least_ns:
            self._blocks[-1] = (device_ns, delay_ns)
        elif blocks > 0:
            self._blocks.append((device_ns, delay_ns))
            if device_ns - self._blocks[0][0] >= _LEAST_SPAN_NS:
                self._fit()

    def _fit(self) -> None:
        """The line that touches the delays from below and is nearest to them on average."""
        last_ns, last_delay_ns = self._blocks[-1]
        # exact: integers before they become floats
        points = [(float(at - last_ns), float(delay - last_delay_ns)) for at, delay in self._blocks]
        self._drift = min(max(_slope_below(points), -_MAX_DRIFT), _MAX_DRIFT)
        above = [delay - self._drift * at for at, delay in points]
        self._line = self._blocks[above.index(min(above))]


def _slope_below(points: list[tuple[float, float]]) -> float:
    """Slope of the lower convex hull of (x, y) where it passes the mean of x; x ascending, N >= 2."""
    middle = sum(x for x, _ in points) / len(points)
    hull: list[tuple[float, float]] = []
    for x2, y2 in points:
        while len(hull) >= 2:
            x0, y0 = hull[-2]
            x1, y1 = hull[-1]
            if (y1 - y0) * (x2 - x0) < (y2 - y0) * (x1 - x0):
                break
            hull.pop()
        hull.append((x2, y2))
    (x0, y0), (x1, y1) = next(edge for edge in pairwise(hull) if edge[1][0] >= middle)
    return (y1 - y0) / (x1 - x0)
