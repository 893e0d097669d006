import dataclasses
import json
import math
import random
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from drivers import make_sensor, sensor_config_class
from drivers.linktrack import LinkTrack, measurements
from drivers.linktrack_frames import Frame, NodeFrame2, NodeFrame3, NodeRange, TagFrame0, decode, encode
from estimators.messages import Attitude, ImuSample, RangeFrame

DATA = Path(__file__).parents[1] / "data" / "vectors"

KINDS: dict[str, type[Frame]] = {
    "tag_frame0": TagFrame0,
    "node_frame2": NodeFrame2,
    "node_frame3": NodeFrame3,
}
OTHER_TYPES = [
    "anchor_frame0",
    "aoa_node_frame0",
    "node_frame0",
    "node_frame1",
    "node_frame4",
    "node_frame5",
    "node_frame6",
]
# Resolves what a false start still waits for.
FLUSH = bytes(6000)
STREAMS = ["stream_tag", "stream_dr_aoa", "stream_anchor", "sitl_stream"]

# Name in the peer's listing -> ours.
PEER_NAMES = {
    "pos_3d": "pos",
    "vel_3d": "vel",
    "eop_3d": "eop",
    "dis_arr": "dis",
    "imu_gyro_3d": "gyro",
    "imu_acc_3d": "acc",
    "angle_3d": "angle_deg",
    "quaternion": "quat_wxyz",
    "local_time": "local_time_ms",
    "system_time": "system_time_ms",
}


def load(name: str) -> Any:
    return json.loads((DATA / f"linktrack_{name}.json").read_text())


def vectors(kind: str) -> list[dict[str, Any]]:
    captured = [row for row in load("captured_frames")["frames"] if row["type"] == kind]
    return [*load(f"{kind}_random")["frames"], *captured]


def captured(kind: str) -> Frame:
    frame = decode(captured_bytes(kind))
    assert frame is not None
    return frame


def altered(kind: str, **changes: Any) -> Frame:
    """The captured frame of a kind with other values in some fields."""
    return cast("Frame", dataclasses.replace(cast("Any", captured(kind)), **changes))


def captured_bytes(kind: str) -> bytes:
    return bytes.fromhex(vectors(kind)[-1]["hex"])


def new_sensor(latency_ms: float = 0.0) -> LinkTrack:
    return LinkTrack(LinkTrack.Config(latency_ms=latency_ms))


def in_chunks(sensor: LinkTrack, stream: bytes, sizes: list[int]) -> list[Frame]:
    """Frames of a stream cut into pieces of these sizes, over and over."""
    found: list[Frame] = []
    position = turn = 0
    while position < len(stream):
        size = sizes[turn % len(sizes)]
        found += sensor.frames(stream[position : position + size])
        position += size
        turn += 1
    return found


def with_checksum(frame: bytearray) -> bytes:
    frame[-1] = sum(frame[:-1]) & 0xFF
    return bytes(frame)


def assert_same_values(ours: Any, peer: Any) -> None:
    """Compare a frame or a part of it with the peer's listing: integers exactly, floats as binary32."""
    if isinstance(peer, dict):
        renamed = {PEER_NAMES.get(str(name), str(name)): value for name, value in peer.items()}
        assert {field.name for field in dataclasses.fields(ours)} == set(renamed)
        for name, value in renamed.items():
            assert_same_values(getattr(ours, name), value)
    elif isinstance(peer, list):
        assert isinstance(ours, tuple)
        assert len(ours) == len(peer)
        for mine, theirs in zip(ours, peer, strict=True):
            assert_same_values(mine, theirs)
    elif isinstance(ours, int):
        assert ours == peer
    else:
        assert ours == pytest.approx(peer, rel=1e-6, abs=1e-12)


def scaled(low: int, high: int, steps: int) -> st.SearchStrategy[float]:
    return st.integers(low, high).map(lambda raw: raw / steps)


def triple(element: st.SearchStrategy[float]) -> st.SearchStrategy[tuple[float, float, float]]:
    return st.tuples(element, element, element)


INT24 = (-(2**23), 2**23 - 1)
BYTE, UINT32 = st.integers(0, 255), st.integers(0, 2**32 - 1)
FLOAT32 = st.floats(width=32, allow_nan=False)
DISTANCE, POWER = scaled(*INT24, 1000), scaled(0, 255, -2)
NODES = st.lists(st.builds(NodeRange, BYTE, BYTE, DISTANCE, POWER, POWER), max_size=40).map(tuple)
SENDER: dict[str, st.SearchStrategy[Any]] = {
    "id": BYTE,
    "role": BYTE,
    "local_time_ms": UINT32,
    "system_time_ms": UINT32,
    "voltage": scaled(0, 65535, 1000),
}
TAG_STATE: dict[str, st.SearchStrategy[Any]] = {
    **SENDER,
    "pos": triple(DISTANCE),
    "vel": triple(scaled(*INT24, 10000)),
    "eop": triple(scaled(0, 255, 100)),
    "gyro": triple(FLOAT32),
    "acc": triple(FLOAT32),
    "angle_deg": triple(scaled(-32768, 32767, 100)),
    "quat_wxyz": st.tuples(FLOAT32, FLOAT32, FLOAT32, FLOAT32),
}
TAG_FRAMES0 = st.builds(TagFrame0, dis=st.tuples(*[DISTANCE] * 8), **TAG_STATE)
NODE_FRAMES2 = st.builds(NodeFrame2, nodes=NODES, **TAG_STATE)
NODE_FRAMES3 = st.builds(NodeFrame3, nodes=NODES, **SENDER)
FRAMES: st.SearchStrategy[Frame] = st.one_of(TAG_FRAMES0, NODE_FRAMES2, NODE_FRAMES3)
# Neither "R", "T" nor "U": such bytes cannot start a frame.
HARMLESS = st.lists(st.integers(0, 255).filter(lambda byte: byte not in b"RTU"), max_size=60).map(bytes)


# Single frames


@pytest.mark.parametrize("kind", KINDS)
def test_vectors_decode_to_the_values_of_the_vendors_decoder(kind: str) -> None:
    rows = vectors(kind)
    assert len(rows) == 26
    for row in rows:
        frame = decode(bytes.fromhex(row["hex"]))
        assert type(frame) is KINDS[kind]
        assert_same_values(frame, row["decoded"])


@pytest.mark.parametrize(
    ("kind", "head_reserved", "block_start", "block_size", "block_reserved"),
    [
        ("tag_frame0", [(70, 82), (104, 108), (116, 117), (122, 127)], 127, 1, 0),
        ("node_frame2", [(31, 40), (64, 76), (98, 102), (106, 116)], 119, 13, 6),
        ("node_frame3", [(14, 18)], 21, 7, 0),
    ],
)
def test_encoding_a_decoded_vector_gives_its_bytes_with_reserved_ones_zero(
    kind: str, head_reserved: list[tuple[int, int]], block_start: int, block_size: int, block_reserved: int
) -> None:
    for row in vectors(kind):
        wire = bytearray.fromhex(row["hex"])
        reserved = list(head_reserved)
        if block_reserved:
            ends = range(block_start + block_size, len(wire), block_size)
            reserved += [(end - block_reserved, end) for end in ends]
        for start, end in reserved:
            wire[start:end] = bytes(end - start)
        frame = decode(bytes.fromhex(row["hex"]))
        assert frame is not None
        assert encode(frame) == with_checksum(wire)


def test_rejects_are_refused_alone_and_in_a_stream() -> None:
    rows = load("rejects")["frames"]
    assert len(rows) == 12
    for row in rows:
        wire = bytes.fromhex(row["hex"])
        assert decode(wire) is None, row["why"]
        sensor = new_sensor()
        good = captured_bytes("tag_frame0")
        assert sensor.frames(wire + good * 2) == [captured("tag_frame0")] * 2, row["why"]
        assert sensor.stats.skipped_bytes == len(wire)


@pytest.mark.parametrize("kind", KINDS)
def test_decode_wants_exactly_one_frame(kind: str) -> None:
    wire = captured_bytes(kind)
    assert decode(wire + b"\x00") is None
    assert decode(b"\x00" + wire) is None
    assert all(decode(wire[:size]) is None for size in range(len(wire)))


@given(FRAMES)
@settings(deadline=None)
def test_decode_inverts_encode(frame: Frame) -> None:
    assert decode(encode(frame)) == frame
    assert hash(decode(encode(frame))) == hash(frame)


def test_off_grid_values_round_to_the_nearest_step() -> None:
    frame = altered("tag_frame0", pos=(1.00049, -1.00051, 0.0), voltage=4.9996)
    back = decode(encode(frame))
    assert isinstance(back, TagFrame0)
    assert (back.pos, back.voltage) == ((1.0, -1.001, 0.0), 5.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"id": 256}, r"id is 256, must be from 0 to 255"),
        ({"role": -1}, r"role is -1, must be from 0 to 255"),
        ({"pos": (0.0, 8388.608, 0.0)}, r"pos is 8388\.608, must be from -8388\.608 to 8388\.607"),
        ({"vel": (math.nan, 0.0, 0.0)}, r"vel is nan, must be from -838\.8608 to 838\.8607"),
        ({"eop": (0.0, 0.0, 2.56)}, r"eop is 2\.56, must be from 0\.0 to 2\.55"),
        ({"angle_deg": (0.0, math.inf, 0.0)}, r"angle_deg is inf, must be from -327\.68 to 327\.67"),
        ({"voltage": 65.536}, r"voltage is 65\.536, must be from 0\.0 to 65\.535"),
        ({"system_time_ms": 2**32}, r"system_time_ms is 4294967296, must be from 0 to 4294967295"),
        ({"gyro": (1e39, 0.0, 0.0)}, r"gyro is 1e\+39, must be within 3\.4028235e38 of zero"),
        ({"acc": (0.0, 0.0)}, r"acc has 2 values, must have 3"),
        (
            {"nodes": (NodeRange(1, 0, 1.0, -80.0, -80.0), NodeRange(1, 1, 1.0, -128.0, -80.0))},
            r"nodes\[1\]\.fp_rssi is -128\.0, must be from -127\.5 to 0\.0",
        ),
        (
            {"nodes": (NodeRange(1, 0, 1.0, -80.0, -80.0),) * 256},
            r"nodes has 256 ranges, must have at most 255",
        ),
    ],
)
def test_a_value_that_does_not_fit_is_named_with_its_limit(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}$"):
        encode(altered("node_frame2", **changes))


def test_the_longest_node_lists_fit() -> None:
    nodes = (NodeRange(1, 0, 1.0, -80.0, -80.0),) * 255
    for kind in ("node_frame2", "node_frame3"):
        frame = altered(kind, nodes=nodes)
        assert new_sensor().frames(encode(frame)) == [frame]


# Streams


def listed_frames(name: str) -> tuple[bytes, list[dict[str, Any]]]:
    return (DATA / f"linktrack_{name}.bin").read_bytes(), load(name)["frames"]


@pytest.mark.parametrize("name", STREAMS)
@pytest.mark.parametrize("cut", ["whole", "byte by byte", "random"])
def test_exactly_the_listed_frames_come_out_of_a_stream(name: str, cut: str) -> None:
    stream, rows = listed_frames(name)
    rng = random.Random(name)
    sizes = {
        "whole": [len(stream)],
        "byte by byte": [1],
        "random": [rng.choice([1, 3, 7, 64, 500]) for _ in range(999)],
    }[cut]
    sensor = new_sensor()
    frames = in_chunks(sensor, stream, sizes)
    wanted = [row for row in rows if row["type"] in KINDS]
    assert [type(frame) for frame in frames] == [KINDS[row["type"]] for row in wanted]
    for frame, row in zip(frames, wanted, strict=True):
        assert_same_values(frame, row["decoded"])
    assert sensor.stats.good == len(wanted)
    assert sensor.stats.other == len(rows) - len(wanted)
    assert sensor.stats.skipped_bytes == len(stream) - sum(row["length"] for row in rows)


def test_streams_hold_what_the_project_relies_on() -> None:
    counts = [sum(row["type"] in KINDS for row in listed_frames(name)[1]) for name in STREAMS]
    assert counts == [126, 8, 0, 100]


@pytest.mark.parametrize("kind", OTHER_TYPES)
def test_other_frames_are_skipped_whole(kind: str) -> None:
    rows = load(f"{kind}_random")["frames"]
    sensor = new_sensor()
    assert sensor.frames(b"".join(bytes.fromhex(row["hex"]) for row in rows)) == []
    assert (sensor.stats.other, sensor.stats.skipped_bytes, sensor.stats.bad) == (len(rows), 0, 0)
    assert all(decode(bytes.fromhex(row["hex"])) is None for row in rows)


def test_setting_error_and_user_frames_are_skipped_whole() -> None:
    rows = load("setting_frames")["frames"]
    system_common = with_checksum(bytearray(b"\x52\x00" + bytes(30)))
    sensor = new_sensor()
    assert sensor.frames(b"".join(bytes.fromhex(row["hex"]) for row in rows) + system_common) == []
    assert (sensor.stats.other, sensor.stats.skipped_bytes) == (len(rows) + 1, 0)


def user_frame(payload: bytes) -> bytes:
    head = b"\x54\xf1\xff\xff\xff\xff\x05\x00" + len(payload).to_bytes(2, "little")
    return with_checksum(bytearray(head + payload + b"\x00"))


def node_frame0(payload: bytes) -> bytes:
    length = 16 + len(payload)
    head = b"\x55\x02" + length.to_bytes(2, "little") + bytes(6) + b"\x01\x02\x07"
    return with_checksum(bytearray(head + len(payload).to_bytes(2, "little") + payload + b"\x00"))


@given(FRAMES, st.lists(st.integers(1, 40), min_size=1, max_size=20))
@settings(deadline=None, max_examples=50)
def test_a_frame_inside_user_data_is_not_a_frame(inner: Frame, sizes: list[int]) -> None:
    carriers = [user_frame(encode(inner)), node_frame0(encode(inner))]
    sensor = new_sensor()
    frames = in_chunks(sensor, b"".join(carriers) + captured_bytes("node_frame3"), sizes)
    assert frames == [captured("node_frame3")]
    assert (sensor.stats.other, sensor.stats.skipped_bytes) == (2, 0)


def test_a_good_frame_may_start_inside_a_bad_one() -> None:
    inner = captured_bytes("node_frame3")
    carrier = bytearray(node_frame0(inner))
    carrier[-1] ^= 1
    assert new_sensor().frames(bytes(carrier)) == [captured("node_frame3")]


@pytest.mark.parametrize(
    "head",
    [
        b"\x55\x02\xff\xff",  # longer than the cap
        b"\x55\x04\x00\x10" + bytes(115),  # length without the nodes for it
        b"\x55\x02\x00\x08" + bytes(6) + b"\x01" + b"\x01\x02\xff\x0f",  # block beyond the frame's end
        b"\x55\x06\x00\x08" + bytes(16) + b"\x01",  # length beyond what one tag can fill
        b"\x54\xf1\xff\xff\xff\xff\x05\x00\xff\xff",  # longer than the cap
        b"\x55\x00\x07\x02" + bytes(23) + b"\x08\x07",  # second block is no tag
    ],
)
def test_an_impossible_head_does_not_hold_up_the_next_frame(head: bytes) -> None:
    # At most the fixed part of Node_Frame2 can be waited for, and this frame is longer.
    assert new_sensor().frames(head + captured_bytes("node_frame2")) == [captured("node_frame2")]


@pytest.mark.parametrize("mark", [3, 4, 5, 7, 8])
def test_a_length_below_the_fixed_part_is_refused_before_the_count_is_there(mark: int) -> None:
    short = with_checksum(bytearray([0x55, mark, 8, 0, 1, 2, 3, 0]))
    sensor = new_sensor()
    assert sensor.frames(short) == []
    assert (sensor.stats.other, sensor.stats.good, sensor.stats.skipped_bytes) == (0, 0, 8)


def test_anchor_frame0_needs_plausible_roles_and_its_tail() -> None:
    inner = captured_bytes("node_frame3")
    real = bytearray.fromhex(load("anchor_frame0_random")["frames"][0]["hex"])
    real[815 : 815 + len(inner)] = inner  # reserved bytes may hold anything
    sensor = new_sensor()
    assert sensor.frames(bytes(real)) == []
    assert (sensor.stats.other, sensor.stats.skipped_bytes) == (1, 0)
    block = next(start for start in range(2, 812, 27) if real[start] != 255)
    for offset, wrong in [(block + 1, 1), (894, 2), (895, 0xEF)]:  # a tag's role, the sender's role, the tail
        imitation = bytearray(real)
        imitation[offset] = wrong
        assert new_sensor().frames(bytes(imitation) + FLUSH) == [captured("node_frame3")]


@given(st.lists(FRAMES, max_size=4), st.lists(HARMLESS, min_size=5, max_size=5), st.data())
@settings(deadline=None, max_examples=100)
def test_any_chunking_gives_the_same_and_harmless_garbage_costs_no_frame(
    frames: list[Frame], garbage: list[bytes], data: st.DataObject
) -> None:
    stream = garbage[0] + b"".join(
        encode(frame) + junk for frame, junk in zip(frames, garbage[1:], strict=False)
    )
    sizes = data.draw(st.lists(st.integers(1, 300), min_size=1, max_size=20))
    whole, pieces = new_sensor(), new_sensor()
    assert whole.frames(stream) == frames
    assert in_chunks(pieces, stream, sizes) == frames
    assert whole.stats == pieces.stats
    assert whole.stats.skipped_bytes == sum(map(len, garbage[: len(frames) + 1]))


# Bytes that favour headers, small lengths and counts, so that false starts get far.
TRICKY = st.lists(
    st.one_of(
        st.sampled_from([b"\x55", b"\x54\xf1", b"\x55\x00", b"\x55\x02\x10\x00", b"\x55\x06\x40\x00"]),
        st.binary(max_size=20),
        st.integers(0, 9).map(lambda count: bytes(count)),
        st.just(captured_bytes("node_frame3")),
    ),
    max_size=60,
).map(b"".join)


@given(TRICKY, st.lists(st.integers(1, 100), min_size=1, max_size=20))
@settings(deadline=None, max_examples=200)
def test_any_bytes_in_any_chunking_never_raise_and_give_the_same(stream: bytes, sizes: list[int]) -> None:
    whole, pieces = new_sensor(), new_sensor()
    assert whole.frames(stream) == in_chunks(pieces, stream, sizes)
    assert whole.stats == pieces.stats


def test_a_changed_bit_costs_one_frame_at_most() -> None:
    """Every bit of a stream of captured frames, one at a time."""
    kinds = ["node_frame3", "tag_frame0", "node_frame2", "node_frame3", "tag_frame0"]
    wires = [captured_bytes(kind) for kind in kinds]
    frames = [captured(kind) for kind in kinds]
    stream = b"".join(wires)
    owners = [index for index, wire in enumerate(wires) for _ in wire]
    for position, owner in enumerate(owners):
        for bit in range(8):
            damaged = bytearray(stream)
            damaged[position] ^= 1 << bit
            others = frames[:owner] + frames[owner + 1 :]
            assert new_sensor().frames(bytes(damaged) + FLUSH) == others, (position, bit)


@pytest.mark.parametrize(
    "flood",
    [
        b"\x55\x02\xff\xff" * 250_000,
        b"\x55\x02\x00\x10" * 250_000,
        b"\x55\x00" + b"\xff" * 1_000_000,
        b"\x55\x03\x08\x14" + b"\xff" * 1_000_000,  # Node_Frame1 with 255 tags, the longest of all
        b"\x55" * 1_000_000,
        random.Random(0).randbytes(1_000_000),
    ],
    ids=["cap", "long", "anchor", "longest", "header", "random"],
)
def test_memory_stays_bounded_and_the_next_frame_is_found(flood: bytes) -> None:
    sensor = new_sensor()
    good = captured_bytes("tag_frame0")
    for start in range(0, len(flood), 1000):
        sensor.frames(flood[start : start + 1000])
        assert len(sensor._buffer) < 8192
    frames = sensor.frames(good * 50)
    assert frames[-40:] == [captured("tag_frame0")] * 40


# Measurements


STAMP_NS = 5_000_000_000


def test_captured_tag_frame_gives_ranges_imu_and_attitude() -> None:
    ranges, imu, attitude = new_sensor().feed(captured_bytes("tag_frame0"), STAMP_NS)
    assert isinstance(ranges, RangeFrame)
    assert (ranges.stamp_ns, ranges.tag_id) == (STAMP_NS, 1)
    assert ranges.anchor_ids.dtype == np.int64
    assert ranges.anchor_ids.tolist() == [0, 1, 2, 3]  # 4 to 7 have no range yet
    assert ranges.ranges.tolist() == [3.125, 5.539, 6.861, 4.684]
    assert ranges.rx_power.shape == ranges.fp_power.shape == (4,)
    assert np.isnan(ranges.rx_power).all()
    assert np.isnan(ranges.fp_power).all()
    assert isinstance(imu, ImuSample)
    assert imu.stamp_ns == STAMP_NS
    assert imu.gyro == pytest.approx([0.0276699793, 0.00851383992, -0.0457618907], rel=1e-6)
    assert imu.accel == pytest.approx([0.251265019, 9.74908257, -0.0406810008], rel=1e-6)
    assert isinstance(attitude, Attitude)
    assert attitude.stamp_ns == STAMP_NS
    assert np.linalg.norm(attitude.quat_wxyz) == pytest.approx(1.0, abs=1e-12)
    sent = np.array([-0.656777024, -0.125699431, -0.739488602, 0.051280126])  # of norm 0.9983
    assert attitude.quat_wxyz == pytest.approx(sent / np.linalg.norm(sent), rel=1e-6)


def test_captured_node_frame2_gives_ranges_with_power_imu_and_attitude() -> None:
    found = new_sensor().feed(captured_bytes("node_frame2"), STAMP_NS)
    assert [type(m) for m in found] == [RangeFrame, ImuSample, Attitude]
    ranges = found[0]
    assert isinstance(ranges, RangeFrame)
    assert ranges.tag_id == 1
    assert ranges.anchor_ids.tolist() == [0, 1, 2, 3]
    assert ranges.ranges.tolist() == [3.179, 5.548, 6.728, 4.651]
    assert ranges.fp_power.tolist() == [-88.5, -90.0, -101.0, -99.0]
    assert ranges.rx_power.tolist() == [-79.5, -80.5, -79.5, -80.0]


def test_captured_node_frame3_gives_ranges_alone() -> None:
    (ranges,) = new_sensor().feed(captured_bytes("node_frame3"), STAMP_NS)
    assert isinstance(ranges, RangeFrame)
    assert ranges.ranges.tolist() == [2.85, 6.051, 7.304, 5.35]


def test_simulated_frames_give_ranges_alone() -> None:
    stream, _ = listed_frames("sitl_stream")
    found = new_sensor().feed(stream, STAMP_NS)
    assert len(found) == 100
    for ranges in found:
        assert isinstance(ranges, RangeFrame)
        assert ranges.anchor_ids.tolist() == [0, 1, 2, 3]


def test_latency_is_taken_off_every_stamp() -> None:
    found = new_sensor(latency_ms=12.5).feed(captured_bytes("tag_frame0"), STAMP_NS)
    assert [m.stamp_ns for m in found] == [STAMP_NS - 12_500_000] * 3


@pytest.mark.parametrize("kind", ["node_frame2", "node_frame3"])
def test_void_and_non_positive_ranges_are_left_out(kind: str) -> None:
    nodes = (
        NodeRange(1, 255, 2.0, -80.0, -70.0),
        NodeRange(1, 7, 0.0, -80.0, -70.0),
        NodeRange(1, 8, -0.001, -80.0, -70.0),
        NodeRange(0, 9, 0.001, -81.0, -71.0),
        NodeRange(200, 3, 4.0, -82.0, -72.0),
    )
    ranges = measurements(altered(kind, nodes=nodes), 0)[0]
    assert isinstance(ranges, RangeFrame)
    assert ranges.anchor_ids.tolist() == [9, 3]
    assert ranges.ranges.tolist() == [0.001, 4.0]
    assert ranges.fp_power.tolist() == [-81.0, -82.0]
    assert ranges.rx_power.tolist() == [-71.0, -72.0]
    nothing = altered(kind, nodes=nodes[:3])
    assert not any(isinstance(m, RangeFrame) for m in measurements(nothing, 0))


def test_a_tag_frame_without_ranges_gives_no_range_frame() -> None:
    frame = altered("tag_frame0", dis=(0.0, -1.0, *(0.0,) * 6))
    assert [type(m) for m in measurements(frame, 0)] == [ImuSample, Attitude]


@pytest.mark.parametrize("kind", ["tag_frame0", "node_frame2"])
@pytest.mark.parametrize(
    ("changes", "kept"),
    [
        ({"gyro": (0.0, math.nan, 0.0)}, [RangeFrame, Attitude]),
        ({"acc": (math.inf, 0.0, 9.8)}, [RangeFrame, Attitude]),
        ({"gyro": (0.0,) * 3, "acc": (0.0,) * 3}, [RangeFrame, Attitude]),
        ({"gyro": (0.0,) * 3, "acc": (0.0, 0.0, 9.8)}, [RangeFrame, ImuSample, Attitude]),
        ({"quat_wxyz": (math.nan, 0.0, 0.0, 0.0)}, [RangeFrame, ImuSample]),
        ({"quat_wxyz": (math.inf, math.nan, 0.0, 0.0)}, [RangeFrame, ImuSample]),
        ({"quat_wxyz": (0.0,) * 4}, [RangeFrame, ImuSample]),
        ({"quat_wxyz": (0.98, 0.0, 0.0, 0.0)}, [RangeFrame, ImuSample]),
        ({"quat_wxyz": (3e38,) * 4}, [RangeFrame, ImuSample]),
        ({"quat_wxyz": (0.0, 0.0, -0.995, 0.0)}, [RangeFrame, ImuSample, Attitude]),
    ],
)
def test_void_inertial_fields_give_no_measurement(
    kind: str, changes: dict[str, Any], kept: list[type[Any]]
) -> None:
    wire = encode(altered(kind, **changes))
    assert [type(m) for m in new_sensor().feed(wire, 0)] == kept


# The Sensor interface


def test_the_sensor_table_builds_it_and_it_has_nothing_to_say() -> None:
    sensor = make_sensor("linktrack", sensor_config_class("linktrack")())
    assert isinstance(sensor, LinkTrack)
    sensor.connected(0)
    assert sensor.poll(10**12) == sensor.closing() == b""
    assert len(sensor.feed(captured_bytes("node_frame3"), 0)) == 1


@pytest.mark.parametrize("bad", [{"latency_ms": -1}, {"latency_ms": 1001}, {"latency": 5}])
def test_config_refuses_what_makes_no_sense(bad: dict[str, float]) -> None:
    with pytest.raises(ValidationError, match=next(iter(bad))):
        LinkTrack.Config.model_validate(bad)
