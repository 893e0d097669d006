"""Wire format of the SLAMTEC RPLIDAR: requests, answers and scan packets, encoded and decoded.

No I/O and no time. Angles on the wire are degrees clockwise seen from above, 0 is forward; integers carry
their scale as the vendor writes it: ``_q6`` is 1/64, ``_q16`` 1/65536 degree, ``angle_q14`` is 90/16384
degree (65536 a turn), ``distance_q2`` is 1/4 mm.

Source: Slamtec interface protocol rev 2.2 (chapters 2 to 4); rplidar_sdk @99478e5.
"""

import re
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

_NODE_BYTES = PACKET_BYTES[AnswerType.STANDARD_SCAN]
_CAPSULE_BYTES = PACKET_BYTES[AnswerType.EXPRESS_SCAN]
_CAPSULE_SAMPLES = PACKET_SAMPLES[AnswerType.EXPRESS_SCAN]
_SAMPLE_INDEX = np.arange(_CAPSULE_SAMPLES)
_CABIN = np.dtype([("words", "<u2", (2,)), ("nibbles", "u1", (1,))])  # two samples
_NIBBLES = np.array([0, 4], np.uint8)
_TURN_Q6 = 360 << 6


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
    return packet + bytes((_xor(packet),))


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
            if has_payload and _xor(view[:size]):  # a checksum over itself gives 0
                self.stats.bad += 1
                self._buffer.skip(1)
                continue
            packet = self._buffer.take(size)
            self.stats.good += 1
            requests.append((packet[1], packet[3:-1]))


def encode_descriptor(answer_type: AnswerType) -> bytes:
    """Descriptor that opens an answer. Source: protocol chapter 2."""
    return _descriptor(PACKET_BYTES[answer_type], answer_type in PACKET_SAMPLES, answer_type)


def _descriptor(packet_bytes: int, repeated: bool, type_byte: int) -> bytes:
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


def _decode_answer(answer_type: AnswerType, data: bytes) -> Answer | None:
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
    checksum = _xor(body)
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
    step_q16 = _span_q6(capsule, next_capsule) << 5
    raw_q16 = (_start_angle_q6(capsule) << 10) + step_q16 * _SAMPLE_INDEX
    angle_q6 = (raw_q16 - (offset_q3 << 13)) >> 10
    # A revolution starts where the direction before the offset is about to pass 0.
    starts = (raw_q16 + step_q16) % (360 << 16) < step_q16
    return _q14(angle_q6), distance_q2, (distance_q2 > 0) * 188, starts


def _q14(angle_q6: IntArray) -> IntArray:
    return (angle_q6 % _TURN_Q6 << 8) // 90


def _start_angle_q6(capsule: bytes) -> int:
    return (capsule[2] | capsule[3] << 8) & 0x7FFF


def _span_q6(capsule: bytes, next_capsule: bytes) -> int:
    """Angle that the head turned while it took the samples of a capsule."""
    span_q6 = _start_angle_q6(next_capsule) - _start_angle_q6(capsule)
    return span_q6 if span_q6 >= 0 else span_q6 + _TURN_Q6


def _xor(data: bytes | bytearray) -> int:
    return int(np.bitwise_xor.reduce(np.frombuffer(data, np.uint8)))


_UNREAD_SCANS = {0x84: 132, 0x85: 84, 0x86: 170}  # type -> packet bytes: they end what ran before
_DESCRIPTOR = re.compile(
    b"|".join(
        re.escape(descriptor)
        for descriptor in (
            *(encode_descriptor(answer_type) for answer_type in AnswerType),
            *(_descriptor(size, True, type_byte) for type_byte, size in _UNREAD_SCANS.items()),
        )
    )
)
_DESCRIPTOR_BYTES = 7
_CAPSULE_START = re.compile(rb"[\xa0-\xaf](?:[\x50-\x5f]|\Z)")
_MAX_SPAN_Q6 = 120 << 6  # 32 samples at 1000/s and 10 rev/s; real devices stay below 45 deg
# A standard node's direction is corrected for the distance, so it jumps by up to 9 deg either way
# between a return and none (seen on a real A1), on top of the step, which is 0.3 to 6 deg.
_MAX_FALL_Q6 = 10 << 6
_MAX_RISE_Q6 = 20 << 6
_TRUSTED_NODES = 4  # this many in a row end a search; by chance random bytes pass once in some 10^6
_WINDOW = 1000  # bytes looked at in one go, so that badly damaged input costs linear time


def _node_angles(b0: IntArray, b1: IntArray, b2: IntArray) -> tuple[IntArray, BoolArray]:
    """Angle (q6) of nodes from their first three bytes, and whether these can be a node's."""
    angle_q6 = b1 >> 1 | b2 << 7
    return angle_q6, ((b0 ^ b0 >> 1) & b1 & 1 == 1) & (angle_q6 < _TURN_Q6)


def _rises(step_q6: IntArray) -> BoolArray:
    return (step_q6 + _MAX_FALL_Q6) % _TURN_Q6 <= _MAX_FALL_Q6 + _MAX_RISE_Q6


class AnswerDecoder:
    """Bytes from the device to answers and samples, however they are chunked.

    What follows is known from the descriptors alone, never from what was asked, so the incoming half of
    a recorded link is enough. A descriptor is 7 exact bytes. Where are such bytes one, and not data?

    - Outside a stream: anywhere. Leftovers, banner text and answers of other types are skipped.
    - In a standard stream: where the nodes break, from the last 4 bytes of the last node on, because a
      stream cut inside a node makes it swallow them. A descriptor always breaks the nodes: at a node's
      place by its even second byte 5A, inside a node by the guard bits of the next node. One exception:
      those of health and of standard scan, begun on a node's last byte, read like a node at 1/64 or
      2/64 deg; they are data if the angle was just there.
    - In an express stream: where a packet should begin, and anywhere after damage. Inside a packet whose
      checksum holds they are data. At a packet's place they win over the packet that begins with the
      same 48 bits of content, because waiting for its checksum would hold back short answers.
    """

    def __init__(self, stats: DecodeStats) -> None:
        self._stats = stats
        self._buffer = ByteBuffer(stats)
        self._fed = 0
        self._expected: AnswerType | None = None
        self._gap = False
        self._nodes_trusted = True
        self._last_angle_q6: int | None = None
        self._last_node_tail = b""
        self._pending: bytes | None = None  # capsule that waits for the next one
        self._pending_end = 0

    def feed(self, data: bytes) -> list[Event]:
        """Events completed by these bytes; never raises on any bytes."""
        self._buffer.push(data)
        self._fed += len(data)
        events: list[Event] = []
        while self._step(events):
            pass
        return events

    def discard(self) -> None:
        """Drop what waits for the rest of its packet: the device fell quiet, the rest will not come."""
        self._buffer.skip(len(self._buffer))
        self._lose()
        if self._expected not in PACKET_SAMPLES:
            self._expected = None

    def _step(self, events: list[Event]) -> bool:
        """Take one thing from the buffer; False when it needs more bytes."""
        if self._expected is None:
            return self._find_descriptor(events)
        if self._expected is AnswerType.STANDARD_SCAN:
            return self._take_nodes(events) if self._nodes_trusted else self._find_nodes(events)
        if self._expected is AnswerType.EXPRESS_SCAN:
            return self._take_capsule(events)
        return self._take_answer(self._expected, events)

    def _begin(self, descriptor: bytes, events: list[Event]) -> None:
        """Any descriptor ends what ran before and says what follows."""
        self._lose()
        if descriptor[-1] in _UNREAD_SCANS:
            self._stats.other += 1
            self._expected = None
            return
        self._expected = AnswerType(descriptor[-1])
        if self._expected in PACKET_SAMPLES:
            events.append(ScanStarted(self._expected))
            self._gap = False
            self._nodes_trusted = True

    def _lose(self) -> None:
        """Nothing that comes next continues what came before."""
        self._gap = True
        self._nodes_trusted = False
        self._last_angle_q6 = None
        self._last_node_tail = b""
        self._pending = None

    def _find_descriptor(self, events: list[Event]) -> bool:
        descriptor = _DESCRIPTOR.search(self._buffer.view)
        if descriptor is None:
            self._buffer.skip(len(self._buffer) - _DESCRIPTOR_BYTES + 1)
            return False
        self._buffer.skip(descriptor.start())
        self._begin(self._buffer.take(_DESCRIPTOR_BYTES), events)
        return True

    def _take_answer(self, answer_type: AnswerType, events: list[Event]) -> bool:
        if len(self._buffer) < PACKET_BYTES[answer_type]:
            return False
        self._expected = None
        answer = _decode_answer(answer_type, self._buffer.take(PACKET_BYTES[answer_type]))
        if answer is None:
            self._stats.bad += 1
        else:
            self._stats.good += 1
            events.append(answer)
        return True

    def _take_nodes(self, events: list[Event]) -> bool:
        """Take all nodes up to the first that does not continue the stream."""
        count = min(len(self._buffer), _WINDOW) // _NODE_BYTES
        if count == 0:
            return False
        raw = np.frombuffer(self._buffer.view, np.uint8, count * _NODE_BYTES).astype(np.int64).reshape(-1, 5)
        angle_q6, good = _node_angles(raw[:, 0], raw[:, 1], raw[:, 2])
        before_q6 = angle_q6[0] if self._last_angle_q6 is None else self._last_angle_q6
        good &= _rises(np.diff(angle_q6, prepend=before_q6))
        taken = count if good.all() else int(np.argmin(good))
        if taken:
            raw, angle_q6 = raw[:taken], angle_q6[:taken]
            self._last_node_tail = self._buffer.take(taken * _NODE_BYTES)[1 - _NODE_BYTES :]
            self._last_angle_q6 = int(angle_q6[-1])
            self._stats.good += taken
            distance_q2, starts = raw[:, 3] | raw[:, 4] << 8, raw[:, 0] & 1 == 1
            end = self._fed - len(self._buffer)
            angle_q14, quality = _q14(angle_q6), raw[:, 0] >> 2 << 2
            scan_type = AnswerType.STANDARD_SCAN
            events.append(Samples(scan_type, angle_q14, distance_q2, quality, starts, self._gap, end))
            self._gap = False
        if taken < count:
            self._stats.bad += 1
            self._gap = True
            self._nodes_trusted = False
        return True

    def _find_nodes(self, events: list[Event]) -> bool:
        """After damage: skip to the next run of nodes that fit each other, or to a descriptor.

        Whichever is complete first wins, so that the result does not depend on the chunks.
        """
        window = bytes(self._buffer.view[:_WINDOW])
        run_bytes = _TRUSTED_NODES * _NODE_BYTES
        run = _find_run(window)
        descriptor = _DESCRIPTOR.search(self._last_node_tail + window)
        if descriptor is not None:
            end = descriptor.end() - len(self._last_node_tail)
            if run is None or end <= run + run_bytes:
                self._buffer.skip(end - _DESCRIPTOR_BYTES)
                self._buffer.take(min(end, _DESCRIPTOR_BYTES))
                self._begin(descriptor[0], events)
                return True
        if run is not None:
            self._buffer.skip(run)
            self._nodes_trusted = True
            self._last_angle_q6 = None
            return True
        refused = len(window) - run_bytes + 1
        if refused <= 0:
            return False
        self._buffer.skip(refused)
        self._last_node_tail = b""
        return True

    def _take_capsule(self, events: list[Event]) -> bool:
        view = self._buffer.view
        candidate = _CAPSULE_START.search(view)
        if (skipped := candidate.start() if candidate else len(view)) > 0:
            self._buffer.skip(skipped)
            self._lose()
        if _DESCRIPTOR.match(view):
            self._begin(self._buffer.take(_DESCRIPTOR_BYTES), events)
            return True
        if len(view) < _CAPSULE_BYTES:
            return False
        if _xor(view[2:_CAPSULE_BYTES]) != view[0] & 15 | (view[1] & 15) << 4:
            self._stats.bad += 1
            self._buffer.skip(1)
            self._lose()
            return True
        previous, previous_end = self._pending, self._pending_end
        capsule = self._buffer.take(_CAPSULE_BYTES)
        self._stats.good += 1
        self._pending, self._pending_end = capsule, self._fed - len(self._buffer)
        if previous is None:
            return True
        # S says that the encoder was restarted; no rotation or too much of it, that packets were
        # repeated or lost whole. Such a pair has no common scale of angles.
        if capsule[3] & 0x80 or not 0 < _span_q6(previous, capsule) <= _MAX_SPAN_Q6:
            self._gap = True
            return True
        decoded = decode_express_capsule(previous, capsule)
        events.append(Samples(AnswerType.EXPRESS_SCAN, *decoded, self._gap, previous_end))
        self._gap = False
        return True


def _find_run(data: bytes) -> int | None:
    """Offset of the first node that begins a run of trustworthy nodes; None when there is none."""
    if len(data) < _TRUSTED_NODES * _NODE_BYTES:
        return None
    # angles of nodes at every byte offset that has room for one
    raw = np.frombuffer(data, np.uint8).astype(np.int64)[: 3 - _NODE_BYTES]
    angle_q6, good = _node_angles(raw[:-2], raw[1:-1], raw[2:])
    continues = good[:-5] & good[5:] & _rises(angle_q6[5:] - angle_q6[:-5])
    positions = len(data) - _TRUSTED_NODES * _NODE_BYTES + 1
    runs = np.logical_and.reduce([continues[5 * k : 5 * k + positions] for k in range(_TRUSTED_NODES - 1)])
    return int(np.argmax(runs)) if runs.any() else None
