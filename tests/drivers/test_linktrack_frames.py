"""Single LinkTrack frames: what vendors' and peers' programs made of bytes, and what encoding gives back."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.linktrack_frames import decode, encode
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
from tests.vectors import load, stems

KINDS: dict[str, type[Frame]] = {
    "anchor_frame0": AnchorFrame0,
    "tag_frame0": TagFrame0,
    "node_frame0": NodeFrame0,
    "node_frame1": NodeFrame1,
    "node_frame2": NodeFrame2,
    "node_frame3": NodeFrame3,
    "node_frame4": NodeFrame4,
    "aoa_node_frame0": AoaNodeFrame0,
    "node_frame5": NodeFrame5,
    "node_frame6": NodeFrame6,
    "setting_frame0": SettingFrame0,
    "user_frame1": UserFrame1,
    "error_frame0": ErrorFrame0,
    "system_frame0": SystemFrame0,
}
"""Name in the vectors -> type."""

OUR_NAMES = {
    "pos_3d": "pos",
    "vel_3d": "vel",
    "eop_3d": "eop",
    "dis_arr": "dis",
    "imu_gyro_3d": "gyro",
    "imu_acc_3d": "acc",
    "angle_3d": "angle_deg",
    "angle": "angle_deg",
    "quaternion": "quat_wxyz",
    "local_time": "local_time_ms",
    "system_time": "system_time_ms",
    "uart_baudrate": "baud_rate",
    "system_ch": "system_channel",
    "update_rate": "update_rate_hz",
    "filter_property": "filter_factor",
    "anchor_group_index": "anchor_group",
    "error_type": "errors",
}
"""Name in the peers' listings -> ours."""

# Frames of real modules, as the vendor prints them.
TAG_FRAME0 = bytes.fromhex(
    "550101028e0a00a5ffffe80300dafffffaffff000000350c00a31500cd1a004c120000000000000000000000000027ace23c"
    "a27d0b3cd2703bbdcfa5803e3efc1b411fa126bd265d5741bd8057413f6357417138f52544fa8a2228bf5ab700be204f3dbf"
    "1c0b523df4263d400cae0000cb170100f00b10ff54131d480000bcfd"
)
NODE_FRAME2 = bytes.fromhex(
    "5504ac000201ba661d000609ffde0a00dfffffe80300faffff1a0000000000c0120000000000000027ace23c56ed1c3cd270"
    "3bbd3257663e3bcb1b41937061bd25b26b41a1226c41dada6b416d23e92370dddbf7303f5fd6313fba811e3e4769e2bd919b"
    "4040c523000040405cd51c0000001d006d130401006b0c00b19fa6661d0016450101ac1500b4a1a6661d00d3010102481a00"
    "ca9fa6661d0038ba01032b1200c6a0a6661d00644025"
)
NODE_FRAME3 = bytes.fromhex(
    "550532000201f81107006fd06e00000001025a13040100220b00b59f0101a31700b6a00102881c00aa9f0103e61400b8a09a"
)
AOA_NODE_FRAME0 = bytes.fromhex(
    "550742000200be730200000000000000f106ef12040100ff0200220ba39f9e0001010203"
    "00ad00a49f00000102ec0300cb03a5a00000010388050099eca3a0000033"
)


def captured(wire: bytes) -> Any:
    """The frame that these bytes of a real module are."""
    frame = decode(wire)
    assert frame is not None
    return frame


def altered(wire: bytes, **changes: Any) -> Any:
    """A real module's frame with other values in some fields."""
    return dataclasses.replace(captured(wire), **changes)


def with_checksum(frame: bytearray) -> bytes:
    frame[-1] = sum(frame[:-1]) & 0xFF
    return bytes(frame)


def assert_same_values(ours: Any, peer: Any) -> None:
    """Compare a frame or a part of it with a peer's listing: integers exactly, floats as binary32."""
    if isinstance(peer, dict):
        renamed = {OUR_NAMES.get(str(name), str(name)): value for name, value in peer.items()}
        listed = {name: value for name, value in renamed.items() if name != "data_length"}
        assert set(ours.__match_args__) == set(listed)
        for name, value in listed.items():
            assert_same_values(getattr(ours, name), value)
    elif isinstance(peer, list):
        assert len(ours) == len(peer)
        for mine, theirs in zip(ours, peer, strict=True):
            assert_same_values(mine, theirs)
    elif isinstance(ours, bytes):
        assert ours.hex() == peer
    elif isinstance(ours, int):
        assert ours == peer
    else:
        assert ours == pytest.approx(peer, rel=1e-6, abs=1e-12)


# Strategies: values on the wire's grid, so that they come back as they were.


def scaled(low: int, high: int, steps: int) -> st.SearchStrategy[float]:
    return st.integers(low, high).map(lambda raw: raw / steps)


def several(element: st.SearchStrategy[Any], count: int) -> st.SearchStrategy[tuple[Any, ...]]:
    return st.tuples(*[element] * count)


def blocks(kind: Callable[..., Any], *fields: st.SearchStrategy[Any], most: int = 12) -> Any:
    return st.lists(st.builds(kind, *fields), max_size=most).map(tuple)


BYTE, UINT16, UINT24, UINT32 = (st.integers(0, 2**bits - 1) for bits in (8, 16, 24, 32))
NUMBER = st.integers(-(2**23), 2**23 - 1)
FLOAT32 = st.floats(width=32, allow_nan=False)
LENGTH, ANGLE = scaled(-(2**23), 2**23 - 1, 1000), scaled(-(2**15), 2**15 - 1, 100)
POWER, VOLTAGE = scaled(0, 255, -2), scaled(0, 65535, 1000)
COORDINATE = st.one_of(st.none(), NUMBER.filter(lambda raw: raw != -8388000).map(lambda raw: raw / 1000))
MODULE: dict[str, st.SearchStrategy[Any]] = {"id": BYTE, "role": BYTE}
SENDER = {**MODULE, "local_time_ms": UINT32, "system_time_ms": UINT32, "voltage": VOLTAGE}
TAG_STATE = {
    **SENDER,
    "pos": several(LENGTH, 3),
    "vel": several(scaled(-(2**23), 2**23 - 1, 10000), 3),
    "eop": several(scaled(0, 255, 100), 3),
    "gyro": several(FLOAT32, 3),
    "acc": several(FLOAT32, 3),
    "angle_deg": several(ANGLE, 3),
    "quat_wxyz": several(FLOAT32, 4),
}
DATA = st.binary(max_size=40)
TAG_BLOCKS = blocks(
    TagBlock,
    st.just(2),
    st.integers(0, 254),
    several(LENGTH, 3),
    several(scaled(0, 65535, 100), 8),
    most=30,
)
NODE_RANGES = blocks(NodeRange, BYTE, BYTE, LENGTH, POWER, POWER, most=40)
FRAMES_BY_TYPE: dict[type[Frame], st.SearchStrategy[Any]] = {
    AnchorFrame0: st.builds(AnchorFrame0, **{**SENDER, "role": st.sampled_from([1, 3])}, nodes=TAG_BLOCKS),
    TagFrame0: st.builds(TagFrame0, **TAG_STATE, dis=several(LENGTH, 8)),
    NodeFrame0: st.builds(NodeFrame0, **MODULE, nodes=blocks(NodeData, BYTE, BYTE, DATA)),
    NodeFrame1: st.builds(NodeFrame1, **SENDER, nodes=blocks(TagPosition, BYTE, BYTE, several(LENGTH, 3))),
    NodeFrame2: st.builds(NodeFrame2, **TAG_STATE, nodes=NODE_RANGES),
    NodeFrame3: st.builds(NodeFrame3, **SENDER, nodes=NODE_RANGES),
    NodeFrame4: st.builds(
        NodeFrame4,
        **SENDER,
        tags=blocks(TagRanges, BYTE, scaled(0, 255, 20), blocks(AnchorRange, BYTE, LENGTH, most=16)),
    ),
    AoaNodeFrame0: st.builds(
        AoaNodeFrame0, **SENDER, nodes=blocks(AoaNodeRange, BYTE, BYTE, LENGTH, ANGLE, POWER, POWER)
    ),
    NodeFrame5: st.builds(
        NodeFrame5, **{**SENDER, "id": UINT32}, nodes=blocks(NodeRange, BYTE, UINT32, LENGTH, POWER, POWER)
    ),
    NodeFrame6: st.builds(NodeFrame6, id=UINT32, role=BYTE, nodes=blocks(NodeData, BYTE, UINT32, DATA)),
    SettingFrame0: st.builds(
        SettingFrame0,
        mix=BYTE,
        math_model=st.one_of(st.none(), st.integers(0, 254)),
        baud_rate=UINT24,
        system_channel=BYTE,
        update_rate_hz=UINT16,
        system_id=BYTE,
        on_off=BYTE,
        filter_factor=BYTE,
        mode=BYTE,
        protocol=BYTE,
        tx_gain_db=scaled(0, 255, 2),
        node_capacity=BYTE,
        local_time_ms=UINT32,
        anchor_group=BYTE,
        anchors=several(several(COORDINATE, 3), 10),
        **MODULE,
    ),
    UserFrame1: st.builds(UserFrame1, BYTE, BYTE, DATA),
    ErrorFrame0: st.builds(
        ErrorFrame0, **MODULE, local_time_ms=UINT32, errors=BYTE.map(ErrorBits), marks=several(BYTE, 3)
    ),
    SystemFrame0: st.builds(
        SystemFrame0,
        **MODULE,
        mix=BYTE,
        product_version=several(BYTE, 2),
        hardware_version=several(BYTE, 2),
        firmware_version=several(BYTE, 4),
        baud_rate=UINT24,
    ),
}
FRAMES: st.SearchStrategy[Frame] = st.one_of(*FRAMES_BY_TYPE.values())
"""Frames of every type."""


@pytest.mark.parametrize("stem", stems("linktrack_*_random", "linktrack_captured_frames"))
def test_vectors_decode_to_the_values_of_the_vendors_decoder(stem: str) -> None:
    rows = load(stem)["frames"]
    assert rows
    for row in rows:
        frame = decode(bytes.fromhex(row["hex"]))
        assert type(frame) is KINDS[row["type"]]
        assert_same_values(frame, row["decoded"])


RESERVED_IN_HEAD = {
    "tag_frame0": [(70, 82), (104, 108), (116, 117), (122, 127)],
    "node_frame0": [(6, 10)],
    "node_frame1": [(14, 24)],
    "node_frame2": [(31, 40), (64, 76), (98, 102), (106, 116)],
    "node_frame3": [(14, 18)],
    "node_frame4": [(14, 18)],
    "aoa_node_frame0": [(14, 18)],
    "node_frame5": [(17, 21)],
    "node_frame6": [(9, 13)],
}
"""First and last plus one of a frame's reserved bytes, as NLink V1.4 has them."""
RESERVED_IN_BLOCKS = {"node_frame1": (27, 20, 9), "node_frame2": (119, 13, 6), "aoa_node_frame0": (21, 11, 2)}
"""First block, size of a block, and how many bytes at its end are reserved."""


def reserved(kind: str, wire: bytearray) -> list[tuple[int, int]]:
    found = list(RESERVED_IN_HEAD[kind])
    if kind in RESERVED_IN_BLOCKS:
        first, size, tail = RESERVED_IN_BLOCKS[kind]
        found += [(end - tail, end) for end in range(first + size, len(wire), size)]
    at = 21
    while kind == "node_frame4" and at < len(wire) - 1:
        found.append((at + 1, at + 3))
        at += 5 + 4 * wire[at + 4]
    return found


@pytest.mark.parametrize("stem", stems("linktrack_*_random", "linktrack_captured_frames"))
def test_encoding_a_decoded_vector_gives_its_bytes_with_reserved_ones_zero(stem: str) -> None:
    for row in load(stem)["frames"]:
        wire = bytearray.fromhex(row["hex"])
        frame = captured(bytes(wire))
        if isinstance(frame, AnchorFrame0):
            # Its blocks may lie in any of the places.
            assert decode(encode(frame)) == frame
            continue
        for start, end in reserved(row["type"], wire):
            wire[start:end] = bytes(end - start)
        assert encode(frame) == with_checksum(wire)


@pytest.mark.parametrize("stem", stems("linktrack_setting_frames"))
def test_settings_errors_and_user_data_are_as_the_vendor_prints_them(stem: str) -> None:
    for row in load(stem)["frames"]:
        wire = bytes.fromhex(row["hex"])
        frame = captured(wire)
        for name, value in row["fields"].items():
            if name == "anchors_m":
                unset = [[None if part == -8388.0 else part for part in anchor] for anchor in value]
                assert [list(anchor) for anchor in frame.anchors] == unset
            elif name == "tx_gain_raw":
                assert frame.tx_gain_db == value / 2
            elif name == "frame_length":
                assert len(wire) == value
            elif name == "data_length":
                assert len(frame.data) == value
            else:
                assert_same_values(getattr(frame, OUR_NAMES.get(name, name)), value)
        assert decode(encode(frame)) == frame


def test_a_captured_answer_to_a_settings_request_reads_as_the_manual_explains_it() -> None:
    head = "540000030200100e09003200000011000000ff03430000001400006e670000000000000000"
    frame = captured(bytes.fromhex(head + "600280" * 30 + "6d"))
    assert isinstance(frame, SettingFrame0)
    assert (frame.baud_rate, frame.update_rate_hz, frame.tx_gain_db) == (921_600, 50, 33.5)
    assert frame.anchors == ((None, None, None),) * 10


def test_captured_bearings_are_as_the_vendors_test_has_them() -> None:
    frame = captured(AOA_NODE_FRAME0)
    assert isinstance(frame, AoaNodeFrame0)
    assert [node.dis for node in frame.nodes] == [0.767, 0.770, 1.004, 1.416]
    assert [node.angle_deg for node in frame.nodes] == [28.50, 1.73, 9.71, -49.67]


@pytest.mark.parametrize("stem", stems("linktrack_rejects"))
def test_rejects_are_refused(stem: str) -> None:
    rows = load(stem)["frames"]
    assert rows
    for row in rows:
        assert decode(bytes.fromhex(row["hex"])) is None, row["why"]


def test_bytes_that_fill_no_block_are_refused() -> None:
    longer = bytearray(NODE_FRAME3 + b"\x00")
    longer[2] += 1
    assert decode(with_checksum(longer)) is None


def test_no_power_is_plain_zero() -> None:
    nodes = (NodeRange(1, 0, 1.0, 0.0, 0.0),)
    (node,) = captured(encode(altered(NODE_FRAME3, nodes=nodes))).nodes
    assert math.copysign(1.0, node.fp_rssi) == 1.0


@pytest.mark.parametrize("kind", FRAMES_BY_TYPE, ids=lambda kind: kind.__name__)
@given(data=st.data())
def test_decode_inverts_encode(kind: type[Frame], data: st.DataObject) -> None:
    frame = data.draw(FRAMES_BY_TYPE[kind])
    back = decode(encode(frame))
    assert type(back) is kind
    assert back == frame


@given(FRAMES, st.data())
def test_decode_wants_exactly_one_frame(frame: Frame, data: st.DataObject) -> None:
    wire = encode(frame)
    assert decode(wire + b"\x00") is None
    assert decode(b"\x00" + wire) is None
    assert decode(wire[: data.draw(st.integers(0, len(wire) - 1))]) is None


def test_every_type_has_a_strategy() -> None:
    assert set(FRAMES_BY_TYPE) == set(KINDS.values())


def test_empty_places_of_anchor_frame0_are_left_out_whatever_they_hold() -> None:
    frame = captured_anchor_frame0()
    wire = bytearray(encode(frame))
    empty = 2 + 27 * len(frame.nodes)
    assert wire[empty] == 255
    wire[empty + 1 : empty + 27] = bytes(range(1, 27))
    assert decode(bytes(wire)) == frame


def captured_anchor_frame0() -> AnchorFrame0:
    tag = TagBlock(2, 3, (1.5, -2.25, 0.75), (4.21, 0.0, 655.35, 0.0, 0.0, 0.0, 0.0, 0.01))
    return AnchorFrame0(7, 1, 1000, 2000, 4.9, (tag, tag._replace(id=200)))


def test_error_bits_have_names() -> None:
    frame = captured(bytes.fromhex("54fa20000200d0070000000000000102" + "00" * 15 + "4a"))
    assert isinstance(frame, ErrorFrame0)
    assert frame.errors is ErrorBits.DUPLICATE_NODE
    assert (frame.role, frame.id, frame.local_time_ms) == (2, 0, 2000)


def test_off_grid_values_round_to_the_nearest_step() -> None:
    back = decode(encode(altered(TAG_FRAME0, pos=(1.00049, -1.00051, 0.0), voltage=4.9996)))
    assert isinstance(back, TagFrame0)
    assert (back.pos, back.voltage) == ((1.0, -1.001, 0.0), 5.0)


SETTING = SettingFrame0(
    0, 3, None, 921_600, 9, 0, 50, 0, 17, 0, 0, 3, 33.5, 20, 26_478, 0, ((None, None, None),) * 10
)
RANGE = NodeRange(1, 0, 1.0, -80.0, -80.0)
CONSOLE = NodeFrame4(1, 3, 0, 0, 5.0, ())


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (altered(NODE_FRAME2, id=256), r"id is 256, must be from 0 to 255"),
        (altered(NODE_FRAME2, role=-1), r"role is -1, must be from 0 to 255"),
        (
            altered(NODE_FRAME2, pos=(0.0, 8388.608, 0.0)),
            r"pos is 8388\.608, must be from -8388\.608 to 8388\.607",
        ),
        (
            altered(NODE_FRAME2, vel=(math.nan, 0.0, 0.0)),
            r"vel is nan, must be from -838\.8608 to 838\.8607",
        ),
        (altered(NODE_FRAME2, eop=(0.0, 0.0, 2.56)), r"eop is 2\.56, must be from 0\.0 to 2\.55"),
        (
            altered(NODE_FRAME2, angle_deg=(0.0, math.inf, 0.0)),
            r"angle_deg is inf, must be from -327\.68 to 327\.67",
        ),
        (altered(NODE_FRAME2, voltage=65.536), r"voltage is 65\.536, must be from 0\.0 to 65\.535"),
        (
            altered(NODE_FRAME2, system_time_ms=2**32),
            r"system_time_ms is 4294967296, must be from 0 to 4294967295",
        ),
        (
            altered(NODE_FRAME2, gyro=(1e39, 0.0, 0.0)),
            r"gyro is 1e\+39, must be within 3\.4028235e38 of zero",
        ),
        (altered(NODE_FRAME2, acc=(0.0, 0.0)), r"acc has 2 values, must have 3"),
        (
            altered(NODE_FRAME2, nodes=(RANGE, RANGE._replace(fp_rssi=-128.0))),
            r"nodes\[1\]\.fp_rssi is -128\.0, must be from -127\.5 to 0\.0",
        ),
        (altered(NODE_FRAME3, nodes=(RANGE,) * 256), r"nodes has 256 entries, must have at most 255"),
        (
            dataclasses.replace(CONSOLE, tags=(TagRanges(1, 5.0, (AnchorRange(0, 1.0),) * 17),)),
            r"tags\[0\]\.anchors has 17 entries, must have at most 16",
        ),
        (
            dataclasses.replace(CONSOLE, tags=(TagRanges(1, 5.0, (AnchorRange(0, 9999.0),)),)),
            r"tags\[0\]\.anchors\[0\]\.dis is 9999\.0, must be from -8388\.608 to 8388\.607",
        ),
        (
            dataclasses.replace(CONSOLE, tags=(TagRanges(1, 5.0, (AnchorRange(0, 1.0),) * 16),) * 108),
            r"the frame has 7474 bytes, must have at most 7422",
        ),
        (
            NodeFrame0(1, 2, (NodeData(2, 1, bytes(4081)),)),
            r"the frame has 4097 bytes, must have at most 4096",
        ),
        (UserFrame1(5, 0, bytes(4086)), r"data has 4086 entries, must have at most 4085"),
        (dataclasses.replace(SETTING, math_model=255), r"math_model is 255, which on the wire means none.*"),
        (
            dataclasses.replace(SETTING, anchors=((-8388.0, None, None),) * 10),
            r"anchors is -8388\.0, which on the wire means none.*",
        ),
        (
            dataclasses.replace(SETTING, anchors=((None, None, None),) * 9),
            r"anchors has 9 values, must have 10",
        ),
        (dataclasses.replace(SETTING, mode=cast("int", None)), r"mode is None, must be from 0 to 255"),
        (dataclasses.replace(captured_anchor_frame0(), role=2), r"role is 2, must be 1 or 3"),
        (
            dataclasses.replace(
                captured_anchor_frame0(), nodes=(captured_anchor_frame0().nodes[0]._replace(role=1),)
            ),
            r"nodes\[0\]\.role is 1, must be 2",
        ),
        (
            dataclasses.replace(
                captured_anchor_frame0(), nodes=(captured_anchor_frame0().nodes[0]._replace(id=255),)
            ),
            r"nodes\[0\]\.id is 255, must be from 0 to 254",
        ),
        (
            dataclasses.replace(captured_anchor_frame0(), nodes=captured_anchor_frame0().nodes[:1] * 31),
            r"nodes has 31 entries, must have at most 30",
        ),
    ],
)
def test_a_value_that_does_not_fit_is_named_with_its_limit(frame: Frame, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}$"):
        encode(frame)
