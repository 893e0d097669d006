"""Wire format of the SLAMTEC RPLIDAR: requests, answers and scan packets, encoded and decoded.

No I/O and no time. Angles on the wire are degrees clockwise seen from above, 0 is forward; integers carry
their scale as the vendor writes it: ``_q6`` is 1/64, ``_q16`` 1/65536 degree, ``angle_q14`` is 90/16384
degree (65536 a turn), ``distance_q2`` is 1/4 mm.

Source: Slamtec interface protocol rev 2.2 (chapters 2 to 4); rplidar_sdk @99478e5.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from drivers.framing import ByteBuffer, DecodeStats
from estimators.messages import IntArray

BoolArray: TypeAlias = NDArray[np.bool_]


class Command(IntEnum):
    """Request codes; bit 7 says that a payload follows. Source: sl_lidar_cmd.h."""

    SCAN = 0x20
    STOP = 0x25
    RESET = 0x40
    GET_INFO = 0x50
    GET_HEALTH = 0x52
    GET_SAMPLERATE = 0x59
    EXPRESS_SCAN = 0x82
    HQ_MOTOR_SPEED_CTRL = 0xA8
    SET_MOTOR_PWM = 0xF0
    GET_ACC_BOARD_FLAG = 0xFF


class AnswerType(IntEnum):
    """Type byte of a descriptor. Source: sl_lidar_cmd.h."""

    INFO = 0x04
    HEALTH = 0x06
    SAMPLERATE = 0x15
    STANDARD_SCAN = 0x81
    EXPRESS_SCAN = 0x82
    ACC_BOARD_FLAG = 0xFF


class HealthStatus(IntEnum):
    """What the device says of itself; after ERROR it only accepts RESET."""

    GOOD = 0
    WARNING = 1
    ERROR = 2


PACKET_BYTES = {
    AnswerType.INFO: 20,
    AnswerType.HEALTH: 3,
    AnswerType.SAMPLERATE: 4,
    AnswerType.STANDARD_SCAN: 5,
    AnswerType.EXPRESS_SCAN: 84,
    AnswerType.ACC_BOARD_FLAG: 4,
}
"""Length of the one answer, or of each packet of a scan stream."""

PACKET_SAMPLES = {AnswerType.STANDARD_SCAN: 1, AnswerType.EXPRESS_SCAN: 32}
"""Samples in each packet, for the answers that are streams."""

NODE_BYTES = PACKET_BYTES[AnswerType.STANDARD_SCAN]
CAPSULE_BYTES = PACKET_BYTES[AnswerType.EXPRESS_SCAN]
_CAPSULE_SAMPLES = PACKET_SAMPLES[AnswerType.EXPRESS_SCAN]
_SAMPLE_INDEX = np.arange(_CAPSULE_SAMPLES)
_CABIN = np.dtype([("words", "<u2", (2,)), ("nibbles", "u1", (1,))])  # two samples
_NIBBLES = np.array([0, 4], np.uint8)
TURN_Q6 = 360 << 6


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Answer to GET_INFO.

    Attributes:
        model: series in the high nibble (1 A1, 2 A2, 3 A3, 4 C, 6 to 8 S), sub-model in the low one.
        firmware: major, minor.
        hardware: revision.
        serial: 32 hexadecimal digits in wire order.
    """

    model: int
    firmware: tuple[int, int]
    hardware: int
    serial: str

    @property
    def series(self) -> int:
        """High nibble of the model."""
        return self.model >> 4


@dataclass(frozen=True, slots=True)
class Health:
    """Answer to GET_HEALTH; the error code is the vendor's own."""

    status: HealthStatus
    error_code: int


@dataclass(frozen=True, slots=True)
class SampleRate:
    """Answer to GET_SAMPLERATE: duration of one sample in either mode [us]."""

    standard_us: int
    express_us: int


@dataclass(frozen=True, slots=True)
class AccBoardFlag:
    """Answer to GET_ACC_BOARD_FLAG: whether an accessory board can set the motor's PWM."""

    has_motor_pwm: bool


@dataclass(frozen=True, slots=True)
class ScanStarted:
    """Descriptor of a scan stream: samples of this type follow, unrelated to earlier ones."""

    scan_type: AnswerType


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Consecutive samples of a scan stream, in the order they were taken.

    Attributes:
        scan_type: kind of the packets they came in.
        angle_q14: (N,) int64 [90/16384 deg], clockwise from forward.
        distance_q2: (N,) int64 [mm/4]; 0 where nothing came back.
        quality: (N,) int64, as the SDK scales it: the device's 0..63 times 4; in express packets, which
            carry none, 188 with a return and 0 without.
        starts: (N,) bool, True at the first sample of a revolution.
        gap: True when samples may be missing just before these.
        end: how many bytes had been fed when the packet of the last sample was complete. It says in
            which chunk that packet arrived, which for express is earlier than this event.
    """

    scan_type: AnswerType
    angle_q14: IntArray
    distance_q2: IntArray
    quality: IntArray
    starts: BoolArray
    gap: bool
    end: int


Answer: TypeAlias = DeviceInfo | Health | SampleRate | AccBoardFlag
Event: TypeAlias = Answer | ScanStarted | Samples


def encode_request(command: int, payload: bytes = b"") -> bytes:
    """Request packet as the host sends it.

    Raises:
        ValueError: a payload above 255 bytes, or for a command that has none.
    """
    if not command & 0x80:
        if payload:
            raise ValueError(f"command 0x{command:02X} takes no payload")
        return bytes((0xA5, command))
    if len(payload) > 255:
        raise ValueError(f"payload of {len(payload)} bytes, at most 255 fit")
    packet = bytes((0xA5, command, len(payload))) + payload
    return packet + bytes((xor_checksum(packet),))


class RequestDecoder:
    """Device side of the link: bytes from the host to requests, for emulators and tests."""

    def __init__(self) -> None:
        self.stats = DecodeStats()
        self._buffer = ByteBuffer(self.stats)

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """Requests completed by these bytes: (command, payload); those with a bad checksum are dropped."""
        self._buffer.push(data)
        requests: list[tuple[int, bytes]] = []
        view = self._buffer.view
        while True:
            start = view.find(0xA5)
            self._buffer.skip(start if start >= 0 else len(view))
            if len(view) < 2 or ((has_payload := bool(view[1] & 0x80)) and len(view) < 3):
                return requests
            size = 4 + view[2] if has_payload else 2
            if len(view) < size:
                return requests
            if has_payload and xor_checksum(view[:size]):  # a checksum over itself gives 0
                self.stats.bad += 1
                self._buffer.skip(1)
                continue
            packet = self._buffer.take(size)
            self.stats.good += 1
            requests.append((packet[1], packet[3:-1]))


def encode_descriptor(answer_type: AnswerType) -> bytes:
    """Descriptor that opens an answer. Source: protocol chapter 2."""
    return descriptor_bytes(PACKET_BYTES[answer_type], answer_type in PACKET_SAMPLES, answer_type)


def descriptor_bytes(packet_bytes: int, repeated: bool, type_byte: int) -> bytes:
    """Descriptor of any answer, known to `AnswerType` or not."""
    return b"\xa5\x5a" + struct.pack("<IB", packet_bytes | repeated << 30, type_byte)


def encode_answer(answer: Answer) -> bytes:
    """Descriptor and data of a single answer. Source: protocol chapter 4; sl_lidar_cmd.h."""
    match answer:
        case DeviceInfo(model, (major, minor), hardware, serial):
            data = bytes((model, minor, major, hardware)) + bytes.fromhex(serial)
            return encode_descriptor(AnswerType.INFO) + data
        case Health(status, error_code):
            return encode_descriptor(AnswerType.HEALTH) + struct.pack("<BH", status, error_code)
        case SampleRate(standard_us, express_us):
            return encode_descriptor(AnswerType.SAMPLERATE) + struct.pack("<HH", standard_us, express_us)
        case AccBoardFlag(has_motor_pwm):
            return encode_descriptor(AnswerType.ACC_BOARD_FLAG) + struct.pack("<I", has_motor_pwm)


def decode_answer(answer_type: AnswerType, data: bytes) -> Answer | None:
    """Answer from its data; None when the content is impossible."""
    if answer_type is AnswerType.INFO:
        return DeviceInfo(data[0], (data[2], data[1]), data[3], data[4:].hex().upper())
    if answer_type is AnswerType.HEALTH:
        status, error_code = struct.unpack("<BH", data)
        return Health(HealthStatus(status), error_code) if status <= HealthStatus.ERROR else None
    if answer_type is AnswerType.SAMPLERATE:
        return SampleRate(*struct.unpack("<HH", data))
    return AccBoardFlag(bool(data[0] & 1))


def encode_standard_node(angle_q6: int, distance_q2: int, quality: int, start: bool) -> bytes:
    """One sample of a standard scan; quality is 0..63. Source: protocol figure 4-4."""
    return struct.pack("<BHH", quality << 2 | (1 if start else 2), angle_q6 << 1 | 1, distance_q2)


def encode_express_capsule(
    start_angle_q6: int, start_flag: bool, distances_mm: Sequence[int], offsets_q3: Sequence[int]
) -> bytes:
    """Packet of 32 samples of a legacy express scan.

    Args:
        start_angle_q6: 0..23039, direction when its first sample was taken.
        start_flag: True on the first packet after a request, or after the encoder was restarted.
        distances_mm: 32 values of 0..16383.
        offsets_q3: 32 values of 0..63 [1/8 deg], subtracted from the evenly spaced directions.

    Source: protocol figures 4-11 and 4-13; rplidar_sdk handler_capsules.cpp.
    """
    body = bytearray(struct.pack("<H", start_angle_q6 | start_flag << 15))
    for i in range(0, _CAPSULE_SAMPLES, 2):
        words = (distances_mm[k] << 2 | offsets_q3[k] >> 4 for k in (i, i + 1))
        body += struct.pack("<HHB", *words, offsets_q3[i] & 15 | (offsets_q3[i + 1] & 15) << 4)
    checksum = xor_checksum(body)
    return bytes((0xA0 | checksum & 15, 0x50 | checksum >> 4)) + bytes(body)


def decode_express_capsule(
    capsule: bytes, next_capsule: bytes
) -> tuple[IntArray, IntArray, IntArray, BoolArray]:
    """Samples of one express packet; their directions are known once the next packet tells its own.

    Args:
        capsule: 84 bytes whose checksum holds.
        next_capsule: the packet that followed without a gap.

    Returns:
        angle_q14, distance_q2, quality and starts, (32,) each, as in `Samples`. Integer arithmetic as in
        the SDK, so that the values are equal to the bit.

    Source: rplidar_sdk handler_capsules.cpp; protocol figure 4-13, whose signed offset is wrong.
    """
    cabins = np.frombuffer(capsule, _CABIN, offset=4)
    words = cabins["words"].astype(np.int64).ravel()
    offset_q3 = (words & 3) << 4 | (cabins["nibbles"] >> _NIBBLES & 15).ravel()
    distance_q2 = words & ~3
    # a step is 1/32 of the angle between the packets; q6 to q16 is 10 bits, so 5 bits remain
    step_q16 = span_q6(capsule, next_capsule) << 5
    raw_q16 = (_start_angle_q6(capsule) << 10) + step_q16 * _SAMPLE_INDEX
    angle_q6 = (raw_q16 - (offset_q3 << 13)) >> 10
    # A revolution starts where the direction before the offset is about to pass 0.
    starts = (raw_q16 + step_q16) % (360 << 16) < step_q16
    return to_q14(angle_q6), distance_q2, (distance_q2 > 0) * 188, starts


def to_q14(angle_q6: IntArray) -> IntArray:
    """Angles [1/64 deg] in [90/16384 deg], as the SDK reports them."""
    return (angle_q6 % TURN_Q6 << 8) // 90


def _start_angle_q6(capsule: bytes) -> int:
    return (capsule[2] | capsule[3] << 8) & 0x7FFF


def span_q6(capsule: bytes, next_capsule: bytes) -> int:
    """Angle that the head turned while it took the samples of a capsule."""
    span = _start_angle_q6(next_capsule) - _start_angle_q6(capsule)
    return span if span >= 0 else span + TURN_Q6


def xor_checksum(data: bytes | bytearray) -> int:
    """All bytes combined by exclusive or."""
    return int(np.bitwise_xor.reduce(np.frombuffer(data, np.uint8)))
