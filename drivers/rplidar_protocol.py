"""Wire format of the SLAMTEC RPLIDAR: requests and answers, encoded and decoded.

No I/O and no time. Angles on the wire are degrees clockwise seen from above, 0 is forward; integers carry
their scale as the vendor writes it: ``_q6`` is 1/64, ``_q16`` 1/65536 degree, ``angle_q14`` is 90/16384
degree (65536 a turn), ``distance_q2`` is 1/4 mm.

Source: Slamtec interface protocol rev 2.2 (chapters 2 to 4); rplidar_sdk @99478e5.
"""

import re
import struct
from dataclasses import dataclass
from enum import IntEnum
from functools import reduce
from operator import xor
from typing import TypeAlias

from drivers.framing import ByteBuffer, DecodeStats
from drivers.rplidar_nodes import Batch, Columns
from estimators.immutable import immutable


class Command(IntEnum):
    """Request codes; bit 7 says that a payload follows. Source: sl_lidar_cmd.h."""

    SCAN = 0x20
    FORCE_SCAN = 0x21
    STOP = 0x25
    RESET = 0x40
    GET_INFO = 0x50
    GET_HEALTH = 0x52
    GET_SAMPLERATE = 0x59
    EXPRESS_SCAN = 0x82
    HQ_SCAN = 0x83
    GET_LIDAR_CONF = 0x84
    SET_LIDAR_CONF = 0x85
    NEW_BAUDRATE_CONFIRM = 0x90
    HQ_MOTOR_SPEED_CTRL = 0xA8
    SET_MOTOR_PWM = 0xF0
    GET_ACC_BOARD_FLAG = 0xFF


class AnswerType(IntEnum):
    """Type byte of a descriptor. Source: sl_lidar_cmd.h."""

    INFO = 0x04
    HEALTH = 0x06
    SAMPLERATE = 0x15
    LIDAR_CONF = 0x20
    SET_CONF = 0x21
    STANDARD_SCAN = 0x81
    EXPRESS_SCAN = 0x82
    HQ_SCAN = 0x83
    ULTRA_SCAN = 0x84
    DENSE_SCAN = 0x85
    ULTRA_DENSE_SCAN = 0x86
    ACC_BOARD_FLAG = 0xFF


class ConfKey(IntEnum):
    """What GET_LIDAR_CONF can ask for; those named MODE ask it of one scan mode. Source: sl_lidar_cmd.h."""

    ANGLE_RANGE = 0x00
    DESIRED_ROTATION = 0x01
    SCAN_COMMANDS = 0x02
    MIN_ROTATION = 0x04
    MAX_ROTATION = 0x05
    MAX_DISTANCE = 0x60
    MODE_COUNT = 0x70
    MODE_SAMPLE_TIME = 0x71
    MODE_MAX_DISTANCE = 0x74
    MODE_ANSWER_TYPE = 0x75
    MAC_ADDRESS = 0x79
    TYPICAL_MODE = 0x7C
    MODE_NAME = 0x7F
    MODEL_REVISION = 0x80
    MODEL_NAME = 0x81
    DETECTED_BAUD = 0xA1


class HealthStatus(IntEnum):
    """What the device says of itself; after ERROR it only accepts RESET."""

    GOOD = 0
    WARNING = 1
    ERROR = 2


PACKET_BYTES = {
    AnswerType.INFO: 20,
    AnswerType.HEALTH: 3,
    AnswerType.SAMPLERATE: 4,
    AnswerType.SET_CONF: 8,
    AnswerType.STANDARD_SCAN: 5,
    AnswerType.EXPRESS_SCAN: 84,
    AnswerType.HQ_SCAN: 781,
    AnswerType.ULTRA_SCAN: 132,
    AnswerType.DENSE_SCAN: 84,
    AnswerType.ULTRA_DENSE_SCAN: 170,
    AnswerType.ACC_BOARD_FLAG: 4,
}
"""Length of the one answer, or of each packet of a scan stream; that of LIDAR_CONF is in its descriptor."""

CONF_BYTES = range(4, 256)
"""Lengths of a LIDAR_CONF answer: the key it is of, and at most 251 bytes of value."""

PACKET_SAMPLES = {
    AnswerType.STANDARD_SCAN: 1,
    AnswerType.EXPRESS_SCAN: 32,
    AnswerType.HQ_SCAN: 96,
    AnswerType.ULTRA_SCAN: 96,
    AnswerType.DENSE_SCAN: 40,
    AnswerType.ULTRA_DENSE_SCAN: 64,
}
"""Samples in each packet, for the answers that are streams."""


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
class LidarConf:
    """Answer to GET_LIDAR_CONF.

    It does not say of which scan mode it is. Each property reads the value of one key, and is None for any
    other key and for a value that is too short or impossible.

    Attributes:
        key: that was asked for, see `ConfKey`.
        data: its value as on the wire.
    """

    key: int
    data: bytes

    @property
    def desired_rotation(self) -> tuple[int, int] | None:
        """Speed that the device is made for: revolutions per minute, motor PWM (0..1023)."""
        values = self._unpack(ConfKey.DESIRED_ROTATION, "<HH")
        return None if values is None else (values[0], values[1])

    @property
    def mode_count(self) -> int | None:
        """How many scan modes there are; they are numbered from 0."""
        return self._number(ConfKey.MODE_COUNT, "<H")

    @property
    def typical_mode(self) -> int | None:
        """Scan mode that the vendor recommends."""
        return self._number(ConfKey.TYPICAL_MODE, "<H")

    @property
    def sample_ns(self) -> int | None:
        """Time that the mode takes for one sample [ns]."""
        us_q8 = self._number(ConfKey.MODE_SAMPLE_TIME, "<I")
        return round(us_q8 * 1000 / 256) if us_q8 else None

    @property
    def max_distance(self) -> float | None:
        """Farthest target of the mode [m]."""
        metres_q8 = self._number(ConfKey.MODE_MAX_DISTANCE, "<I")
        return metres_q8 / 256 if metres_q8 else None

    @property
    def answer_type(self) -> AnswerType | None:
        """Kind of the mode's packets."""
        number = self._number(ConfKey.MODE_ANSWER_TYPE, "<B")
        return AnswerType(number) if number in PACKET_SAMPLES else None

    @property
    def mode_name(self) -> str | None:
        """What the vendor calls the mode."""
        text = self.data.partition(b"\0")[0]
        if self.key != ConfKey.MODE_NAME or not text or not text.isascii():
            return None
        return text.decode("ascii")

    def _number(self, key: ConfKey, layout: str) -> int | None:
        values = self._unpack(key, layout)
        return None if values is None else values[0]

    def _unpack(self, key: ConfKey, layout: str) -> tuple[int, ...] | None:
        if self.key != key or len(self.data) < struct.calcsize(layout):
            return None
        return struct.unpack_from(layout, self.data)


@dataclass(frozen=True, slots=True)
class ConfSet:
    """Answer to SET_LIDAR_CONF: the key that was set, and the vendor's result code, 0 for done."""

    key: int
    result: int


@dataclass(frozen=True, slots=True)
class ScanStarted:
    """Descriptor of a scan stream: samples of this type follow, unrelated to earlier ones."""

    scan_type: AnswerType


@immutable
class Samples:
    """Consecutive samples of a scan stream, in the order they were taken.

    Attributes:
        scan_type: kind of the packets they came in.
        batch: has their values.
        at: index of the first one there.
        count: how many they are.
        starts: indices among them of those that begin a revolution, ascending.
        gap: True when samples may be missing just before these; there are none missing in between.
        first: number of the first of these samples, counted from 0 at the scan's descriptor over all packets
            that arrived. Times the sample duration it is a clock of the device that runs on between two
            gaps; lost packets are not counted.
        end: how many bytes had been fed when the packet of the last sample was complete. It says in which
            chunk that packet arrived; where packets are decoded in pairs, that is before this event.
    """

    scan_type: AnswerType
    batch: Batch
    at: int
    count: int
    starts: list[int]
    gap: bool
    first: int
    end: int

    @property
    def columns(self) -> Columns:
        """Their values."""
        return Columns(*(column[self.at : self.at + self.count] for column in self.batch.decoded()))


Answer: TypeAlias = DeviceInfo | Health | SampleRate | AccBoardFlag | LidarConf | ConfSet
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


def encode_conf_request(key: int, mode: int | None = None) -> bytes:
    """GET_LIDAR_CONF for one key, and where it asks that of a scan mode, the mode's number."""
    payload = struct.pack("<I", key) + (b"" if mode is None else struct.pack("<H", mode))
    return encode_request(Command.GET_LIDAR_CONF, payload)


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


def encode_descriptor(answer_type: AnswerType, packet_bytes: int | None = None) -> bytes:
    """Descriptor that opens an answer.

    Args:
        answer_type: what follows.
        packet_bytes: length of what follows; only for LIDAR_CONF, for the others it is fixed.

    Source: protocol chapter 2.
    """
    if packet_bytes is None:
        packet_bytes = PACKET_BYTES[answer_type]
    repeated = answer_type in PACKET_SAMPLES
    return b"\xa5\x5a" + struct.pack("<IB", packet_bytes | repeated << 30, answer_type)


DESCRIPTOR_BYTES = 7
DESCRIPTOR = re.compile(
    rb"\xa5\x5a(?:%b|[\x04-\xff]\x00\x00\x00\x20)"  # the last is LIDAR_CONF, with any of CONF_BYTES
    % b"|".join(re.escape(encode_descriptor(answer_type)[2:]) for answer_type in PACKET_BYTES),
    re.DOTALL,
)
"""Any known descriptor."""


def encode_answer(answer: Answer) -> bytes:
    """Descriptor and data of a single answer.

    Raises:
        ValueError: a configuration value of more than 251 bytes.

    Source: protocol chapter 4; sl_lidar_cmd.h.
    """
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
        case LidarConf(key, value):
            if 4 + len(value) not in CONF_BYTES:
                raise ValueError(f"configuration value of {len(value)} bytes, at most 251 fit")
            data = struct.pack("<I", key) + value
            return encode_descriptor(AnswerType.LIDAR_CONF, len(data)) + data
        case ConfSet(key, result):
            return encode_descriptor(AnswerType.SET_CONF) + struct.pack("<II", key, result)


def decode_answer(answer_type: AnswerType, data: bytes) -> Answer | None:
    """Answer from its data; None when length or content is impossible."""
    if answer_type is AnswerType.LIDAR_CONF:
        if len(data) not in CONF_BYTES:
            return None
        return LidarConf(int.from_bytes(data[:4], "little"), data[4:])
    if len(data) != PACKET_BYTES[answer_type]:
        return None
    match answer_type:
        case AnswerType.INFO:
            return DeviceInfo(data[0], (data[2], data[1]), data[3], data[4:].hex().upper())
        case AnswerType.HEALTH:
            status, error_code = struct.unpack("<BH", data)
            return Health(HealthStatus(status), error_code) if status <= HealthStatus.ERROR else None
        case AnswerType.SAMPLERATE:
            return SampleRate(*struct.unpack("<HH", data))
        case AnswerType.SET_CONF:
            return ConfSet(*struct.unpack("<II", data))
        case AnswerType.ACC_BOARD_FLAG:
            return AccBoardFlag(bool(data[0] & 1))
        case _:  # scans are no single answers
            return None


def _xor(data: bytes | bytearray) -> int:
    return reduce(xor, data)
