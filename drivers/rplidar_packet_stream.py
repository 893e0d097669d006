"""RPLIDAR scan packets with a checksum out of damaged streams: where they begin, what is missing.

No I/O and no time. Many packets are taken at once, and where they break the stream moves one byte on; the
SDK moves on by what it took for a packet, and loses more.
"""

import re
from typing import ClassVar, Protocol

from drivers.framing import ByteBuffer, DecodeStats
from drivers.rplidar_nodes import BoolArray, Run
from drivers.rplidar_protocol import DESCRIPTOR, DESCRIPTOR_BYTES, AnswerType, Event, Samples

_WINDOW = 8192  # bytes looked at in one go, so that badly damaged input costs linear time


class PacketFormat(Protocol):
    """Packets of one scan mode. It keeps what decoding one of them needs to know of the one before."""

    PACKET_BYTES: ClassVar[int]
    SAMPLES: ClassVar[int]
    WAITING: ClassVar[int]
    """How many packets wait for the one after them."""
    BEGINNING: ClassVar[re.Pattern[bytes]]
    """First bytes of a packet, as far as they are there."""

    def restart(self) -> None:
        """Forget the packets before."""
        ...

    def found(self, data: bytes) -> BoolArray:
        """Whether a whole and undamaged packet begins at each byte that has room for one."""
        ...

    def runs(self, data: bytes) -> list[Run]:
        """Those of whole packets, without the ones that wait."""
        ...


class PacketStream:
    """Packets of one scan, from its descriptor to the next.

    Args:
        scan_type: kind of the packets.
        packets: their format.
        stats: where packets are counted.
    """

    def __init__(self, scan_type: AnswerType, packets: PacketFormat, stats: DecodeStats) -> None:
        self._scan_type = scan_type
        self._format = packets
        self._stats = stats
        self._in_step = True
        self._gap = False
        self._pending = b""  # packets that wait for the next one
        self._arrived = 0  # samples in all packets so far

    def step(self, buffer: ByteBuffer, fed: int, events: list[Event]) -> bytes | None:
        """See `ScanStream`."""
        window = bytes(buffer.view[:_WINDOW])
        if DESCRIPTOR.match(window):
            return buffer.take(DESCRIPTOR_BYTES)
        found = self._format.found(window)
        if len(found) and found[0]:
            count = self._count(window, found)
            begin = fed - len(buffer)
            self._take(buffer.take(count * self._format.PACKET_BYTES), begin, events)
            return b""
        if self._in_step and (len(found) or not self._format.BEGINNING.match(window)):
            self._stats.bad += 1
            self.lose()
        if self._in_step or (skipped := self._next(window, found)) == 0:
            return None
        buffer.skip(skipped)
        return b""

    def lose(self) -> None:
        """See `ScanStream`."""
        self._in_step = False
        self._gap = True
        self._pending = b""
        self._format.restart()

    def _count(self, window: bytes, found: BoolArray) -> int:
        """How many packets, at least one, follow each other from the first byte on, up to a descriptor."""
        size = self._format.PACKET_BYTES
        if len(found) <= size:
            return 1
        places = found[::size]
        count = int(places.argmin()) or len(places)  # the first is good; it is the least when all are
        for descriptor in DESCRIPTOR.finditer(window, size, count * size):
            if descriptor.start() % size == 0:
                return descriptor.start() // size
        return count

    def _next(self, window: bytes, found: BoolArray) -> int:
        """Offset of the next packet, of a descriptor, or of what may become either; whichever is first."""
        offsets = [len(window)]
        if found.any():
            offsets.append(int(found.argmax()))
        for pattern, start in ((DESCRIPTOR, 0), (self._format.BEGINNING, len(found))):
            if match := pattern.search(window, start):
                offsets.append(match.start())
        return min(offsets)

    def _take(self, data: bytes, begin: int, events: list[Event]) -> None:
        """Decode packets that follow the pending one.

        Args:
            data: whole packets.
            begin: how many bytes had been fed before them.
            events: where samples are appended.
        """
        layout = self._format
        size = layout.PACKET_BYTES
        self._in_step = True
        self._stats.good += len(data) // size
        begin -= len(self._pending)
        first_number = self._arrived - len(self._pending) // size * layout.SAMPLES
        self._arrived += len(data) // size * layout.SAMPLES
        data = self._pending + data
        self._pending = data[len(data) - size * layout.WAITING :]
        done = 0
        for run in layout.runs(data):
            gap = self._gap or run.packet > done
            done = run.packet + run.count // layout.SAMPLES
            number, end = first_number + run.packet * layout.SAMPLES, begin + done * size
            events.append(
                Samples(self._scan_type, run.batch, run.at, run.count, run.starts, gap, number, end)
            )
            self._gap = False
        self._gap = self._gap or done < len(data) // size - layout.WAITING
