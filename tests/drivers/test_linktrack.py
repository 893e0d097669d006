"""What LinkTrack frames measure, when, and for which tag."""

import logging
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from drivers import make_sensor, sensor_config_class
from drivers.linktrack import LinkTrack, measurements
from drivers.linktrack_frames import encode
from drivers.linktrack_types import (
    AnchorFrame0,
    AnchorRange,
    AoaNodeFrame0,
    AoaNodeRange,
    ErrorFrame0,
    Frame,
    NodeFrame0,
    NodeFrame1,
    NodeFrame3,
    NodeFrame4,
    NodeFrame5,
    NodeFrame6,
    NodeRange,
    SettingFrame0,
    SystemFrame0,
    TagBlock,
    TagRanges,
    UserFrame1,
)
from estimators.messages import Attitude, ImuSample, Measurement, RangeFrame
from tests.drivers.test_linktrack_frames import (
    AOA_NODE_FRAME0,
    FRAMES,
    FRAMES_BY_TYPE,
    NODE_FRAME2,
    NODE_FRAME3,
    TAG_FRAME0,
    altered,
)
from tests.vectors import load, stems, stream

MS = 1_000_000
STAMP_NS = 5_000 * MS


def new_sensor(**config: Any) -> LinkTrack:
    return LinkTrack(LinkTrack.Config(**config))


def ranges_of(found: list[Measurement]) -> list[RangeFrame]:
    return [m for m in found if isinstance(m, RangeFrame)]


def rows(found: list[Measurement]) -> list[tuple[int, list[int], list[float]]]:
    """Tag, anchors and distances of all range frames."""
    return [(m.tag_id, m.anchor_ids.tolist(), m.ranges.tolist()) for m in ranges_of(found)]


# A tag's own frames


def test_captured_tag_frame_gives_ranges_imu_and_attitude() -> None:
    ranges, imu, attitude = new_sensor().feed(TAG_FRAME0, STAMP_NS)
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
    found = new_sensor().feed(NODE_FRAME2, STAMP_NS)
    assert [type(m) for m in found] == [RangeFrame, ImuSample, Attitude]
    ranges = found[0]
    assert isinstance(ranges, RangeFrame)
    assert ranges.tag_id == 1
    assert ranges.anchor_ids.dtype == np.int64
    assert ranges.anchor_ids.tolist() == [0, 1, 2, 3]
    assert ranges.ranges.tolist() == [3.179, 5.548, 6.728, 4.651]
    assert ranges.fp_power.tolist() == [-88.5, -90.0, -101.0, -99.0]
    assert ranges.rx_power.tolist() == [-79.5, -80.5, -79.5, -80.0]


def test_captured_node_frame3_gives_ranges_alone() -> None:
    assert rows(new_sensor().feed(NODE_FRAME3, STAMP_NS)) == [(1, [0, 1, 2, 3], [2.85, 6.051, 7.304, 5.35])]


def test_captured_bearings_give_their_ranges_with_power() -> None:
    (ranges,) = ranges_of(new_sensor().feed(AOA_NODE_FRAME0, STAMP_NS))
    assert (ranges.tag_id, ranges.anchor_ids.tolist()) == (0, [0, 1, 2, 3])
    assert ranges.ranges.tolist() == [0.767, 0.770, 1.004, 1.416]
    assert ranges.fp_power.tolist() == [-81.5, -82.0, -82.5, -81.5]
    assert ranges.rx_power.tolist() == [-79.5, -79.5, -80.0, -80.0]


@pytest.mark.parametrize("stem", stems("linktrack_sitl_stream"))
def test_simulated_frames_give_ranges_alone(stem: str) -> None:
    found = new_sensor().feed(stream(stem), STAMP_NS)
    assert len(found) == load(stem)["frames_required"]
    for ranges in found:
        assert isinstance(ranges, RangeFrame)
        assert ranges.stamp_ns == STAMP_NS  # its clock stands still
        assert ranges.anchor_ids.tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("wire", [NODE_FRAME2, NODE_FRAME3], ids=["2", "3"])
def test_void_and_non_positive_ranges_are_left_out(wire: bytes) -> None:
    nodes = (
        NodeRange(1, 255, 2.0, -80.0, -70.0),
        NodeRange(1, 7, 0.0, -80.0, -70.0),
        NodeRange(1, 8, -0.001, -80.0, -70.0),
        NodeRange(0, 9, 0.001, -81.0, -71.0),
        NodeRange(200, 3, 4.0, -82.0, -72.0),
    )
    ranges = ranges_of(measurements(altered(wire, nodes=nodes), 0))[0]
    assert ranges.anchor_ids.tolist() == [9, 3]
    assert ranges.ranges.tolist() == [0.001, 4.0]
    assert ranges.fp_power.tolist() == [-81.0, -82.0]
    assert ranges.rx_power.tolist() == [-71.0, -72.0]
    assert rows(measurements(altered(wire, nodes=nodes[:3]), 0)) == []


def test_a_tag_frame_without_ranges_gives_no_range_frame() -> None:
    frame = altered(TAG_FRAME0, dis=(0.0, -1.0, *(0.0,) * 6))
    assert [type(m) for m in measurements(frame, 0)] == [ImuSample, Attitude]


def test_255_is_an_id_like_any_other_where_ids_have_32_bits() -> None:
    nodes = (NodeRange(7, 255, 2.0, -80.0, -70.0), NodeRange(7, 2**32 - 1, 3.0, -80.0, -70.0))
    frame = NodeFrame5(4_000_000_000, 200, 0, 0, 5.0, (*nodes, NodeRange(7, 5, 0.0, -80.0, -70.0)))
    assert rows(measurements(frame, 0)) == [(4_000_000_000, [255, 2**32 - 1], [2.0, 3.0])]


@pytest.mark.parametrize("wire", [TAG_FRAME0, NODE_FRAME2], ids=["tag", "2"])
@pytest.mark.parametrize(
    ("changes", "kept"),
    [
        ({"gyro": (0.0, math.nan, 0.0)}, [RangeFrame, Attitude]),
        ({"acc": (math.inf, 0.0, 9.8)}, [RangeFrame, Attitude]),
        ({"acc": (math.inf, -math.inf, 9.8)}, [RangeFrame, Attitude]),
        ({"gyro": (3e38,) * 3, "acc": (3e38,) * 3}, [RangeFrame, ImuSample, Attitude]),
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
    wire: bytes, changes: dict[str, Any], kept: list[type[Any]]
) -> None:
    found = new_sensor().feed(encode(altered(wire, **changes)), 0)
    assert [type(m) for m in found] == kept


# What anchors and consoles hear


@pytest.mark.parametrize("role", [1, 3])
def test_tags_that_an_anchor_or_a_console_hears_have_the_ranges(role: int) -> None:
    nodes = (
        NodeRange(2, 30, 3.0, -83.0, -73.0),
        NodeRange(2, 255, 9.0, -80.0, -70.0),
        NodeRange(2, 31, 0.0, -80.0, -70.0),
        NodeRange(2, 32, 4.0, -84.0, -74.0),
    )
    found = measurements(NodeFrame3(8, role, 0, 0, 5.0, nodes), STAMP_NS)
    assert rows(found) == [(30, [8], [3.0]), (32, [8], [4.0])]
    assert [m.stamp_ns for m in found] == [STAMP_NS] * 2
    assert [(m.fp_power.tolist(), m.rx_power.tolist()) for m in ranges_of(found)] == [
        ([-83.0], [-73.0]),
        ([-84.0], [-74.0]),
    ]
    bearing = AoaNodeRange(2, 30, 3.0, 12.5, -83.0, -73.0)
    assert rows(measurements(AoaNodeFrame0(8, role, 0, 0, 5.0, (bearing,)), 0)) == [(30, [8], [3.0])]
    wide = NodeFrame5(70_000, role, 0, 0, 5.0, (NodeRange(2, 255, 3.0, -83.0, -73.0),))
    assert rows(measurements(wide, 0)) == [(255, [70_000], [3.0])]


@pytest.mark.parametrize("role", [0, 2, 4, 77])
def test_all_ranges_of_other_senders_are_their_own(role: int) -> None:
    nodes = (NodeRange(2, 30, 3.0, -83.0, -73.0), NodeRange(1, 31, 4.0, -83.0, -73.0))
    assert rows(measurements(NodeFrame3(8, role, 0, 0, 5.0, nodes), 0)) == [(8, [30, 31], [3.0, 4.0])]


def test_an_anchors_ranges_to_others_than_tags_are_its_own() -> None:
    nodes = (
        NodeRange(1, 30, 3.0, -83.0, -73.0),
        NodeRange(2, 31, 4.0, -83.0, -73.0),
        NodeRange(9, 32, 5.0, -83.0, -73.0),
    )
    found = rows(measurements(NodeFrame3(8, 1, 0, 0, 5.0, nodes), 0))
    assert sorted(found) == [(8, [30, 32], [3.0, 5.0]), (31, [8], [4.0])]


def test_a_console_gives_a_range_frame_for_each_tag() -> None:
    tags = (
        TagRanges(
            5, 3.7, (AnchorRange(0, 1.5), AnchorRange(255, 2.0), AnchorRange(9, 0.0), AnchorRange(3, 2.5))
        ),
        TagRanges(6, 3.7, ()),
        TagRanges(255, 3.7, (AnchorRange(0, 1.5),)),
        TagRanges(7, 3.7, (AnchorRange(1, 8.0),)),
    )
    found = measurements(NodeFrame4(9, 3, 0, 0, 5.0, tags), STAMP_NS)
    assert rows(found) == [(5, [0, 3], [1.5, 2.5]), (7, [1], [8.0])]
    assert [m.stamp_ns for m in found] == [STAMP_NS] * 2
    for ranges in ranges_of(found):
        assert np.isnan([ranges.rx_power, ranges.fp_power]).all()
        assert ranges.rx_power.shape == ranges.fp_power.shape == ranges.ranges.shape


def test_anchor_frame0_gives_a_range_frame_for_each_tag() -> None:
    tags = (
        TagBlock(2, 5, (1.0, 1.0, 1.0), (0.0, 1.5, 0.0, 0.0, 0.0, 0.0, 0.0, 2.5)),
        TagBlock(2, 6, (1.0, 1.0, 1.0), (0.0,) * 8),
    )
    found = measurements(AnchorFrame0(9, 3, 0, 0, 5.0, tags), STAMP_NS)
    assert rows(found) == [(5, [1, 7], [1.5, 2.5])]
    assert found[0].stamp_ns == STAMP_NS


WITHOUT_RANGES = (NodeFrame0, NodeFrame1, NodeFrame6, SettingFrame0, UserFrame1, ErrorFrame0, SystemFrame0)


@pytest.mark.parametrize("kind", WITHOUT_RANGES)
@given(data=st.data())
def test_frames_without_ranges_measure_nothing(kind: type[Frame], data: st.DataObject) -> None:
    wire = encode(data.draw(FRAMES_BY_TYPE[kind]))
    sensor = new_sensor()
    assert sensor.feed(wire, 0) == []
    assert sensor.stats.good == 1


@given(FRAMES)
def test_no_measurement_holds_what_an_estimator_could_not_use(frame: Frame) -> None:
    for m in new_sensor().feed(encode(frame), STAMP_NS):
        assert m.stamp_ns == STAMP_NS
        if isinstance(m, RangeFrame):
            assert len(m.ranges) == len(m.anchor_ids) == len(m.rx_power) == len(m.fp_power) > 0
            assert (m.ranges > 0).all()
            assert m.anchor_ids.dtype == np.int64
        elif isinstance(m, ImuSample):
            assert np.isfinite([m.gyro, m.accel]).all()
        else:
            assert isinstance(m, Attitude)
            assert np.linalg.norm(m.quat_wxyz) == pytest.approx(1.0, abs=1e-12)


# Which tag


CONSOLE = encode(
    NodeFrame4(9, 3, 0, 0, 5.0, tuple(TagRanges(k, 3.7, (AnchorRange(0, 1.0 + k),)) for k in (4, 5, 6)))
)


def test_only_ranges_of_the_set_tag_are_given_out(caplog: pytest.LogCaptureFixture) -> None:
    assert rows(new_sensor(tag_id=5).feed(CONSOLE, 0)) == [(5, [0], [6.0])]
    assert new_sensor(tag_id=7).feed(CONSOLE, 0) == []
    assert new_sensor(tag_id=0).feed(CONSOLE, 0) == []
    assert [type(m) for m in new_sensor(tag_id=7).feed(NODE_FRAME2, 0)] == [ImuSample, Attitude]
    assert caplog.records == []


def test_a_second_tag_is_warned_of_once_when_none_is_set(caplog: pytest.LogCaptureFixture) -> None:
    sensor = new_sensor()
    for _ in range(2):
        assert [tag for tag, *_ in rows(sensor.feed(CONSOLE, 0))] == [4, 5, 6]
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert "tags 4, 5, 6" in record.message
    assert "set tag_id" in record.message


def test_one_tag_is_nothing_to_warn_of_before_there_is_a_second(caplog: pytest.LogCaptureFixture) -> None:
    sensor = new_sensor()
    sensor.feed(NODE_FRAME2 + TAG_FRAME0 + NODE_FRAME3, 0)
    sensor.feed(NODE_FRAME3, 0)
    assert caplog.records == []
    sensor.feed(AOA_NODE_FRAME0, 0)
    assert len(caplog.records) == 1


# When


def timed(local_ms: int) -> bytes:
    return encode(altered(NODE_FRAME2, local_time_ms=local_ms % 2**32))


def stamps(sensor: LinkTrack, arrivals: list[tuple[bytes, int]]) -> list[int]:
    found = []
    for wire, arrival_ms in arrivals:
        made = sensor.feed(wire, arrival_ms * MS)
        assert len({m.stamp_ns for m in made}) == 1
        found.append(made[0].stamp_ns // MS)
    return found


@pytest.mark.parametrize("first_ms", [0, 2**32 - 30], ids=["", "wrap"])
def test_frames_that_come_late_are_stamped_by_the_modules_clock(first_ms: int) -> None:
    delays_ms = [0, 0, 9, 0, 15]
    arrivals = [(timed(first_ms + 20 * k), 1000 + 20 * k + delay) for k, delay in enumerate(delays_ms)]
    assert stamps(new_sensor(), arrivals) == [1000, 1020, 1040, 1060, 1080]


def test_all_types_that_measure_share_the_modules_clock() -> None:
    sensor = new_sensor()
    sensor.feed(timed(0) + timed(20), 1000 * MS)
    late = encode(altered(NODE_FRAME3, local_time_ms=40))
    assert stamps(sensor, [(timed(30), 1010), (late, 1029)]) == [1010, 1020]


def test_latency_is_taken_off_every_stamp() -> None:
    found = new_sensor(latency_ms=12.5).feed(TAG_FRAME0, STAMP_NS)
    assert [m.stamp_ns for m in found] == [STAMP_NS - 12_500_000] * 3


def test_bad_frames_and_frames_without_ranges_change_no_stamp() -> None:
    """Their clock readings are far off: to believe one would show."""
    arrivals = [(timed(20 * k), 1000 + 20 * k + delay) for k, delay in enumerate([0, 0, 9, 4])]
    damaged = bytearray(timed(3_000_000))
    damaged[-1] ^= 1
    positions = encode(NodeFrame1(1, 3, 2_000_000, 0, 5.0, ()))
    disturbed = [(bytes(damaged) + positions + wire + positions, at) for wire, at in arrivals]
    assert stamps(new_sensor(), disturbed) == stamps(new_sensor(), arrivals) == [1000, 1020, 1040, 1060]


# The Sensor interface


def test_the_sensor_table_builds_it_and_it_has_nothing_to_say() -> None:
    sensor = make_sensor("linktrack", sensor_config_class("linktrack")())
    assert isinstance(sensor, LinkTrack)
    sensor.connected(0)
    assert sensor.poll(10**12) == b"".join(sensor.closing()) == b""
    assert len(sensor.feed(NODE_FRAME3, 0)) == 1


@pytest.mark.parametrize(
    "bad", [{"latency_ms": -1}, {"latency_ms": 1001}, {"tag_id": -1}, {"tag_id": 2**32}, {"latency": 5}]
)
def test_config_refuses_what_makes_no_sense(bad: dict[str, float]) -> None:
    with pytest.raises(ValidationError, match=next(iter(bad))):
        LinkTrack.Config.model_validate(bad)
