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

from drivers.rplidar_nodes import TURN_Q6, BoolArray, ByteArray, Decoded, Numbers, bounded, to_q14
from estimators.messages import IntArray

_NONE = np.zeros(0, np.bool_)
_SYNC = (0xA0, 0x50)
_BODY = 4  # where the samples begin, after sync, checksum and direction
_EXPRESS_CABIN = np.dtype([("words", "<u2", (2,)), ("offsets", "u1")])  # two samples
_NIBBLES = np.stack((np.arange(256) & 15, np.arange(256) >> 4), axis=1)
_QUALITY_OF_RETURN = 188  # as the SDK reports it where the packets carry none
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
        self._sample = np.arange(self.SAMPLES)
        self.restart()

    def restart(self) -> None:
        """Forget the packets before: what comes next does not continue them."""
        self._start_is_due = False

    def found(self, data: bytes) -> BoolArray:
        """Whether a packet with good sync nibbles and checksum begins at each byte that has room for one."""
        count = len(data) - self.PACKET_BYTES + 1
        if count <= 0:
            return _NONE
        raw = np.frombuffer(data, np.uint8)
        if count == 1:
            whole = int(np.bitwise_xor.reduce(raw[2:]))
            return np.array([raw[0] == (whole & 15 | _SYNC[0]) and raw[1] == (whole >> 4 | _SYNC[1])])
        folded = np.bitwise_xor.accumulate(raw)
        checksum = folded[self.PACKET_BYTES - 1 :] ^ folded[1 : count + 1]
        begins: BoolArray = raw[:count] == (checksum & 15 | _SYNC[0])
        begins &= raw[1 : count + 1] == (checksum >> 4 | _SYNC[1])
        return begins

    def decode(self, packets: ByteArray) -> list[tuple[int, Decoded]]:
        """Samples of all packets but the last, where a packet and the one after it fit each other.

        The two need a common scale of angles. They have none when the second says (S) that the device
        restarted its encoder, when the head did not turn (a packet came twice), or when it turned farther
        than the slowest sampling and the fastest rotation of the mode give: then packets were lost whole, or
        the head turned back. The SDK draws this line for the dense modes alone, at 100 revolutions/s.

        Args:
            packets: (n, PACKET_BYTES), n >= 1.

        Returns:
            Runs of packets without a gap: index of a run's first packet, its samples.
        """
        words = packets[:, self._ANGLE_AT : self._ANGLE_AT + 2].copy().view("<u2").ravel().astype(np.int64)
        angle_q6 = words & 0x7FFF
        before_q6, after_q6 = angle_q6[:-1], angle_q6[1:]
        span_q6 = (after_q6 - before_q6) % TURN_Q6
        passes_0 = after_q6 < before_q6
        fits = (span_q6 > 0) & (span_q6 <= self._max_span_q6)
        fits &= (words[1:] < TURN_Q6) & (before_q6 < TURN_Q6)  # S is the highest bit
        runs: list[tuple[int, Decoded]] = []
        first = 0
        for end in [*(~fits).nonzero()[0].tolist(), len(fits)]:
            if first < end:
                step_q16 = (span_q6[first:end] << 10) // self.SAMPLES
                starts = self._starts(angle_q6[first:end], step_q16, passes_0[first:end])
                runs.append(
                    (first, self._samples(packets[first : end + 1], angle_q6[first:end], step_q16, starts))
                )
            if end < len(fits):
                self.restart()
            first = end + 1
        return runs

    def _samples(
        self, packets: ByteArray, angle_q6: IntArray, step_q16: IntArray, starts: BoolArray
    ) -> Decoded:
        beam_q16 = ((angle_q6[:, None] << 10) + step_q16[:, None] * self._sample).ravel()
        distance_q2, quality, offset_q16 = self._measure(packets)
        if offset_q16 is not None:
            beam_q16 -= offset_q16
        return Decoded(to_q14(beam_q16 >> 10), distance_q2, quality, starts)

    @abstractmethod
    def _measure(self, packets: ByteArray) -> tuple[IntArray, IntArray, IntArray | None]:
        """distance_q2, quality, and by how much the beam is behind the head's direction (q16; None for 0)."""

    def _starts(self, angle_q6: IntArray, step_q16: IntArray, passes_0: BoolArray) -> BoolArray:
        """True at the last sample before the head's direction passes 0.

        Steps are rounded down, so the next packet may begin at 0 while the last sample's step falls short of
        it. Then that packet's first sample is the start; in ultra mode the SDK has none.
        """
        starts = np.zeros(len(step_q16) * self.SAMPLES, np.bool_)
        starts[0] = self._start_is_due
        self._start_is_due = False
        for packet in passes_0.nonzero()[0].tolist():
            to_0_q16 = (TURN_Q6 - int(angle_q6[packet])) << 10
            before = min((to_0_q16 - 1) // int(step_q16[packet]), self.SAMPLES)
            start = packet * self.SAMPLES + before
            if start < len(starts):
                starts[start] = True
            else:
                self._start_is_due = True
        return starts


class ExpressCapsules(Capsules):
    """Legacy express: 32 samples of 1 mm, each with the angle of its beam in 1/8 deg.

    Protocol figure 4-13 calls that angle signed, which is wrong.
    """

    PACKET_BYTES = 84
    SAMPLES = 32
    _SLOWEST_SAMPLE_US = 500

    def _measure(self, packets: ByteArray) -> tuple[IntArray, IntArray, IntArray | None]:
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

    def _measure(self, packets: ByteArray) -> tuple[IntArray, IntArray, IntArray | None]:
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
