"""What the frames of Nooploop LinkTrack modules (NLink) say: one type for each frame.

Positions and velocities are in the anchors' frame (A0 is the origin, A0 to A3 is +x, z is normal to the
anchors' plane); inertial fields, angles and quaternion are in the module's own axes.

Source: NLink V1.4; nlink_unpack @1b79045; LinkTrack User Manual V2.3, chapters 7 and 8.
"""

from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import NamedTuple, TypeAlias

Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]
AnchorDistances: TypeAlias = tuple[float, float, float, float, float, float, float, float]
"""Distances to anchors 0 to 7 [m]; 0 = none yet, and a stale one stays when a range fails."""
Coordinates: TypeAlias = tuple[float | None, float | None, float | None]

VOID_ID = 255
"""A block whose id of one byte is this holds nothing."""


class Role(IntEnum):
    """What a module is for. In ranging (DR) modes the role is a free value of the user, 0 to 254."""

    NODE = 0
    ANCHOR = 1
    TAG = 2
    CONSOLE = 3
    MASTER = 4
    SLAVE = 5
    MONITOR = 6


class ErrorBits(IntFlag):
    """What a module complains of in its Error_Frame0."""

    DUPLICATE_NODE = 1 << 0
    SETTING = 1 << 1
    ANCHOR_COORDINATE = 1 << 2
    RESTART = 1 << 3
    HARD_FAULT = 1 << 4
    UWB_SENDING = 1 << 5
    POSITION = 1 << 6
    DATA_TOO_LONG = 1 << 7


# Blocks are named tuples: there are many of them, and a dataclass takes 2.5 times as long to build.


class NodeRange(NamedTuple):
    """Range to one other node, as a block of Node_Frame2, 3 and 5; a failed range has no block.

    Attributes:
        role: role of the other node.
        id: id of the other node; one of `VOID_ID` makes the block void, but not in Node_Frame5.
        dis: distance [m].
        fp_rssi: power of the first path [dBm].
        rx_rssi: power of everything received [dBm].
    """

    role: int
    id: int
    dis: float
    fp_rssi: float
    rx_rssi: float


class AoaNodeRange(NamedTuple):
    """Range and bearing to one other node, as a block of AOA Node_Frame0.

    Attributes:
        role: role of the other node.
        id: id of the other node; `VOID_ID` makes the block void.
        dis: distance [m].
        angle_deg: angle of arrival [deg].
        fp_rssi: power of the first path [dBm].
        rx_rssi: power of everything received [dBm].
    """

    role: int
    id: int
    dis: float
    angle_deg: float
    fp_rssi: float
    rx_rssi: float


class AnchorRange(NamedTuple):
    """Range of a tag to one anchor, as Node_Frame4 has it.

    Attributes:
        id: id of the anchor.
        dis: distance [m].
    """

    id: int
    dis: float


class TagRanges(NamedTuple):
    """Ranges of one tag, a block of Node_Frame4.

    Attributes:
        id: id of the tag.
        voltage: its supply [V].
        anchors: at most 16.
    """

    id: int
    voltage: float
    anchors: tuple[AnchorRange, ...]


class TagBlock(NamedTuple):
    """Position and distances of one tag, a block of Anchor_Frame0.

    Attributes:
        role: its role, always `Role.TAG`.
        id: its id, never `VOID_ID`.
        pos: its position [m].
        dis: its distances [m].
    """

    role: int
    id: int
    pos: Vector
    dis: AnchorDistances


class TagPosition(NamedTuple):
    """Position of one tag, a block of Node_Frame1.

    Attributes:
        role: its role.
        id: its id.
        pos: its position [m].
    """

    role: int
    id: int
    pos: Vector


class NodeData(NamedTuple):
    """What the user of another node sent, a block of Node_Frame0 and Node_Frame6.

    Attributes:
        role: role of the other node.
        id: id of the other node.
        data: what was sent.
    """

    role: int
    id: int
    data: bytes


@dataclass(slots=True)
class Sender:
    """What a measuring frame says of the module that sent it.

    Attributes:
        id: its id.
        role: its role.
        local_time_ms: time since its power-up [ms].
        system_time_ms: time common to the UWB network [ms].
        voltage: its supply [V].
    """

    id: int
    role: int
    local_time_ms: int
    system_time_ms: int
    voltage: float


@dataclass(slots=True)
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
    quat_wxyz: Quaternion


@dataclass(slots=True)
class AnchorFrame0(Sender):
    """Anchor_Frame0: what an anchor or a console knows of at most 30 tags.

    Source: NLink V1.4; nlink_unpack, nlink_linktrack_anchorframe0.c.
    """

    nodes: tuple[TagBlock, ...]


@dataclass(slots=True)
class TagFrame0(TagState):
    """Tag_Frame0: a tag's state and distances.

    Source: NLink V1.4; nlink_unpack, nlink_linktrack_tagframe0.c.
    """

    dis: AnchorDistances


@dataclass(slots=True)
class NodeFrame0:
    """Node_Frame0: user data that came over the air, of at most 255 nodes.

    Attributes:
        id: id of the module.
        role: its role.
        nodes: who sent what.

    Source: NLink V1.4; nlink_unpack, nlink_linktrack_nodeframe0.c.
    """

    id: int
    role: int
    nodes: tuple[NodeData, ...]


@dataclass(slots=True)
class NodeFrame1(Sender):
    """Node_Frame1: positions of at most 255 tags, at an anchor or a console.

    Source: NLink V1.4; nlink_unpack, nlink_linktrack_nodeframe1.c.
    """

    nodes: tuple[TagPosition, ...]


@dataclass(slots=True)
class NodeFrame2(TagState):
    """Node_Frame2: a tag's state and the ranges of this cycle, at most 255.

    Source: NLink V1.4; nlink_unpack, nlink_linktrack_nodeframe2.c.
    """

    nodes: tuple[NodeRange, ...]


@dataclass(slots=True)
class NodeFrame3(Sender):
    """Node_Frame3: the ranges of this cycle, at most 255.

    Source: NLink V1.4; nlink_unpack, nlink_linktrack_nodeframe3.c.
    """

    nodes: tuple[NodeRange, ...]


@dataclass(slots=True)
class NodeFrame4(Sender):
    """Node_Frame4: the ranges of all tags, at an anchor or a console.

    Source: NLink V1.4; nlink_unpack, nlink_linktrack_nodeframe4.c.
    """

    tags: tuple[TagRanges, ...]


@dataclass(slots=True)
class AoaNodeFrame0(Sender):
    """AOA Node_Frame0: ranges and bearings of this cycle, at most 255.

    Source: NLink V1.4; nlink_unpack, nlink_linktrack_aoa_nodeframe0.c.
    """

    nodes: tuple[AoaNodeRange, ...]


@dataclass(slots=True)
class NodeFrame5(Sender):
    """Node_Frame5: the ranges of this cycle between modules with ids of 32 bits, at most 255.

    In DR_MODE1 the system time is not valid.

    Source: NLink V1.4; nlink_unpack, nlink_linktrack_nodeframe5.c.
    """

    nodes: tuple[NodeRange, ...]


@dataclass(slots=True)
class NodeFrame6:
    """Node_Frame6: user data that came over the air between modules with ids of 32 bits.

    Attributes:
        id: id of the module.
        role: its role.
        nodes: who sent what, at most 255.

    Source: NLink V1.4; nlink_unpack, nlink_linktrack_nodeframe6.c.
    """

    id: int
    role: int
    nodes: tuple[NodeData, ...]


@dataclass(slots=True)
class SettingFrame0:
    """Setting_Frame0: the settings of a module, as it answers a request to read them.

    The same frame from the host writes them (`mix` 0), which can disable a module; no driver here sends one.

    Attributes:
        mix: command of a request; bit 0 = read; 0 in an answer.
        role: role of the module.
        math_model: of a tag; None for others.
        baud_rate: of its port.
        system_channel: UWB channel.
        id: id of the module.
        update_rate_hz: frames in a second [Hz].
        system_id: of the UWB network.
        on_off: switches; bit 0 = LED.
        filter_factor: of the position filter.
        mode: low four bits the mode that runs, high four bits the one to come.
        protocol: which frame it sends: 0 Anchor_Frame0, 1 Tag_Frame0, 2 to 8 Node_Frame0 to 6, 128 NMEA.
        tx_gain_db: gain of its sender [dB].
        node_capacity: how many nodes a DR network takes.
        local_time_ms: time since its power-up [ms].
        anchor_group: g, when `anchors` are anchors 10 g to 10 g + 9.
        anchors: coordinates of ten anchors [m]; None where not set.

    Source: NLink V1.4; LinkTrack User Manual V2.3, 8.1.2.10.
    """

    mix: int
    role: int
    math_model: int | None
    baud_rate: int
    system_channel: int
    id: int
    update_rate_hz: int
    system_id: int
    on_off: int
    filter_factor: int
    mode: int
    protocol: int
    tx_gain_db: float
    node_capacity: int
    local_time_ms: int
    anchor_group: int
    anchors: tuple[Coordinates, ...]


@dataclass(slots=True)
class UserFrame1:
    """User_Frame1: data that a host has a data-transmission (DT) master send to a slave.

    Attributes:
        remote_role: role of those it is for; 0 = all.
        remote_id: id of the one it is for.
        data: what to send.

    Source: NLink V1.4; LinkTrack User Manual V2.3, table 18.
    """

    remote_role: int
    remote_id: int
    data: bytes


@dataclass(slots=True)
class ErrorFrame0:
    """Error_Frame0: a module's complaint.

    Attributes:
        id: id of the module.
        role: its role.
        local_time_ms: time since its power-up [ms].
        errors: what is wrong.
        marks: three bytes without documented meaning.

    Source: NLink V1.4; LinkTrack User Manual V2.3, 8.1.2.11.
    """

    id: int
    role: int
    local_time_ms: int
    errors: ErrorBits
    marks: tuple[int, int, int]


@dataclass(slots=True)
class SystemFrame0:
    """System_Common_Frame0: what a module is.

    Attributes:
        mix: command of a request; bit 0 = read.
        product_version: low, high part.
        hardware_version: low, high part.
        firmware_version: build, low, middle, high part.
        baud_rate: of its port.
        role: role of the module.
        id: id of the module.

    Source: NLink V1.4; LinkTrack User Manual V2.3, 8.1.2.12.
    """

    mix: int
    product_version: tuple[int, int]
    hardware_version: tuple[int, int]
    firmware_version: tuple[int, int, int, int]
    baud_rate: int
    role: int
    id: int


Frame: TypeAlias = (
    AnchorFrame0
    | TagFrame0
    | NodeFrame0
    | NodeFrame1
    | NodeFrame2
    | NodeFrame3
    | NodeFrame4
    | AoaNodeFrame0
    | NodeFrame5
    | NodeFrame6
    | SettingFrame0
    | UserFrame1
    | ErrorFrame0
    | SystemFrame0
)
