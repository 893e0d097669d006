"""RPLIDAR capsules, encoded and decoded: packets whose samples are spread evenly up to the next packet.

No I/O and no time. A capsule begins with two sync nibbles around its checksum and tells the head's direction
at its first sample; the others follow in equal steps up to the direction that the next capsule tells. In
the modes express and ultra the beam is behind that direction, because the optics see near targets
elsewhere. Integer arithmetic as in the SDK, so that values are equal to the bit. Integers carry their scale
as in `drivers.rplidar_protocol`.

Source: rplidar_sdk @99478e5 handler_capsules.cpp; Slamtec interface protocol rev 2.2, figures 4-11 to 4-19.
"""

import re
import struct
from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from drivers.rplidar_nodes import TURN_Q6, BoolArray, ByteArray, Columns, Numbers, Run, bounded, to_q14
from estimators.messages import IntArray

_NONE, _GOOD, _BAD = np.zeros(0, np.bool_), np.ones(1, np.bool_), np.zeros(1, np.bool_)
_SYNC = (0xA0, 0x50)
_BODY = 4  # where the samples begin, after sync, checksum and direction
_EXPRESS_CABIN = np.dtype([("words", "<u2", (2,)), ("offsets", "u1")])  # two samples
_NIBBLES = np.stack((np.arange(256) & 15, np.arange(256) >> 4), axis=1)
_QUALITY_OF_RETURN = 188  # as the SDK reports it where the packets carry none
_MOST_PACKETS = 64  # wait to be decoded, so that memory is bounded; more than a revolution's
_MAX_Q6_PER_US = 64 * 360 * 20e-6  # 20 revolutions/s; known devices turn at 15 at most


class Capsules(ABC):
    """Packets of one mode, in the order they arrived."""

    PACKET_BYTES: ClassVar[int]
    SAMPLES: ClassVar[int]
    WAITING: ClassVar[int] = 1  # a packet is decoded when the next one is there
    BEGINNING: ClassVar[re.Pattern[bytes]] = re.compile(rb"[\xa0-\xaf](?:[\x50-\x5f]|\Z)")
    _ANGLE_AT: ClassVar[int] = 2  # where the direction is told
    _SLOWEST_SAMPLE_US: ClassVar[int]  # of known devices in this mode, with some margin

    def __init__(self) -> None:
        self._max_span_q6 = int(self.SAMPLES * self._SLOWEST_SAMPLE_US * _MAX_Q6_PER_US)
        self.restart()

    def restart(self) -> None:
        """Forget the packets before: what comes next does not continue them."""
        self._start_is_due = False
        self._batch = CapsuleBatch(self, 0)

    def found(self, data: bytes) -> BoolArray:
        """Whether a packet with good sync nibbles and checksum begins at each byte that has room for one."""
        count = len(data) - self.PACKET_BYTES + 1
        if count <= 0:
            return _NONE
        if count == 1:
            whole = _checksum(data[2:])
            return _GOOD if data[0] == whole & 15 | _SYNC[0] and data[1] == whole >> 4 | _SYNC[1] else _BAD
        raw = np.frombuffer(data, np.uint8)
        folded = np.bitwise_xor.accumulate(raw)
        checksum = folded[self.PACKET_BYTES - 1 :] ^ folded[1 : count + 1]
        begins: BoolArray = raw[:count] == (checksum & 15 | _SYNC[0])
        begins &= raw[1 : count + 1] == (checksum >> 4 | _SYNC[1])
        return begins

    def runs(self, data: bytes) -> list[Run]:
        """Runs of all packets but the last, where a packet and the one after it fit each other.

        The two need a common scale of angles. They have none when the second says (S) that the device
        restarted its encoder, when the head did not turn (a packet came twice), or when it turned farther
        than the slowest sampling and the fastest rotation of the mode give: then packets were lost whole, or
        the head turned back. The SDK draws this line for the dense modes alone, at 100 revolutions/s.
        """
        size, angle_at = self.PACKET_BYTES, self._ANGLE_AT
        self._batch = self._batch.open()
        runs: list[Run] = []
        goes_on = False
        word = data[angle_at] | data[angle_at + 1] << 8
        for index, end in enumerate(range(size, len(data), size)):
            angle_q6 = word & 0x7FFF
            word = data[end + angle_at] | data[end + angle_at + 1] << 8
            span_q6 = (word - angle_q6) % TURN_Q6
            # S is the highest bit
            if not (0 < span_q6 <= self._max_span_q6 and word < TURN_Q6 and angle_q6 < TURN_Q6):
                self.restart()
                goes_on = False
                continue
            if not goes_on:
                runs.append(Run(index, self._batch, len(self._batch) * self.SAMPLES, 0, []))
                goes_on = True
            step_q16 = (span_q6 << 10) // self.SAMPLES
            start = self._start(angle_q6, step_q16, word < angle_q6)
            if start is not None:
                runs[-1].starts.append(runs[-1].count + start)
            runs[-1].count += self.SAMPLES
            self._batch.add(data[end - size : end], data[end : end + size], angle_q6, step_q16)
        return runs

    @abstractmethod
    def measure(self, packets: ByteArray, before_q2: int) -> tuple[IntArray, IntArray, IntArray | None]:
        """What the samples of all packets but the last measured.

        Args:
            packets: (n, PACKET_BYTES), n >= 2, that follow each other.
            before_q2: distance of the sample before, 0 when there is none.

        Returns:
            distance_q2, quality, and by how much the beam is behind the head's direction (q16; None for 0).
        """

    def _start(self, angle_q6: int, step_q16: int, passes_0: bool) -> int | None:
        """Index in a packet of the last sample before the head's direction passes 0.

        Steps are rounded down, so the next packet may begin at 0 while the last sample's step falls short of
        it. Then that packet's first sample is the start; in ultra mode the SDK has none.
        """
        if self._start_is_due:
            self._start_is_due = False
            return 0
        if not passes_0:
            return None
        before = (((TURN_Q6 - angle_q6) << 10) - 1) // step_q16
        self._start_is_due = before >= self.SAMPLES
        return None if self._start_is_due else before


def _checksum(data: bytes) -> int:
    """XOR of at most 256 bytes, taken for one number and folded: so few cost NumPy more."""
    folded = int.from_bytes(data, "little")
    for bits in (1024, 512, 256, 128, 64, 32, 16, 8):
        folded ^= folded >> bits
    return folded & 0xFF


class CapsuleBatch:
    """Samples of capsules without a gap, decoded together: the steps cost the more the fewer they do at once.

    Args:
        capsules: their format.
        before_q2: distance of the sample before, 0 when there is none.
    """

    def __init__(self, capsules: Capsules, before_q2: int) -> None:
        self._capsules = capsules
        self._before_q2 = before_q2
        self._packets: list[bytes] = []  # the last one only tells how those before it go on
        self._angles_q6: list[int] = []
        self._steps_q16: list[int] = []
        self._columns: Columns | None = None

    def __len__(self) -> int:
        """How many packets have samples here."""
        return len(self._angles_q6)

    def add(self, packet: bytes, following: bytes, angle_q6: int, step_q16: int) -> None:
        """Append a packet that follows those that are there: its first angle, its step."""
        self._packets[-1:] = (packet, following)
        self._angles_q6.append(angle_q6)
        self._steps_q16.append(step_q16)

    def open(self) -> "CapsuleBatch":
        """Where the next packets go: here, or after these when they were asked for or are many."""
        if self._columns is None and len(self) < _MOST_PACKETS:
            return self
        return CapsuleBatch(self._capsules, int(self.decoded().distance_q2[-1]))

    def decoded(self) -> Columns:
        """See `Batch`."""
        if self._columns is None:
            self._columns = self._decode()
            self._packets.clear()
        return self._columns

    def _decode(self) -> Columns:
        packets = np.frombuffer(b"".join(self._packets), np.uint8).reshape(len(self) + 1, -1)
        beam_q16 = np.array(self._steps_q16)[:, None] * np.arange(self._capsules.SAMPLES)
        beam_q16 += np.array(self._angles_q6)[:, None] << 10
        distance_q2, quality, offset_q16 = self._capsules.measure(packets, self._before_q2)
        beam_q16 = beam_q16.ravel()
        if offset_q16 is not None:
            beam_q16 -= offset_q16
        return Columns(to_q14(beam_q16 >> 10), distance_q2, quality)


class ExpressCapsules(Capsules):
    """Legacy express: 32 samples of 1 mm, each with the angle of its beam in 1/8 deg.

    Protocol figure 4-13 calls that angle signed, which is wrong.
    """

    PACKET_BYTES = 84
    SAMPLES = 32
    _SLOWEST_SAMPLE_US = 500

    def measure(
        self,
        packets: ByteArray,
        before_q2: int,  # noqa: ARG002
    ) -> tuple[IntArray, IntArray, IntArray | None]:
        """See `Capsules`."""
        cabins = packets[:-1, _BODY:].copy().view(_EXPRESS_CABIN).ravel()
        words = cabins["words"].astype(np.int64)
        offset_q3 = (words & 3) << 4 | _NIBBLES.take(cabins["offsets"], 0)
        distance_q2 = words.ravel() & ~3
        return distance_q2, quality_of(distance_q2), offset_q3.ravel() << 13


class DenseCapsules(Capsules):
    """Dense: 40 samples of 1 mm; beam and head have the same direction."""

    PACKET_BYTES = 84
    SAMPLES = 40
    _SLOWEST_SAMPLE_US = 250

    def measure(
        self,
        packets: ByteArray,
        before_q2: int,  # noqa: ARG002
    ) -> tuple[IntArray, IntArray, IntArray | None]:
        """See `Capsules`."""
        words: IntArray = packets[:-1, _BODY:].copy().view("<u2").astype(np.int64)
        distance_q2 = words.ravel() << 2
        return distance_q2, quality_of(distance_q2), None


def quality_of(distance_q2: IntArray) -> IntArray:
    """Quality that the SDK reports for packets that carry none."""
    return (distance_q2 > 0) * _QUALITY_OF_RETURN


def encode_express_capsule(
    start_angle_q6: int, start_flag: bool, distances_mm: Numbers, offsets_q3: Numbers
) -> bytes:
    """Packet of 32 samples of a legacy express scan.

    Args:
        start_angle_q6: 0..23039, direction of the head when its first sample was taken.
        start_flag: True on the first packet after a request, or after the encoder was restarted.
        distances_mm: 32 values of 0..16383.
        offsets_q3: 32 values of 0..63 [1/8 deg], by which the beam is behind the head's direction.

    Raises:
        ValueError: a value out of its limits.

    Source: protocol figures 4-11 and 4-13; rplidar_sdk handler_capsules.cpp.
    """
    count = ExpressCapsules.SAMPLES
    distances = bounded("distances_mm", distances_mm, count, 0x3FFF)
    offsets = bounded("offsets_q3", offsets_q3, count, 63).reshape(-1, 2)
    cabins = np.empty(count // 2, _EXPRESS_CABIN)
    cabins["words"] = distances.reshape(-1, 2) << 2 | offsets >> 4
    cabins["offsets"] = offsets[:, 0] & 15 | (offsets[:, 1] & 15) << 4
    return framed(start_word(start_angle_q6, start_flag) + cabins.tobytes())


def encode_dense_capsule(start_angle_q6: int, start_flag: bool, distances_mm: Numbers) -> bytes:
    """Packet of 40 samples of a dense scan.

    Args:
        start_angle_q6: 0..23039, direction when its first sample was taken.
        start_flag: True on the first packet after a request, or after the encoder was restarted.
        distances_mm: 40 values of 0..65535.

    Raises:
        ValueError: a value out of its limits.

    Source: protocol figure 4-19; rplidar_sdk handler_capsules.cpp.
    """
    distances = bounded("distances_mm", distances_mm, DenseCapsules.SAMPLES, 0xFFFF)
    return framed(start_word(start_angle_q6, start_flag) + distances.astype("<u2").tobytes())


def start_word(start_angle_q6: int, start_flag: bool) -> bytes:
    """Direction and S flag as a capsule tells them.

    Raises:
        ValueError: a direction that is not within one turn.
    """
    if not 0 <= start_angle_q6 < TURN_Q6:
        raise ValueError(f"start_angle_q6: {start_angle_q6} is not within 0..{TURN_Q6 - 1}")
    return struct.pack("<H", start_angle_q6 | start_flag << 15)


def framed(body: bytes) -> bytes:
    """A capsule: its body after sync nibbles and checksum."""
    checksum = int(np.bitwise_xor.reduce(np.frombuffer(body, np.uint8)))
    return bytes((_SYNC[0] | checksum & 15, _SYNC[1] | checksum >> 4)) + body
