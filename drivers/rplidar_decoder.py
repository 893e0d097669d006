"""RPLIDAR answers and scan streams out of damaged bytes: descriptors found, what follows them decoded.

No I/O and no time.
"""

from collections.abc import Callable
from typing import Protocol

from drivers.framing import ByteBuffer, DecodeStats
from drivers.rplidar_capsules import DenseCapsules, ExpressCapsules
from drivers.rplidar_node_stream import NodeStream
from drivers.rplidar_nodes import HqPackets
from drivers.rplidar_packet_stream import PacketFormat, PacketStream
from drivers.rplidar_protocol import (
    DESCRIPTOR,
    DESCRIPTOR_BYTES,
    PACKET_SAMPLES,
    AnswerType,
    Event,
    ScanStarted,
    decode_answer,
)
from drivers.rplidar_ultra import UltraCapsules, UltraDenseCapsules

_FORMATS: dict[AnswerType, Callable[[], PacketFormat]] = {
    AnswerType.EXPRESS_SCAN: ExpressCapsules,
    AnswerType.HQ_SCAN: HqPackets,
    AnswerType.ULTRA_SCAN: UltraCapsules,
    AnswerType.DENSE_SCAN: DenseCapsules,
    AnswerType.ULTRA_DENSE_SCAN: UltraDenseCapsules,
}


class ScanStream(Protocol):
    """What follows the descriptor of a scan, up to the next descriptor."""

    def step(self, buffer: ByteBuffer, fed: int, events: list[Event]) -> bytes | None:
        """Take packets from the front of the buffer, or skip what are none.

        Args:
            buffer: bytes that wait, at least one.
            fed: how many bytes were ever put into it.
            events: where samples are appended.

        Returns:
            A descriptor, when one was taken; None when more bytes are needed.
        """
        ...

    def lose(self) -> None:
        """Bytes were dropped: nothing that comes next continues what came before."""
        ...


class AnswerDecoder:
    """Bytes from the device to answers and samples, however they are chunked.

    What follows is known from the descriptors alone, never from what was asked, so the incoming half of
    a recorded link is enough. A descriptor is 7 exact bytes. Where are such bytes one, and not data?

    - Outside a stream: anywhere. Leftovers, banner text and unknown answers are skipped.
    - In a standard stream: where the nodes break, from the last 9 bytes of what was taken on, because a
      stream cut inside a node makes it swallow them. A descriptor breaks the nodes: at a node's place by its
      even second byte 5A, inside a node by the guard bits of the next or next but one. Those begun on a
      node's last byte and having an odd length (and HQ on the fourth) read like one node at 0 to 6 deg, which
      is given out if the angle was just there; they are data only if the bytes after them continue as nodes.
    - In a stream of packets: where a packet should begin, and anywhere after damage. Inside a packet whose
      checksum holds they are data. At a packet's place they win over the packet that begins with the
      same 48 bits of content, because waiting for its checksum would hold back short answers.
    """

    def __init__(self, stats: DecodeStats) -> None:
        self._stats = stats
        self._buffer = ByteBuffer(stats)
        self._fed = 0
        self._stream: ScanStream | None = None
        self._answer: tuple[AnswerType, int] | None = None  # what is due, and its length

    def feed(self, data: bytes) -> list[Event]:
        """Events completed by these bytes; never raises on any bytes."""
        self._buffer.push(data)
        self._fed += len(data)
        events: list[Event] = []
        while len(self._buffer) and self._step(events):
            pass
        return events

    def discard(self) -> None:
        """Drop what waits for the rest of its packet: the device fell quiet, the rest will not come."""
        self._buffer.skip(len(self._buffer))
        self._answer = None
        if self._stream is not None:
            self._stream.lose()

    def _step(self, events: list[Event]) -> bool:
        """Take one thing from the buffer; False when it needs more bytes."""
        if self._answer is not None:
            return self._take_answer(*self._answer, events)
        descriptor = (
            self._find() if self._stream is None else self._stream.step(self._buffer, self._fed, events)
        )
        if descriptor:
            self._begin(AnswerType(descriptor[-1]), int.from_bytes(descriptor[2:5], "little"), events)
        return descriptor is not None

    def _begin(self, answer_type: AnswerType, packet_bytes: int, events: list[Event]) -> None:
        """Any descriptor ends what ran before and says what follows."""
        self._stream = None
        if answer_type not in PACKET_SAMPLES:
            self._answer = (answer_type, packet_bytes)
            return
        events.append(ScanStarted(answer_type))
        if answer_type is AnswerType.STANDARD_SCAN:
            self._stream = NodeStream(self._stats)
        else:
            self._stream = PacketStream(answer_type, _FORMATS[answer_type](), self._stats)

    def _find(self) -> bytes | None:
        """Skip to a descriptor."""
        descriptor = DESCRIPTOR.search(self._buffer.view)
        if descriptor is None:
            self._buffer.skip(len(self._buffer) - DESCRIPTOR_BYTES + 1)
            return None
        self._buffer.skip(descriptor.start())
        return self._buffer.take(DESCRIPTOR_BYTES)

    def _take_answer(self, answer_type: AnswerType, size: int, events: list[Event]) -> bool:
        if len(self._buffer) < size:
            return False
        self._answer = None
        answer = decode_answer(answer_type, self._buffer.take(size))
        if answer is None:
            self._stats.bad += 1
        else:
            self._stats.good += 1
            events.append(answer)
        return True
