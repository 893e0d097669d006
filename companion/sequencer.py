"""Puts measurements of all sensors into stamp order before the estimators see them."""

import heapq

from estimators.messages import Measurement, measurement_stamp_ns


class Sequencer:
    """Holds measurements for a fixed time, then releases them oldest first.

    A scan is known only when its last beam is in, ranges at once: without a hold the ranges would
    overtake it. What comes later than the hold allows is dropped and counted.

    Args:
        hold_ns: how long a measurement waits for older ones.
    """

    def __init__(self, hold_ns: int) -> None:
        self._hold_ns = hold_ns
        self._waiting: list[tuple[int, int, Measurement]] = []
        self._pushed = 0
        self._released_ns: int | None = None
        self.late = 0
        """Measurements dropped because newer ones had been released."""

    def push(self, measurement: Measurement) -> None:
        """Take a measurement in."""
        stamp_ns = measurement_stamp_ns(measurement)
        if self._released_ns is not None and stamp_ns < self._released_ns:
            self.late += 1
            return
        heapq.heappush(self._waiting, (stamp_ns, self._pushed, measurement))
        self._pushed += 1

    def release(self, now_ns: int) -> list[Measurement]:
        """Measurements that have waited long enough at `now_ns`, in stamp order."""
        due = now_ns - self._hold_ns
        released: list[Measurement] = []
        while self._waiting and self._waiting[0][0] <= due:
            stamp_ns, _, measurement = heapq.heappop(self._waiting)
            self._released_ns = stamp_ns
            released.append(measurement)
        return released
