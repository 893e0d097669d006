"""What the tests of the RPLIDAR decoder share: streams of every mode, and samples one by one."""

import random
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from hypothesis import strategies as st

from drivers.framing import DecodeStats
from drivers.rplidar_capsules import encode_dense_capsule, encode_express_capsule
from drivers.rplidar_decoder import AnswerDecoder
from drivers.rplidar_nodes import TURN_Q6, encode_hq_packet, encode_standard_node
from drivers.rplidar_protocol import (
    PACKET_BYTES,
    PACKET_SAMPLES,
    AnswerType,
    Event,
    Samples,
    encode_descriptor,
)
from drivers.rplidar_ultra import encode_ultra_capsule, encode_ultra_dense_capsule

Node = tuple[int, int, int, int]
"""angle_q14, distance_q2, quality, start."""

CAPSULES = [
    AnswerType.EXPRESS_SCAN,
    AnswerType.ULTRA_SCAN,
    AnswerType.DENSE_SCAN,
    AnswerType.ULTRA_DENSE_SCAN,
]
CHECKED = [*CAPSULES, AnswerType.HQ_SCAN]
"""Modes whose packets have a checksum."""
MODES = list(PACKET_SAMPLES)


rngs = st.integers(0, 2**32).map(random.Random)


def nodes(events: Iterable[Event]) -> list[Node]:
    return [
        (int(angle), int(distance), int(quality), int(i in event.starts))
        for event in events
        if isinstance(event, Samples)
        for i, (angle, distance, quality) in enumerate(zip(*event.columns, strict=True))
    ]


def reference(rows: Iterable[Sequence[int]]) -> list[Node]:
    """Nodes as the vectors list them."""
    return [(angle, distance, quality, flag & 1) for angle, distance, quality, flag in rows]


def feed(chunks: Iterable[bytes]) -> list[Event]:
    decoder = AnswerDecoder(DecodeStats())
    return [event for chunk in chunks for event in decoder.feed(chunk)]


class Placed(NamedTuple):
    """A sample on its own: its values, whether a gap is before it, its number, where its packet ended."""

    scan_type: AnswerType
    node: Node
    gap: bool
    number: int
    end: int


def one_by_one(events: Iterable[Event]) -> list[object]:
    """Events with every sample on its own: the content alone, however it came together."""
    flat: list[object] = []
    for event in events:
        if isinstance(event, Samples):
            size, group = PACKET_BYTES[event.scan_type], PACKET_SAMPLES[event.scan_type]
            flat += [
                Placed(
                    event.scan_type,
                    node,
                    event.gap and i == 0,
                    event.first + i,
                    event.end - (event.count - 1 - i) // group * size,
                )
                for i, node in enumerate(nodes([event]))
            ]
        else:
            flat.append(event)
    return flat


def decoded(chunks: Iterable[bytes]) -> tuple[list[object], DecodeStats]:
    """All that a decoder tells of these bytes, in a form that must not depend on how they are cut."""
    stats = DecodeStats()
    decoder = AnswerDecoder(stats)
    return one_by_one(event for chunk in chunks for event in decoder.feed(chunk)), stats


def cut(data: bytes, rng: random.Random, longest: int = 200) -> list[bytes]:
    chunks = []
    while data:
        size = rng.randint(1, longest)
        chunks.append(data[:size])
        data = data[size:]
    return chunks


def single_bytes(data: bytes) -> list[bytes]:
    return [data[i : i + 1] for i in range(len(data))]


def packets(
    scan_type: AnswerType, starts_q6: Sequence[int], rng: random.Random, first_flag: bool = True
) -> list[bytes]:
    """Packets with random content; those of a standard scan or of HQ are as long as a capsule would be.

    Args:
        scan_type: kind of the packets.
        starts_q6: direction at the beginning of each packet.
        rng: content of the packets.
        first_flag: S of the first packet.
    """
    make = _MAKERS[scan_type]
    return [make(start_q6 % TURN_Q6, first_flag and i == 0, rng) for i, start_q6 in enumerate(starts_q6)]


def _standard(start_q6: int, start_flag: bool, rng: random.Random) -> bytes:
    return encode_standard_node(start_q6, rng.randrange(0x10000), rng.randrange(64), start_flag)


def _express(start_q6: int, start_flag: bool, rng: random.Random) -> bytes:
    return encode_express_capsule(start_q6, start_flag, _each(rng, 32, 0x4000), _each(rng, 32, 64))


def _ultra(start_q6: int, start_flag: bool, rng: random.Random) -> bytes:
    return encode_ultra_capsule(start_q6, start_flag, _each(rng, 96, 12_000), rng.randrange(12_000))


def _dense(start_q6: int, start_flag: bool, rng: random.Random) -> bytes:
    return encode_dense_capsule(start_q6, start_flag, _each(rng, 40, 0x10000))


def _ultra_dense(start_q6: int, start_flag: bool, rng: random.Random) -> bytes:
    # beyond the distances where one sample changes the next
    far = [2100 + mm for mm in _each(rng, 64, 60_000)]
    return encode_ultra_dense_capsule(start_q6, start_flag, far, _each(rng, 64, 256), rng.randrange(2**32))


def _hq(start_q6: int, start_flag: bool, rng: random.Random) -> bytes:
    angles_q14 = [(start_q6 * 256 // 90 + 40 * k) % 65536 for k in range(96)]
    distances_q2, qualities = _each(rng, 96, 2**20), _each(rng, 96, 256)
    return encode_hq_packet(rng.randrange(2**64), angles_q14, distances_q2, qualities, [False] * 96)


def _each(rng: random.Random, count: int, limit: int) -> list[int]:
    return [rng.randrange(limit) for _ in range(count)]


_MAKERS: dict[AnswerType, Callable[[int, bool, random.Random], bytes]] = {
    AnswerType.STANDARD_SCAN: _standard,
    AnswerType.EXPRESS_SCAN: _express,
    AnswerType.HQ_SCAN: _hq,
    AnswerType.ULTRA_SCAN: _ultra,
    AnswerType.DENSE_SCAN: _dense,
    AnswerType.ULTRA_DENSE_SCAN: _ultra_dense,
}


def standard_nodes(count: int, first: int = 0) -> bytes:
    """A clean turn of nodes, 1.8 deg apart."""
    return b"".join(
        encode_standard_node((first + i) % 200 * 115, 4000 + i, 15, (first + i) % 200 == 0)
        for i in range(count)
    )


def capsule(start_deg: float, start_flag: bool = False, distance_mm: int = 2000) -> bytes:
    """An express packet."""
    return encode_express_capsule(round(start_deg * 64), start_flag, [distance_mm] * 32, [8] * 32)


STANDARD = encode_descriptor(AnswerType.STANDARD_SCAN)
EXPRESS = encode_descriptor(AnswerType.EXPRESS_SCAN)
