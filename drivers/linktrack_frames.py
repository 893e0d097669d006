"""Frames of Nooploop LinkTrack modules (NLink), encoded and decoded; no I/O, no time, no state.

Here is which field lies where in each type of frame. All types of NLink V1.4 are there but the vendor's
Node_Frame7, whose layout is not published.

Source: NLink V1.4; nlink_unpack @1b79045; LinkTrack User Manual V2.3, chapters 7 and 8.
"""

import re

from drivers.linktrack_layouts import BlockFrame, FixedFrame, FrameLayout, PayloadFrame, TagTable, UserFrame
from drivers.linktrack_records import Float32, Integer, RawBytes, Record, Slot
from drivers.linktrack_types import (
    AnchorFrame0,
    AnchorRange,
    AoaNodeFrame0,
    AoaNodeRange,
    ErrorBits,
    ErrorFrame0,
    Frame,
    NodeData,
    NodeFrame0,
    NodeFrame1,
    NodeFrame2,
    NodeFrame3,
    NodeFrame4,
    NodeFrame5,
    NodeFrame6,
    NodeRange,
    SettingFrame0,
    SystemFrame0,
    TagBlock,
    TagFrame0,
    TagPosition,
    TagRanges,
    UserFrame1,
)

_U8, _U16, _U24, _U32, _F32 = Integer("B"), Integer("H"), Integer("HB"), Integer("I"), Float32()
_LENGTH, _SPEED, _ANGLE = Integer("Hb", 1000), Integer("Hb", 10000), Integer("h", 100)
_VOLTAGE, _ERROR, _POWER = Integer("H", 1000), Integer("B", 100), Integer("B", -2)
_COORDINATE = Integer("Hb", 1000, void=-8388000)

_LONGEST_USER_DATA = 4096
"""Cap for frames of user data (ArduPilot AP_Beacon_Nooploop has the same)."""
_MOST_ANCHORS = 16
"""Of one tag in Node_Frame4 (nlink_unpack; NLink V1.4 has 8)."""
_LONGEST_NODE_FRAME4 = 22 + 200 * (5 + 8 * 4)
"""200 tags with 8 anchors each, which is what LP_MODE2 allows."""

# fmt: off
_RANGE = [
    Slot("role", 0, _U8), Slot("id", 1, _U8), Slot("dis", 2, _LENGTH),
    Slot("fp_rssi", 5, _POWER), Slot("rx_rssi", 6, _POWER),
]
_NODE_RANGE, _PADDED_NODE_RANGE = Record(NodeRange, 7, _RANGE), Record(NodeRange, 13, _RANGE)
_WIDE_NODE_RANGE = Record(NodeRange, 10, [
    Slot("role", 0, _U8), Slot("id", 1, _U32), Slot("dis", 5, _LENGTH),
    Slot("fp_rssi", 8, _POWER), Slot("rx_rssi", 9, _POWER),
])
_AOA_NODE_RANGE = Record(AoaNodeRange, 11, [
    Slot("role", 0, _U8), Slot("id", 1, _U8), Slot("dis", 2, _LENGTH), Slot("angle_deg", 5, _ANGLE),
    Slot("fp_rssi", 7, _POWER), Slot("rx_rssi", 8, _POWER),
])
_TAG_RANGES = Record(TagRanges, 5, [Slot("id", 0, _U8), Slot("voltage", 3, Integer("B", 20))], rest="anchors")
_ANCHOR_RANGE = Record(AnchorRange, 4, [Slot("id", 0, _U8), Slot("dis", 1, _LENGTH)])
_TAG_BLOCK = Record(TagBlock, 27, [
    Slot("id", 0, _U8), Slot("role", 1, _U8), Slot("pos", 2, _LENGTH, (3,)),
    Slot("dis", 11, Integer("H", 100), (8,)),
])
_TAG_POSITION = Record(TagPosition, 20, [
    Slot("role", 0, _U8), Slot("id", 1, _U8), Slot("pos", 2, _LENGTH, (3,)),
])
_NODE_DATA = Record(NodeData, 4, [Slot("role", 0, _U8), Slot("id", 1, _U8)], rest="data")
_WIDE_NODE_DATA = Record(NodeData, 7, [Slot("role", 0, _U8), Slot("id", 1, _U32)], rest="data")
_SENDER = [
    Slot("role", 4, _U8), Slot("id", 5, _U8),
    Slot("local_time_ms", 6, _U32), Slot("system_time_ms", 10, _U32), Slot("voltage", 18, _VOLTAGE),
]

# Offsets as in NLink V1.4 and nlink_unpack; bytes that no slot covers are reserved.
_LAYOUT_OF_TYPE: dict[type[Frame], FrameLayout] = {
    AnchorFrame0: TagTable(b"\x55\x00", Record(AnchorFrame0, 896, [
        Slot("local_time_ms", 879, _U32), Slot("voltage", 887, _VOLTAGE),
        Slot("system_time_ms", 889, _U32), Slot("id", 893, _U8), Slot("role", 894, _U8),
    ], rest="nodes"), _TAG_BLOCK),
    TagFrame0: FixedFrame(b"\x55\x01", Record(TagFrame0, 128, [
        Slot("id", 2, _U8), Slot("role", 3, _U8),
        Slot("pos", 4, _LENGTH, (3,)), Slot("vel", 13, _SPEED, (3,)), Slot("dis", 22, _LENGTH, (8,)),
        Slot("gyro", 46, _F32, (3,)), Slot("acc", 58, _F32, (3,)),
        Slot("angle_deg", 82, _ANGLE, (3,)), Slot("quat_wxyz", 88, _F32, (4,)),
        Slot("local_time_ms", 108, _U32), Slot("system_time_ms", 112, _U32),
        Slot("eop", 117, _ERROR, (3,)), Slot("voltage", 120, _VOLTAGE),
    ])),
    NodeFrame0: PayloadFrame(b"\x55\x02", Record(NodeFrame0, 11, [
        Slot("role", 4, _U8), Slot("id", 5, _U8),
    ], rest="nodes"), _NODE_DATA, count_size=2, item=RawBytes(), longest=_LONGEST_USER_DATA),
    NodeFrame1: BlockFrame(b"\x55\x03", Record(NodeFrame1, 27, [
        Slot("role", 4, _U8), Slot("id", 5, _U8),
        Slot("system_time_ms", 6, _U32), Slot("local_time_ms", 10, _U32), Slot("voltage", 24, _VOLTAGE),
    ], rest="nodes"), _TAG_POSITION),
    NodeFrame2: BlockFrame(b"\x55\x04", Record(NodeFrame2, 119, [
        Slot("role", 4, _U8), Slot("id", 5, _U8), Slot("system_time_ms", 6, _U32),
        Slot("eop", 10, _ERROR, (3,)), Slot("pos", 13, _LENGTH, (3,)), Slot("vel", 22, _SPEED, (3,)),
        Slot("gyro", 40, _F32, (3,)), Slot("acc", 52, _F32, (3,)),
        Slot("angle_deg", 76, _ANGLE, (3,)), Slot("quat_wxyz", 82, _F32, (4,)),
        Slot("local_time_ms", 102, _U32), Slot("voltage", 116, _VOLTAGE),
    ], rest="nodes"), _PADDED_NODE_RANGE),
    NodeFrame3: BlockFrame(b"\x55\x05", Record(NodeFrame3, 21, _SENDER, rest="nodes"), _NODE_RANGE),
    NodeFrame4: PayloadFrame(
        b"\x55\x06", Record(NodeFrame4, 21, _SENDER, rest="tags"), _TAG_RANGES,
        count_size=1, item=_ANCHOR_RANGE, most_items=_MOST_ANCHORS, longest=_LONGEST_NODE_FRAME4,
    ),
    AoaNodeFrame0: BlockFrame(
        b"\x55\x07", Record(AoaNodeFrame0, 21, _SENDER, rest="nodes"), _AOA_NODE_RANGE
    ),
    NodeFrame5: BlockFrame(b"\x55\x08", Record(NodeFrame5, 24, [
        Slot("role", 4, _U8), Slot("id", 5, _U32), Slot("local_time_ms", 9, _U32),
        Slot("system_time_ms", 13, _U32), Slot("voltage", 21, _VOLTAGE),
    ], rest="nodes"), _WIDE_NODE_RANGE),
    NodeFrame6: PayloadFrame(b"\x55\x09", Record(NodeFrame6, 14, [
        Slot("role", 4, _U8), Slot("id", 5, _U32),
    ], rest="nodes"), _WIDE_NODE_DATA, count_size=2, item=RawBytes(), longest=_LONGEST_USER_DATA),
    SettingFrame0: FixedFrame(b"\x54\x00", Record(SettingFrame0, 128, [
        Slot("mix", 2, _U8), Slot("role", 3, _U8), Slot("math_model", 4, Integer("B", void=255)),
        Slot("baud_rate", 5, _U24), Slot("system_channel", 8, _U8), Slot("id", 9, _U8),
        Slot("update_rate_hz", 10, _U16), Slot("system_id", 12, _U8), Slot("on_off", 14, _U8),
        Slot("filter_factor", 16, _U8), Slot("mode", 17, _U8), Slot("protocol", 19, _U8),
        Slot("tx_gain_db", 20, Integer("B", 2)), Slot("node_capacity", 24, _U8),
        Slot("local_time_ms", 27, _U32),
        Slot("anchor_group", 36, _U8), Slot("anchors", 37, _COORDINATE, (10, 3)),
    ])),
    UserFrame1: UserFrame(b"\x54\xf1\xff\xff\xff\xff", Record(UserFrame1, 10, [
        Slot("remote_role", 6, _U8), Slot("remote_id", 7, _U8),
    ], rest="data"), _LONGEST_USER_DATA),
    ErrorFrame0: FixedFrame(b"\x54\xfa\x20\x00", Record(ErrorFrame0, 32, [
        Slot("role", 4, _U8), Slot("id", 5, _U8), Slot("local_time_ms", 6, _U32),
        Slot("errors", 14, Integer("B", kind=ErrorBits)), Slot("marks", 17, _U8, (3,)),
    ])),
    SystemFrame0: FixedFrame(b"\x52\x00", Record(SystemFrame0, 32, [
        Slot("mix", 2, _U8), Slot("product_version", 3, _U8, (2,)), Slot("hardware_version", 5, _U8, (2,)),
        Slot("firmware_version", 7, _U8, (4,)), Slot("baud_rate", 19, _U24),
        Slot("role", 22, _U8), Slot("id", 23, _U8),
    ])),
}
# fmt: on

LAYOUT_OF_MARK = {layout.start[:2]: layout for layout in _LAYOUT_OF_TYPE.values()}
"""The first two bytes of a frame -> its layout."""

FRAME_START = re.compile(b"|".join(map(re.escape, LAYOUT_OF_MARK)) + rb"|[\x52\x54\x55]\Z")
"""The first two bytes of any frame, or the first one where the second is not there yet."""


def encode(frame: Frame) -> bytes:
    """Bytes of a frame, reserved ones 0, values rounded to the wire's grid.

    Raises:
        ValueError: a value does not fit; names the field and its limit.
    """
    return _LAYOUT_OF_TYPE[type(frame)].encode(frame)


def decode(data: bytes) -> Frame | None:
    """The frame that `data` is; None when it is not exactly one good frame."""
    layout = LAYOUT_OF_MARK.get(data[:2])
    if layout is None or layout.extent(data) != len(data):
        return None
    frame: Frame | None = layout.decode(data)
    return frame
