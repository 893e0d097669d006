"""Frames of Nooploop LinkTrack modules (NLink), encoded and decoded; no I/O, no time, no state.

The three types that hold a node's own ranges are decoded and encoded; of every other known type only the
extent matters, so that nothing it carries is taken for a frame. Numbers are little-endian.

Positions and velocities are in the anchors' frame (A0 is the origin, A0 to A3 is +x, z is normal to the
anchors' plane); inertial fields, angles and quaternion are in the module's own axes.

Source: NLink V1.4; nlink_unpack @1b79045; LinkTrack User Manual V2.3, chapters 7 and 8.
"""

import re
import struct
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

Vector: TypeAlias = tuple[float, float, float]

VOID_ID = 255
"""A block with this id holds nothing."""


@dataclass(frozen=True, slots=True)
class NodeRange:
    """Range to one other node, as a block of Node_Frame2 and Node_Frame3; a failed range has no block.

    Attributes:
        role: role of the other node, 1 = anchor; in ranging (DR) modes a free value of the user.
        id: id of the other node; 255 = the block is void.
        dis: distance [m].
        fp_rssi: power of the first path [dBm].
        rx_rssi: power of everything received [dBm].
    """

    role: int
    id: int
    dis: float
    fp_rssi: float
    rx_rssi: float


@dataclass(frozen=True, slots=True)
class Sender:
    """What every frame says of the module that sent it.

    Attributes:
        id: its id.
        role: its role, 2 = tag; in DR modes a free value.
        local_time_ms: time since its power-up [ms].
        system_time_ms: time common to the UWB network [ms].
        voltage: its supply [V].
    """

    id: int
    role: int
    local_time_ms: int
    system_time_ms: int
    voltage: float


@dataclass(frozen=True, slots=True)
class TagState(Sender):
    """What a tag knows of itself.

    In DR modes all of it is void. Models without an inertial chip may send anything as gyro, acc, angle_deg
    and quat_wxyz, NaN included.

    Attributes:
        pos: position [m]; starts as (1, 1, 1) and keeps its last value without a fix.
        vel: velocity [m/s]; z is always 0.
        eop: estimated error of the position on each axis [m]; 2.55 = unknown or worse.
        gyro: angular rate [rad/s].
        acc: acceleration with gravity included [m/s^2].
        angle_deg: Euler angles x, y, z [deg].
        quat_wxyz: orientation; its yaw drifts.
    """

    pos: Vector
    vel: Vector
    eop: Vector
    gyro: Vector
    acc: Vector
    angle_deg: Vector
    quat_wxyz: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class TagFrame0(TagState):
    """Tag_Frame0: a tag's state and `dis`, its distances to anchors 0 to 7 [m].

    A distance of 0 means none yet; a stale distance stays when a range fails.

    Source: NLink V1.4; nlink_unpack, nlink_linktrack_tagframe0.c.
    """

    dis: tuple[float, float, float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class NodeFrame2(TagState):
    """Node_Frame2: a tag's state and the ranges of this cycle, at most 255.

    Source: NLink V1.4; nlink_unpack, nlink_linktrack_nodeframe2.c.
    """

    nodes: tuple[NodeRange, ...]


@dataclass(frozen=True, slots=True)
class NodeFrame3(Sender):
    """Node_Frame3: the ranges of this cycle, at most 255.

    Source: NLink V1.4; nlink_unpack, nlink_linktrack_nodeframe3.c.
    """

    nodes: tuple[NodeRange, ...]


Frame: TypeAlias = TagFrame0 | NodeFrame2 | NodeFrame3


@dataclass(frozen=True, slots=True)
class _Integer:
    """Integers on the wire, `steps` of them to one SI unit; None: the integer itself is the value."""

    size: int
    signed: bool = False
    steps: int | None = None

    def unpack(self, data: bytes) -> list[float]:
        parts = [data[at : at + self.size] for at in range(0, len(data), self.size)]
        return [self._value(int.from_bytes(part, "little", signed=self.signed)) for part in parts]

    def pack(self, value: float, name: str) -> bytes:
        low = -(1 << (8 * self.size - 1)) if self.signed else 0
        high = low + (1 << (8 * self.size)) - 1
        scaled = value * (self.steps or 1)
        if not low - 0.5 < scaled < high + 0.5:  # in this form NaN is refused too
            least, most = sorted((self._value(low), self._value(high)))
            raise ValueError(f"{name} is {value}, must be from {least} to {most}")
        return round(scaled).to_bytes(self.size, "little", signed=self.signed)

    def _value(self, raw: int) -> float:
        return raw if self.steps is None else raw / self.steps + 0.0  # + 0.0 makes -0.0 dBm plain 0


@dataclass(frozen=True, slots=True)
class _Float32:
    """IEEE-754 binary32, finite or not."""

    size: int = 4

    def unpack(self, data: bytes) -> list[float]:
        return list(struct.unpack(f"<{len(data) // self.size}f", data))

    def pack(self, value: float, name: str) -> bytes:
        try:
            return struct.pack("<f", value)
        except OverflowError as error:
            raise ValueError(f"{name} is {value}, must be within 3.4028235e38 of zero") from error


class _Slot(NamedTuple):
    """Place of a dataclass field in its frame or block; `length` above 1 makes it a tuple."""

    name: str
    offset: int
    number: _Integer | _Float32
    length: int = 1


_U8, _U32, _F32 = _Integer(1), _Integer(4), _Float32()
_LENGTH, _SPEED, _ANGLE = _Integer(3, True, 1000), _Integer(3, True, 10000), _Integer(2, True, 100)
_VOLTAGE, _ERROR, _POWER = _Integer(2, False, 1000), _Integer(1, False, 100), _Integer(1, False, -2)

_TAG_FRAME0, _NODE_FRAME2, _NODE_FRAME3 = b"\x55\x01", b"\x55\x04", b"\x55\x05"
_ANCHOR_FRAME0, _USER_FRAME1 = b"\x55\x00", b"\x54\xf1"

# fmt: off
# Offsets as in NLink V1.4 and nlink_unpack; bytes that no slot covers are reserved.
_CODECS: dict[bytes, tuple[type[Frame], list[_Slot]]] = {
    _TAG_FRAME0: (TagFrame0, [
        _Slot("id", 2, _U8), _Slot("role", 3, _U8),
        _Slot("pos", 4, _LENGTH, 3), _Slot("vel", 13, _SPEED, 3), _Slot("dis", 22, _LENGTH, 8),
        _Slot("gyro", 46, _F32, 3), _Slot("acc", 58, _F32, 3),
        _Slot("angle_deg", 82, _ANGLE, 3), _Slot("quat_wxyz", 88, _F32, 4),
        _Slot("local_time_ms", 108, _U32), _Slot("system_time_ms", 112, _U32),
        _Slot("eop", 117, _ERROR, 3), _Slot("voltage", 120, _VOLTAGE),
    ]),
    _NODE_FRAME2: (NodeFrame2, [
        _Slot("role", 4, _U8), _Slot("id", 5, _U8), _Slot("system_time_ms", 6, _U32),
        _Slot("eop", 10, _ERROR, 3), _Slot("pos", 13, _LENGTH, 3), _Slot("vel", 22, _SPEED, 3),
        _Slot("gyro", 40, _F32, 3), _Slot("acc", 52, _F32, 3),
        _Slot("angle_deg", 76, _ANGLE, 3), _Slot("quat_wxyz", 82, _F32, 4),
        _Slot("local_time_ms", 102, _U32), _Slot("voltage", 116, _VOLTAGE),
    ]),
    _NODE_FRAME3: (NodeFrame3, [
        _Slot("role", 4, _U8), _Slot("id", 5, _U8),
        _Slot("local_time_ms", 6, _U32), _Slot("system_time_ms", 10, _U32), _Slot("voltage", 18, _VOLTAGE),
    ]),
}
_NODE_RANGE = [
    _Slot("role", 0, _U8), _Slot("id", 1, _U8), _Slot("dis", 2, _LENGTH),
    _Slot("fp_rssi", 5, _POWER), _Slot("rx_rssi", 6, _POWER),
]
# fmt: on
_MARKS = {kind: mark for mark, (kind, _) in _CODECS.items()}


class _Blocks(NamedTuple):
    """Shape of a frame that holds its length at offset 2 and counts its blocks just before the first one.

    A block of `size` bytes may end in `payload_size` bytes that count its payload in units of `unit` bytes.
    """

    start: int
    size: int
    payload_size: int = 0
    unit: int = 1


_FIXED_LENGTHS = {
    _ANCHOR_FRAME0: 896,
    _TAG_FRAME0: 128,
    b"\x54\x00": 128,  # Setting_Frame0
    b"\x54\xfa": 32,  # Error_Frame0
    b"\x52\x00": 32,  # System_Common_Frame0
}
_BLOCKS = {
    b"\x55\x02": _Blocks(11, 4, payload_size=2),  # Node_Frame0
    b"\x55\x03": _Blocks(27, 20),  # Node_Frame1
    _NODE_FRAME2: _Blocks(119, 13),
    _NODE_FRAME3: _Blocks(21, 7),
    b"\x55\x06": _Blocks(21, 5, payload_size=1, unit=4),  # Node_Frame4
    b"\x55\x07": _Blocks(21, 11),  # AOA Node_Frame0
    b"\x55\x08": _Blocks(24, 10),  # Node_Frame5
    b"\x55\x09": _Blocks(14, 7, payload_size=2),  # Node_Frame6
}
FRAME_START = re.compile(
    b"|".join(map(re.escape, [*_FIXED_LENGTHS, *_BLOCKS, _USER_FRAME1])) + rb"|[\x52\x54\x55]\Z"
)

_LONGEST_PAYLOAD_FRAME = 4096
"""Cap for frames whose length no count confirms at once (ArduPilot AP_Beacon_Nooploop has the same)."""

_ROLE_ANCHOR, _ROLE_TAG, _ROLE_CONSOLE = 1, 2, 3


def extent(data: bytes | bytearray) -> int | None:
    """Length of the frame that starts `data`, or None when none can start so.

    While too few bytes are there to tell, it is more than `len(data)`. More bytes never turn None into a
    length: a refusal holds however the stream is cut.
    """
    if len(data) < 4:
        return 4
    mark = bytes(data[:2])
    if mark == _USER_FRAME1:
        if len(data) < 10:
            return 11
        length = 11 + int.from_bytes(data[8:10], "little")
        return length if length <= _LONGEST_PAYLOAD_FRAME else None
    if mark in _BLOCKS:
        return _extent_of_blocks(data, _BLOCKS[mark])
    if mark == _ANCHOR_FRAME0 and not _may_be_anchor_frame0(data):
        return None
    return _FIXED_LENGTHS.get(mark)


def _extent_of_blocks(data: bytes | bytearray, blocks: _Blocks) -> int | None:
    length = int.from_bytes(data[2:4], "little")
    if length <= blocks.start or (blocks.payload_size and length > _LONGEST_PAYLOAD_FRAME):
        return None
    if len(data) < blocks.start:
        return length
    end, checksum_at = blocks.start, length - 1
    count = data[blocks.start - 1]
    if not blocks.payload_size:
        return length if end + count * blocks.size == checksum_at else None
    for blocks_left in range(count, 0, -1):
        if end + blocks_left * blocks.size > checksum_at:
            return None
        if end + blocks.size > len(data):
            return length
        end += blocks.size
        end += blocks.unit * int.from_bytes(data[end - blocks.payload_size : end], "little")
    return length if end == checksum_at else None


def _may_be_anchor_frame0(data: bytes | bytearray) -> bool:
    """Whether the roles that are there fit an Anchor_Frame0, whose only other guard is its last byte.

    Its 30 blocks of 27 bytes describe tags or are void, and only anchors and consoles send it. Looking at
    each role as it arrives also ends the wait for 896 bytes early after a false start.
    """
    ids, roles, own_role = data[2:812:27], data[3:812:27], data[894:895]
    return all(
        role == _ROLE_TAG or node_id == VOID_ID for node_id, role in zip(ids, roles, strict=False)
    ) and all(role in (_ROLE_ANCHOR, _ROLE_CONSOLE) for role in own_role)


def has_right_end(frame: bytes | bytearray) -> bool:
    """Whether the checksum, or the tail byte of the one type that has none, is right."""
    return frame[-1] == (0xEE if frame[:2] == _ANCHOR_FRAME0 else sum(frame[:-1]) & 0xFF)


def _read(slots: list[_Slot], data: bytes, base: int) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for name, offset, number, length in slots:
        start = base + offset
        numbers = number.unpack(data[start : start + number.size * length])
        values[name] = numbers[0] if length == 1 else tuple(numbers)
    return values


def _write(slots: list[_Slot], record: Frame | NodeRange, data: bytearray, base: int, path: str = "") -> None:
    for field, offset, number, length in slots:
        name, value = path + field, getattr(record, field)
        values = (value,) if length == 1 else value
        if len(values) != length:
            raise ValueError(f"{name} has {len(values)} values, must have {length}")
        start = base + offset
        data[start : start + number.size * length] = b"".join(number.pack(each, name) for each in values)


def encode(frame: Frame) -> bytes:
    """Bytes of a frame, reserved ones 0, values rounded to the wire's grid.

    Raises:
        ValueError: a value does not fit; names the field and its limit.
    """
    mark = _MARKS[type(frame)]
    _, slots = _CODECS[mark]
    if isinstance(frame, TagFrame0):
        data = bytearray(_FIXED_LENGTHS[mark])
    else:
        start, size, *_ = _BLOCKS[mark]
        if len(frame.nodes) > 255:
            raise ValueError(f"nodes has {len(frame.nodes)} ranges, must have at most 255")
        data = bytearray(start + size * len(frame.nodes) + 1)
        data[2:4] = len(data).to_bytes(2, "little")
        data[start - 1] = len(frame.nodes)
        for index, node in enumerate(frame.nodes):
            _write(_NODE_RANGE, node, data, start + size * index, f"nodes[{index}].")
    data[:2] = mark
    _write(slots, frame, data, 0)
    data[-1] = sum(data) & 0xFF
    return bytes(data)


def decode(data: bytes) -> Frame | None:
    """The frame that `data` is; None when it is not exactly one good frame of the three types."""
    return decode_checked(data) if extent(data) == len(data) and has_right_end(data) else None


def decode_checked(data: bytes) -> Frame | None:
    """The frame that `data` is, whose extent and end were checked; None for the other types."""
    mark = data[:2]
    if mark not in _CODECS:
        return None
    kind, slots = _CODECS[mark]
    values = _read(slots, data, 0)
    if mark in _BLOCKS:
        start, size, *_ = _BLOCKS[mark]
        starts = range(start, len(data) - 1, size)
        values["nodes"] = tuple(NodeRange(**_read(_NODE_RANGE, data, at)) for at in starts)
    return kind(**values)
