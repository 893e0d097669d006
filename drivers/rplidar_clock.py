"""The count of an RPLIDAR's samples as a clock, with the two faults that only arrivals show.

No I/O and no clock of the host: arrivals go in, host times of samples come out.
"""

import logging
from collections.abc import Iterable

from drivers.clock import ClockLine, DeviceClock

_log = logging.getLogger(__name__)

_MS = 1_000_000
_ENDLESS = 1 << 62  # samples are counted without wrapping
_LATE_NS = 30 * _MS  # more than a host's usual jitter ...
_LATE_FOR_NS = 300 * _MS  # ... for longer than its stalls
_LONGEST_DELAY_NS = 500 * _MS  # more is not held back anywhere for long: it was lost
_UNEVEN = 0.02  # the head turns more evenly than this from one revolution to the next
_RATE_WINDOW_NS = 1500 * _MS
_MAX_RATE_ERROR = 0.05  # `DeviceClock` learns smaller ones; a stall of 150 ms looks like this


class SampleClock:
    """The count of samples as a clock: the device takes them at an even rate, and their arrivals set it.

    Arrivals also show what the count cannot: samples that were lost without a trace, after which all seem
    late; and a wrong sample duration, assumed or told (answers have no checksum). Bytes that are merely late
    look like lost samples but for the head: it turns evenly, so a revolution with lost samples is too short.

    Args:
        sample_ns: time from one sample to the next [ns].
    """

    def __init__(self, sample_ns: int) -> None:
        self._sample_ns = sample_ns
        self._clock = DeviceClock(sample_ns, _ENDLESS)
        self._measured_ns = 0
        self.restart()

    def restart(self) -> None:
        """Samples were lost: their count has lost its relation to time."""
        self._clock.restart()
        self._late_since_ns: int | None = None
        self._is_uneven = False  # a revolution was, since arrivals are late
        self._last_start: int | None = None
        self._revolution: int | None = None  # samples in the last one
        self._window: tuple[int, int] | None = None  # count and arrival at its beginning

    def note_starts(self, counts: Iterable[int]) -> None:
        """Take note of where revolutions began.

        Args:
            counts: numbers of their first samples, in order, before `line` is asked for these.
        """
        for count in counts:
            samples = None if self._last_start is None else count - self._last_start
            if samples is not None and self._revolution is not None:
                self._is_uneven |= abs(samples - self._revolution) > _UNEVEN * self._revolution
            self._last_start, self._revolution = count, samples

    def line(self, end: int, newest: int, arrival_ns: int) -> ClockLine:
        """Host times of samples, by how many had been taken with them.

        Args:
            end: number of the last one of them, counted from 0, plus 1.
            newest: how many samples had been taken when the bytes arrived.
            arrival_ns: when that was, less the latency that is known.
        """
        self._check_rate(newest, arrival_ns)
        self._clock.observe(newest, arrival_ns)
        line = self._clock.line
        if self._late_for_good(line.host_ns(end) + (newest - end) * self._sample_ns, arrival_ns):
            self._clock.restart()
            self._clock.observe(newest, arrival_ns)
            line = self._clock.line
        return line

    def _late_for_good(self, newest_ns: int, arrival_ns: int) -> bool:
        """Whether arrivals have been late for longer than a host is busy, and samples seem to be missing."""
        if arrival_ns - newest_ns <= _LATE_NS:
            self._late_since_ns = None
            self._is_uneven = False
        elif self._late_since_ns is None:
            self._late_since_ns = arrival_ns
        elif arrival_ns - self._late_since_ns > _LATE_FOR_NS:
            is_lost = self._is_uneven or arrival_ns - newest_ns > _LONGEST_DELAY_NS
            if is_lost:
                self._late_since_ns = None
            return is_lost
        return False

    def _check_rate(self, count: int, arrival_ns: int) -> None:
        began, began_ns = self._window = self._window or (count, arrival_ns)
        if arrival_ns - began_ns < _RATE_WINDOW_NS or count == began:
            return
        self._window = (count, arrival_ns)
        measured_ns = (arrival_ns - began_ns) // (count - began)
        # Twice: bytes that were lost in one window look like a longer duration.
        confirmed = abs(measured_ns - self._measured_ns) <= _MAX_RATE_ERROR * measured_ns
        self._measured_ns = measured_ns
        if confirmed and abs(measured_ns - self._sample_ns) > _MAX_RATE_ERROR * self._sample_ns:
            _log.warning("RPLIDAR samples come every %d ns, not %d", measured_ns, self._sample_ns)
            self._sample_ns = measured_ns
            self._clock = DeviceClock(measured_ns, _ENDLESS)
