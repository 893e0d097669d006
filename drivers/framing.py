"""What all drivers share: the Sensor interface, statistics, and a byte buffer that stays bounded.

A sensor is free of I/O and of clocks. Bytes and their arrival stamp go in through `feed`, measurements
come out; `poll` gives the bytes that the device should be sent now. So the same object serves a serial
port, a pseudo-terminal, an emulator in memory and the replay of a log.
"""

from dataclasses import dataclass
from typing import ClassVar, Protocol

from estimators.messages import Measurement


@dataclass(slots=True)
class DecodeStats:
    """Counts of what a decoder made of its bytes, since it was built.

    Attributes:
        good: frames decoded.
        bad: frames refused: wrong checksum, impossible length, impossible content.
        skipped_bytes: bytes that belong to no frame.
        resyncs: how often a run of skipped bytes began.
    """

    good: int = 0
    bad: int = 0
    skipped_bytes: int = 0
    resyncs: int = 0


class Sensor(Protocol):
    """A device on a byte stream: decoder of its answers and, where it has one, its command dialogue."""

    MEASURES: ClassVar[frozenset[type]]
    """Types of the measurements it makes."""
    BAUDS: ClassVar[tuple[int, ...]]
    """Rates at which its devices speak, the most usual first; for those whose port is looked for."""

    DTR_STOPS: ClassVar[bool]
    """Whether its motor stands while the port's DTR line is on."""

    stats: DecodeStats

    def feed(self, data: bytes, stamp_ns: int) -> list[Measurement]:
        """Decode bytes that arrived at `stamp_ns`; never raises on any bytes."""
        ...

    def connected(self, now_ns: int) -> None:
        """The port was (re)opened: start the dialogue from its beginning."""
        ...

    def poll(self, now_ns: int) -> bytes:
        """Bytes to send to the device now; empty when there is nothing to say."""
        ...

    def closing(self) -> list[bytes]:
        """Writes, a pause after each, that leave the device quiet when the port is about to be closed."""
        ...


class ByteBuffer:
    """Bytes that wait for the rest of their frame.

    Decoders look at `view`, then either `take` a frame or `skip` one byte after a false start. Runs of
    skipped bytes are counted as one resync. The reader decides how long it waits, so the bound is the
    longest frame plus one chunk.
    """

    def __init__(self, stats: DecodeStats) -> None:
        self._data = bytearray()
        self._stats = stats
        self._in_sync = True

    def __len__(self) -> int:
        return len(self._data)

    @property
    def view(self) -> bytearray:
        """All waiting bytes, oldest first; not to be changed."""
        return self._data

    def push(self, data: bytes) -> None:
        """Append newly arrived bytes."""
        self._data += data

    def skip(self, count: int) -> None:
        """Drop bytes that belong to no frame."""
        if count <= 0:
            return
        del self._data[:count]
        self._stats.skipped_bytes += count
        if self._in_sync:
            self._stats.resyncs += 1
            self._in_sync = False

    def take(self, count: int) -> bytes:
        """Remove and return a whole frame."""
        frame = bytes(self._data[:count])
        del self._data[:count]
        self._in_sync = True
        return frame
