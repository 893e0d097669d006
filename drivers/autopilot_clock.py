"""An autopilot's clock on the host's time line, from MAVLink TIMESYNC.

A message takes some time to arrive, never less than none. Of many, the one that took least says most: the
least delay is kept for each direction. Half of what the two together take is taken for each.

Source: MAVLink developer guide, Time Synchronization Protocol v2; least delays as in D. Mills, RFC 5905,
clock filter.
"""

from collections import deque

BLOCK_NS = 1_000_000_000
"""One least delay is kept for each of these."""
BLOCKS = 20
"""So many are remembered: clocks that differ by 30 ppm move 0.3 ms apart in half of that time."""
STEP_NS = 500_000_000
"""A clock that falls back, or runs ahead, by more was set anew."""


class _LeastDelay:
    """Least of the delays of the last while."""

    def __init__(self) -> None:
        self._blocks: deque[tuple[int, int]] = deque(maxlen=BLOCKS)
        self.value_ns: int | None = None

    def add(self, at_ns: int, delay_ns: int) -> None:
        block = at_ns // BLOCK_NS
        if not self._blocks or self._blocks[-1][0] != block:
            self._blocks.append((block, delay_ns))
        elif delay_ns < self._blocks[-1][1]:
            self._blocks[-1] = (block, delay_ns)
        else:
            return
        self.value_ns = min(least_ns for _, least_ns in self._blocks)


class AutopilotClock:
    """Host times for the readings of another computer's clock; both in ns."""

    def __init__(self) -> None:
        self._newest_ns: int | None = None
        self._restart()

    def _restart(self) -> None:
        self._inward, self._outward = _LeastDelay(), _LeastDelay()

    def hear(self, remote_ns: int, arrival_ns: int) -> None:
        """A message was stamped there at `remote_ns` and arrived here at `arrival_ns`."""
        delay_ns = arrival_ns - remote_ns
        least_ns = self._inward.value_ns
        fell = self._newest_ns is not None and remote_ns < self._newest_ns - STEP_NS
        if fell or (least_ns is not None and delay_ns < least_ns - STEP_NS):
            self._restart()
        self._newest_ns = remote_ns
        self._inward.add(arrival_ns, delay_ns)

    def answered(self, sent_ns: int, remote_ns: int, arrival_ns: int) -> None:
        """A request that left here at `sent_ns` was answered there at `remote_ns`."""
        self.hear(remote_ns, arrival_ns)
        self._outward.add(arrival_ns, remote_ns - sent_ns)

    @property
    def offset_ns(self) -> int | None:
        """Its clock minus ours; without answers as if messages took no time; None before the first."""
        inward_ns, outward_ns = self._inward.value_ns, self._outward.value_ns
        if inward_ns is None:
            return None
        return -inward_ns if outward_ns is None else (outward_ns - inward_ns) // 2

    @property
    def round_trip_ns(self) -> int | None:
        """Least time there and back; None without answers."""
        inward_ns, outward_ns = self._inward.value_ns, self._outward.value_ns
        return None if inward_ns is None or outward_ns is None else inward_ns + outward_ns

    def host_ns(self, remote_ns: int, arrival_ns: int) -> int:
        """When it was here what its clock showed; never later than the arrival."""
        offset_ns = self.offset_ns
        return arrival_ns if offset_ns is None else min(remote_ns - offset_ns, arrival_ns)
