"""Scan streams of an RPLIDAR that turns in a known room, in every mode, with the truth beside the bytes."""

import random
from bisect import bisect_right
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np

from drivers.rplidar_capsules import encode_dense_capsule, encode_express_capsule
from drivers.rplidar_nodes import BoolArray, encode_hq_packet, encode_standard_node
from drivers.rplidar_protocol import PACKET_BYTES, PACKET_SAMPLES, AnswerType, encode_descriptor
from drivers.rplidar_ultra import encode_ultra_capsule, encode_ultra_dense_capsule, ultra_offset_q16
from estimators.messages import FloatArray, IntArray

MS = 1_000_000
SECOND = 1000 * MS
T0_NS = 5 * SECOND
"""Time of the first sample of every stream."""

REVOLUTIONS_PER_S = 9.7  # so that neither samples nor packets repeat from turn to turn
FIRST_DEG = 200.0  # where the head stands at the first sample

# A room around the lidar, in its frame (x forward, y left) [m]: the wall on the left is the near one.
FRONT, BACK, LEFT, RIGHT = 4.0, -2.5, 1.5, -3.0

SAMPLE_NS = {
    AnswerType.STANDARD_SCAN: 500_000,
    AnswerType.EXPRESS_SCAN: 250_000,
    AnswerType.HQ_SCAN: 125_000,
    AnswerType.ULTRA_SCAN: 125_000,
    AnswerType.DENSE_SCAN: 108_000,
    AnswerType.ULTRA_DENSE_SCAN: 31_250,
}
"""What the driver assumes where the device does not tell the duration of a sample."""


def room_range(angle: FloatArray) -> FloatArray:
    """Distance to the walls [m] in directions counter-clockwise from x [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    with np.errstate(divide="ignore"):
        to_x = np.where(c > 0, FRONT / c, BACK / c)
        to_y = np.where(s > 0, LEFT / s, RIGHT / s)
    return np.minimum(np.abs(to_x), np.abs(to_y))


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """A scan as it goes over the line.

    Attributes:
        kind: of its packets.
        sample_ns: time from one sample to the next.
        descriptor: what opens it.
        packets: one after the other.
        angles: (N,) [rad], true direction of each sample, counter-clockwise from x.
    """

    kind: AnswerType
    sample_ns: int
    descriptor: bytes
    packets: tuple[bytes, ...]
    angles: FloatArray

    @property
    def packet_ns(self) -> int:
        """Time that the samples of one packet take."""
        return PACKET_SAMPLES[self.kind] * self.sample_ns

    def on_time(self) -> list[tuple[bytes, int]]:
        """The descriptor, and then each packet with the time of its last sample."""
        begin_ns = T0_NS - self.sample_ns
        parts = enumerate((self.descriptor, *self.packets))
        return [(data, begin_ns + i * self.packet_ns) for i, data in parts]

    def line(self) -> tuple[bytes, IntArray]:
        """All bytes, and when each is on the line: a packet's spread evenly up to its last sample."""
        size = PACKET_BYTES[self.kind]
        begin_ns = T0_NS - self.sample_ns
        ends_ns = begin_ns + self.packet_ns * np.arange(1, len(self.packets) + 1)
        before_end_ns = self.packet_ns * np.arange(size - 1, -1, -1) // size
        opening = np.full(len(self.descriptor), begin_ns)
        arrivals = np.append(opening, ends_ns[:, None] - before_end_ns)
        return self.descriptor + b"".join(self.packets), arrivals


@cache
def stream(kind: AnswerType, seconds: float, sample_ns: int = 0) -> Stream:
    """The room as the device sees it for so long; sample_ns 0 = what the driver assumes."""
    sample_ns = sample_ns or SAMPLE_NS[kind]
    group = PACKET_SAMPLES[kind]
    count = int(seconds * SECOND / (group * sample_ns)) * group
    head_deg = FIRST_DEG + 360 * REVOLUTIONS_PER_S * np.arange(-1, count) * sample_ns / SECOND
    starts = np.diff(np.floor(head_deg / 360)) > 0
    head_deg = head_deg[1:]
    beam_deg = head_deg - _offset_deg(kind, head_deg)
    mm = np.rint(1000 * room_range(-np.radians(beam_deg))).astype(np.int64)
    head_q6 = (head_deg * 64).astype(np.int64) % (360 * 64)
    packets = tuple(_encode(kind, slice(i, i + group), head_q6, mm, starts) for i in range(0, count, group))
    return Stream(kind, sample_ns, encode_descriptor(kind), packets, -np.radians(beam_deg))


def _offset_deg(kind: AnswerType, head_deg: FloatArray) -> FloatArray:
    """How far the beam is behind the head's direction, as real optics make it."""
    if kind is AnswerType.EXPRESS_SCAN:
        return _express_offsets_q3(len(head_deg)) / 8
    offset_deg = np.zeros_like(head_deg)
    if kind is AnswerType.ULTRA_SCAN:
        for _ in range(5):  # it depends on the distance, which depends on it
            mm = np.rint(1000 * room_range(-np.radians(head_deg - offset_deg))).astype(np.int64)
            offset_deg = ultra_offset_q16(mm) / 65536
    return offset_deg


def _express_offsets_q3(count: int) -> IntArray:
    return 7 * (np.arange(count) % 32) % 64


def _encode(kind: AnswerType, part: slice, head_q6: IntArray, mm: IntArray, starts: BoolArray) -> bytes:
    start_q6, is_first = int(head_q6[part.start]), part.start == 0
    count = part.stop - part.start
    match kind:
        case AnswerType.STANDARD_SCAN:
            return encode_standard_node(start_q6, 4 * int(mm[part.start]), 30, bool(starts[part.start]))
        case AnswerType.EXPRESS_SCAN:
            return encode_express_capsule(start_q6, is_first, mm[part], _express_offsets_q3(count))
        case AnswerType.ULTRA_SCAN:
            following = int(mm[part.stop]) if part.stop < len(mm) else 0
            return encode_ultra_capsule(start_q6, is_first, mm[part], following)
        case AnswerType.DENSE_SCAN:
            return encode_dense_capsule(start_q6, is_first, mm[part])
        case AnswerType.ULTRA_DENSE_SCAN:
            qualities = np.full(count, 80)
            return encode_ultra_dense_capsule(start_q6, is_first, mm[part], qualities, part.start)
        case _:
            angles_q14 = (head_q6[part] << 8) // 90
            qualities = np.full(count, 200)
            return encode_hq_packet(part.start, angles_q14, 4 * mm[part], qualities, starts[part].tolist())


def cut(data: bytes, arrivals: IntArray, sizes: Iterable[int]) -> list[tuple[bytes, int]]:
    """Bytes in chunks of these sizes, each stamped with the arrival of its last byte."""
    chunks = []
    at = 0
    for size in sizes:
        end = min(len(data), at + size)
        chunks.append((data[at:end], int(arrivals[end - 1])))
        at = end
        if at == len(data):
            break
    return chunks


def random_sizes(rng: random.Random, longest: int) -> Iterator[int]:
    """Sizes of chunks, without end."""
    while True:
        yield rng.randint(1, longest)


def read_by_a_busy_host(
    data: bytes, arrivals: IntArray, least_delay_ns: int, seed: int
) -> list[tuple[bytes, int]]:
    """Chunks as a host gets them: it takes what is there every 3 ms or so, at times up to 50 ms later."""
    rng = np.random.default_rng(seed)
    on_line = (arrivals + least_delay_ns).tolist()
    chunks: list[tuple[bytes, int]] = []
    at, now_ns = 0, T0_NS
    while at < len(data):
        stall = rng.uniform(0, 50 * MS) if rng.random() < 0.02 else 0.0
        now_ns += round(0.2 * MS + rng.exponential(3 * MS) + stall)
        end = bisect_right(on_line, now_ns)
        if end > at:
            chunks.append((data[at:end], now_ns))
        at = end
    return chunks
