"""Byte streams that hurt a decoder: valid ones of both devices, damaged, forged and mixed, from one seed."""

import random
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import xor
from typing import TypeAlias

from drivers.linktrack_frames import encode
from drivers.linktrack_types import NodeFrame2, NodeRange
from drivers.rplidar_protocol import (
    AccBoardFlag,
    DeviceInfo,
    Health,
    HealthStatus,
    SampleRate,
    encode_answer,
)
from tests import vectors

Forge: TypeAlias = Callable[[random.Random], bytes]

_LONGEST_RUN = 8000  # of one source at a time: some ten revolutions, or fifty frames
_DESCRIPTOR_BYTES = 7
_LENGTHS = (0, 1, 2, 3, 4, 5, 20, 22, 84, 120, 132, 170, 255, 781, 896, 4095, 4096, 4097, 7422, 0xFFFF)


@dataclass(frozen=True, slots=True)
class Material:
    """What hostile streams of one device are made of.

    Attributes:
        streams: valid bytes.
        forges: makers of bytes whose checks hold but whose content is arbitrary, and of false starts.
        replies: request that a driver sends -> what a device answers.
    """

    streams: Sequence[bytes]
    forges: Sequence[Forge]
    replies: dict[bytes, bytes]


def hostile_segments(material: Material, rng: random.Random) -> Iterator[bytes]:
    """Endless: runs of valid streams, forged packets and garbage, each left alone or damaged a few times."""
    while True:
        segment = bytearray(_undamaged(material, rng))
        for _ in range(rng.choice((0, 0, 0, 1, 1, 3))):
            rng.choice(_DAMAGES)(segment, material, rng)
        yield bytes(segment)


def _undamaged(material: Material, rng: random.Random) -> bytes:
    kind = rng.random()
    if kind < 0.6:
        stream = rng.choice(material.streams)
        begin = rng.choice((0, rng.randrange(len(stream))))
        # Without the descriptor that opens it, a RPLIDAR stream would seldom be understood.
        opening = stream[:_DESCRIPTOR_BYTES] if begin and rng.random() < 0.7 else b""
        return opening + stream[begin : begin + rng.randint(1, _LONGEST_RUN)]
    if kind < 0.9:
        forge = rng.choice(material.forges)
        return b"".join(forge(rng) for _ in range(rng.randint(1, 12)))
    if kind < 0.95:
        return rng.randbytes(rng.randint(1, 500))
    return rng.choice(material.forges)(rng)[: rng.randint(1, 8)] * rng.randint(1, 1000)


def _flip_bits(data: bytearray, material: Material, rng: random.Random) -> None:
    for _ in range(rng.randint(1, 8) if data else 0):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _insert(data: bytearray, material: Material, rng: random.Random) -> None:
    at = rng.randint(0, len(data))
    data[at:at] = rng.randbytes(rng.randint(1, 20))


def _insert_forged(data: bytearray, material: Material, rng: random.Random) -> None:
    at = rng.randint(0, len(data))
    data[at:at] = rng.choice(material.forges)(rng)


def _delete(data: bytearray, material: Material, rng: random.Random) -> None:
    at = rng.randint(0, len(data))
    del data[at : at + rng.choice((1, 2, 5, 84, rng.randint(1, 1000)))]


def _duplicate(data: bytearray, material: Material, rng: random.Random) -> None:
    at = rng.randint(0, len(data))
    run = data[at : at + rng.randint(1, 500)]
    data[at:at] = run * rng.randint(1, 3)


def _swap(data: bytearray, material: Material, rng: random.Random) -> None:
    a, b, c = sorted(rng.randint(0, len(data)) for _ in range(3))
    data[a:c] = data[b:c] + data[a:b]


def _truncate(data: bytearray, material: Material, rng: random.Random) -> None:
    del data[rng.randint(0, len(data)) :]


def _splice(data: bytearray, material: Material, rng: random.Random) -> None:
    other = rng.choice(material.streams)
    data[rng.randint(0, len(data)) :] = other[rng.randrange(len(other)) :][:_LONGEST_RUN]


def _overwrite_length(data: bytearray, material: Material, rng: random.Random) -> None:
    at = rng.randint(0, len(data))
    data[at : at + 2] = struct.pack("<H", rng.choice(_LENGTHS))


_DAMAGES: Sequence[Callable[[bytearray, Material, random.Random], None]] = (
    _flip_bits,
    _insert,
    _insert_forged,
    _delete,
    _duplicate,
    _swap,
    _truncate,
    _splice,
    _overwrite_length,
)


def linktrack_material(rng: random.Random) -> Material:
    """Vectors of every frame type, frames from the encoder, false starts of every type."""
    frames = [
        bytes.fromhex(frame["hex"])
        for path in sorted(vectors.DIR.glob("linktrack_*.json"))
        for frame in vectors.load(path.stem)["frames"]
        if "hex" in frame
    ]
    encoded = b"".join(encode(_node_frame2(rng, time_ms)) for time_ms in range(0, 2000, 20))
    streams = [path.read_bytes() for path in sorted(vectors.DIR.glob("linktrack_*.bin"))]

    def reworked(rng: random.Random) -> bytes:
        """A frame with other content and the right sum; its count of blocks may be wrong."""
        data = bytearray(rng.choice(frames))
        for _ in range(rng.choice((1, 4, 100))):
            data[rng.randrange(2, len(data))] = rng.choice((0, 1, 127, 128, 255, rng.randrange(256)))
        data[-1] = sum(data[:-1]) & 0xFF
        return bytes(data)

    return Material([*streams, encoded, b"".join(frames)], (reworked, _false_frame, _nmea), {})


def rplidar_material(rng: random.Random) -> Material:
    """Vectors of every scan mode and answer, answers from the encoder, false descriptors and packets."""
    streams = [path.read_bytes() for path in sorted(vectors.DIR.glob("rplidar_*.bin"))]
    exchanges = [
        exchange
        for path in sorted(vectors.DIR.glob("rplidar_sdk_session_*.json"))
        for exchange in vectors.load(path.stem)["exchanges"]
    ]
    replies = {
        bytes.fromhex(exchange["host"]): bytes.fromhex("".join(exchange["device"])) for exchange in exchanges
    }
    answers = [bytes.fromhex(answer["bytes"]) for answer in vectors.load("rplidar_answers")["answers"]]
    for model in (0x18, 0x28, 0x2C, 0x41, 0x61, 0x71):
        info = DeviceInfo(model, (rng.randrange(3), rng.randrange(40)), 7, rng.randbytes(16).hex().upper())
        answers.append(encode_answer(info))
    answers += [encode_answer(Health(status, rng.randrange(0x10000))) for status in HealthStatus]
    answers += [encode_answer(SampleRate(*durations)) for durations in ((0, 0), (1, 1), (0xFFFF, 0xFFFF))]
    answers += [encode_answer(AccBoardFlag(flag)) for flag in (True, False)]
    forges = (_false_descriptor, _capsule, _hq_packet, _nodes)
    return Material([*streams, b"".join((*answers, *replies.values()))], forges, replies)


def request_material(rng: random.Random) -> Material:
    """Requests of every command, as an emulated device hears them."""
    requests = [bytes.fromhex(request["bytes"]) for request in vectors.load("rplidar_requests")["requests"]]
    return Material([b"".join(requests)], (_false_request,), {})


def _node_frame2(rng: random.Random, time_ms: int) -> NodeFrame2:
    half = 2**-0.5
    return NodeFrame2(
        id=rng.randrange(256),
        role=2,
        local_time_ms=time_ms,
        system_time_ms=time_ms,
        voltage=5.0,
        pos=(1.0, 2.0, 3.0),
        vel=(0.1, 0.2, 0.0),
        eop=(0.1, 0.1, 0.1),
        gyro=(rng.gauss(0, 1), 0.0, 0.0),
        acc=(0.0, 0.0, rng.gauss(9.8, 0.1)),
        angle_deg=(0.0, 0.0, 90.0),
        quat_wxyz=(half, 0.0, 0.0, half),
        nodes=tuple(
            NodeRange(1, number, rng.uniform(0.1, 50), -80.0, -79.0) for number in range(rng.randrange(9))
        ),
    )


def _false_frame(rng: random.Random) -> bytes:
    header = rng.choice((b"\x55", b"\x54", b"\x52"))
    mark = rng.choice((*range(12), 0xF1, 0xFA, rng.randrange(256)))
    length = rng.choice((*_LENGTHS, rng.randrange(0x10000)))
    content = rng.randbytes(rng.choice((0, 3, 30, 200)))
    return header + bytes((mark,)) + struct.pack("<H", length) + content


def _nmea(rng: random.Random) -> bytes:
    text = f"$GNGGA,{rng.randrange(10**6):06d}.00,2232.{rng.randrange(10**4)},N*{rng.randrange(256):02X}\r\n"
    return text.encode()


def _false_descriptor(rng: random.Random) -> bytes:
    length = rng.choice((*_LENGTHS, 0x3FFFFFFF, rng.randrange(1 << 30)))
    kind = rng.choice((0x04, 0x06, 0x15, 0x20, 0x21, *range(0x81, 0x88), 0xFF, rng.randrange(256)))
    descriptor = b"\xa5\x5a" + struct.pack("<IB", length | rng.randrange(4) << 30, kind)
    return descriptor + rng.randbytes(rng.choice((0, 4, 100)))


def _capsule(rng: random.Random) -> bytes:
    """A packet of any capsule mode whose checksum holds."""
    body = bytearray(rng.randbytes(rng.choice((84, 132, 170)) - 2))
    start_q6 = rng.choice((0, 1, 360 * 64 - 1, 360 * 64, rng.randrange(0x8000)))
    body[:2] = struct.pack("<H", start_q6 | (rng.random() < 0.1) << 15)
    checksum = reduce(xor, body)
    return bytes((0xA0 | checksum & 15, 0x50 | checksum >> 4)) + body


def _hq_packet(rng: random.Random) -> bytes:
    """A packet of the HQ mode whose CRC holds."""
    data = b"\xa5" + rng.randbytes(776)
    return data + struct.pack("<I", zlib.crc32(data + bytes(3)))


def _nodes(rng: random.Random) -> bytes:
    """Standard nodes whose guard bits hold, at one angle or at any."""
    angle_q6 = rng.randrange(360 * 64)
    step_q6 = rng.choice((0, 1, 70, 360 * 64 - 1))
    nodes = b""
    for _ in range(rng.randint(1, 60)):
        start = rng.random() < 0.05
        quality = rng.randrange(64) << 2
        nodes += struct.pack("<BHH", quality | (1 if start else 2), angle_q6 << 1 | 1, rng.randrange(0x10000))
        angle_q6 = (angle_q6 + step_q6) % (360 * 64)
    return nodes


def _false_request(rng: random.Random) -> bytes:
    """A request with the right checksum for any command, or with a length that leads astray."""
    payload = rng.randbytes(rng.choice((0, 1, 5, 255)))
    packet = bytes((0xA5, rng.randrange(256), rng.choice((len(payload), 255, 0)))) + payload
    return packet + bytes((reduce(xor, packet),))
