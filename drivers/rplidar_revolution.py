"""One revolution of an RPLIDAR: samples are gathered as they come and become a scan at its end.

No I/O and no clock. All that is done for every sample waits for that end, when it is done for all of them
at once.
"""

from typing import NamedTuple, Protocol

import numpy as np

from drivers.rplidar_nodes import Batch
from drivers.rplidar_protocol import Samples
from estimators.messages import IntArray, Scan

_MIN_SAMPLES = 30  # fewer are not a revolution
_MAX_REVOLUTION_NS = 1_000_000_000  # slower than any of these devices turns


class TimeLine(Protocol):
    """Host times of samples, by how many had been taken with them."""

    def host_ns(self, ticks: int) -> int:
        """That of one [ns]."""
        ...

    def host_times(self, ticks: IntArray) -> IntArray:
        """Those of several [ns], (N,)."""
        ...


class PackedLine(NamedTuple):
    """Samples spread evenly over the time there is, for each at least 1 ns.

    Attributes:
        before_ns: time of the sample before.
        before: how many had been taken with that one.
        samples: how many are spread.
        span_ns: from the sample before to the last of these, if there were no others.
    """

    before_ns: int
    before: int
    samples: int
    span_ns: int

    def host_ns(self, ticks: int) -> int:
        """See `TimeLine`."""
        return self.before_ns + (ticks - self.before) * max(self.samples, self.span_ns) // self.samples

    def host_times(self, ticks: IntArray) -> IntArray:
        """See `TimeLine`."""
        return self.before_ns + (ticks - self.before) * max(self.samples, self.span_ns) // self.samples


class Revolution:
    """Samples since the last start of a revolution; knows whether they may become a `Scan`.

    Args:
        has_quality: whether the device told their quality.
    """

    def __init__(self, has_quality: bool) -> None:
        self._has_quality = has_quality
        self._spans: list[tuple[Batch, int, int]] = []  # in a batch, from the first up to the end
        self._times: list[tuple[TimeLine, int, int]] = []  # the same, by their numbers
        self._first_ns = 0
        self._intact = True

    def add(self, samples: Samples, first: int, end: int, line: TimeLine) -> None:
        """Append some of these samples, from the first up to the end."""
        if not self._intact or first == end:
            return
        number, at = samples.first + first, samples.at + first
        end_number, end_at = samples.first + end, samples.at + end
        if not self._spans:
            self._first_ns = line.host_ns(number + 1)
        elif self._spans[-1][0] is samples.batch:
            at = self._spans.pop()[1]
        self._spans.append((samples.batch, at, end_at))
        if self._times and self._times[-1][0] == line:
            number = self._times.pop()[1]
        self._times.append((line, number, end_number))
        if line.host_ns(end_number) - self._first_ns > _MAX_REVOLUTION_NS:
            self.spoil()

    def spoil(self) -> None:
        """It has a gap or takes too long: give up, and keep nothing more of it."""
        self._intact = False
        self._spans.clear()
        self._times.clear()

    def scan(self, min_range: float, max_range: float) -> Scan | None:
        """The finished revolution; None when it is spoilt or has too few samples."""
        if sum(end - first for _, first, end in self._spans) < _MIN_SAMPLES:
            return None
        parts = ([column[first:end] for column in batch.decoded()] for batch, first, end in self._spans)
        angle_q14, distance_q2, quality = map(np.concatenate, zip(*parts, strict=True))
        times = [line.host_times(np.arange(first + 1, end + 1)) for line, first, end in self._times]
        times_ns = np.concatenate(times)
        ranges = distance_q2 / 4000
        ranges[(ranges < min_range) | (ranges > max_range)] = 0.0
        return Scan(
            stamp_ns=int(times_ns[0]),
            # clockwise in 65536 parts of a turn -> counter-clockwise in [-pi, pi), as 16 bits wrap
            angles=(-angle_q14).astype(np.int16) * np.float64(np.pi / 32768),
            ranges=ranges,
            beam_times=(times_ns - times_ns[0]) * 1e-9,
            quality=quality.astype(np.float64) if self._has_quality else np.zeros(len(times_ns)),
        )
