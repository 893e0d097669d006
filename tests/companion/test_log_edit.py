"""Faults put into logs: what they change, and above all what they leave alone."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from companion.config import Config
from companion.errors import UserError
from companion.evaluation import evaluate_scenario
from companion.log import Direction, Log, RawChunk, Truth
from companion.log_edit.edit import edit_log, edit_records, write_log
from companion.log_edit.faults import KINDS, library, parse_fault
from companion.log_edit.ranges import Changed, change_ranges
from companion.raw_scans import ScanEncoder
from companion.replay import config_of, replay
from companion.shipped_files import params_dir
from drivers.linktrack import LinkTrack, measurements
from drivers.linktrack_frames import encode
from drivers.linktrack_types import (
    AnchorFrame0,
    AnchorRange,
    AoaNodeFrame0,
    AoaNodeRange,
    Frame,
    NodeFrame3,
    NodeFrame4,
    NodeFrame5,
    NodeRange,
    Role,
    TagBlock,
    TagFrame0,
    TagRanges,
)
from drivers.rplidar import Rplidar
from estimators.geometry import transform, wrap_angle
from estimators.messages import Attitude, FloatArray, ImuSample, Measurement, RangeFrame, Scan
from tests.companion.test_evaluation import FEW
from tests.conftest import Command, write_scenario

Record = RawChunk | Truth
AT, END = 4.0, 7.0


@pytest.fixture(scope="module")
def log(short_log: Path) -> Log:
    return Log(short_log)


@pytest.fixture(scope="module")
def records(log: Log) -> list[Record]:
    return list(log)


def edited(records: Sequence[Record], log: Log, *faults: str) -> list[Record]:
    config = config_of(log, [])
    parsed = [parse_fault(fault, config) for fault in faults]
    return edit_records(records, config, log.start_ns, parsed, np.random.default_rng(1))


def seconds(log: Log, stamp_ns: int) -> float:
    return (stamp_ns - log.start_ns) * 1e-9


def measured(records: Sequence[Record], log: Log, source: str) -> list[Measurement]:
    config = config_of(log, [])
    sensor = LinkTrack(LinkTrack.Config()) if source == "uwb" else Rplidar(Rplidar.Config())
    assert source in config.sensor
    return [
        m
        for r in records
        if isinstance(r, RawChunk) and r.source == source and r.direction is Direction.IN
        for m in sensor.feed(r.data, r.stamp_ns)
    ]


def range_frames(records: Sequence[Record], log: Log) -> list[RangeFrame]:
    return [m for m in measured(records, log, "uwb") if isinstance(m, RangeFrame)]


def scans(records: Sequence[Record], log: Log) -> list[Scan]:
    return [m for m in measured(records, log, "lidar") if isinstance(m, Scan)]


def chunks(records: Sequence[Record], source: str) -> list[RawChunk]:
    return [r for r in records if isinstance(r, RawChunk) and r.source == source]


def test_a_fault_that_never_begins_changes_no_byte_of_the_frames(log: Log, records: list[Record]) -> None:
    kept = edited(records, log, "nlos:at=1e6", "silent:sensor=lidar,at=1e6")
    assert b"".join(r.data for r in chunks(kept, "uwb")) == b"".join(r.data for r in chunks(records, "uwb"))
    assert chunks(kept, "lidar") == chunks(records, "lidar")
    assert sum(isinstance(r, Truth) for r in kept) == sum(isinstance(r, Truth) for r in records)


def test_scans_written_again_are_the_scans_that_were_there(log: Log, records: list[Record]) -> None:
    before, after = scans(records, log), scans(edited(records, log, "blocked:at=1e6"), log)
    assert len(after) >= len(before) - 1 > 50
    for old, new in zip(before, after, strict=False):
        # Packets are stamped to the microsecond; the decoder's clock takes the earliest arrivals.
        assert new.stamp_ns == pytest.approx(old.stamp_ns, abs=300_000)
        assert new.ranges.tobytes() == old.ranges.tobytes()
        assert new.angles == pytest.approx(old.angles, abs=1e-4)
        assert new.beam_times == pytest.approx(old.beam_times, abs=300e-6)


@given(
    st.lists(st.integers(40, 300), min_size=1, max_size=6),
    st.integers(20_000, 300_000),
    st.sampled_from([1, 3, 200]),
    st.integers(0, 2**32),
)
@example([288, 96], 20_000, 200, 0)  # whole packets: nothing waits when the stream ends
@settings(max_examples=25)
def test_any_scans_are_written_so_that_the_driver_reads_them(
    counts: list[int], sample_ns: int, pause: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    encoder, sensor = ScanEncoder(), Rplidar(Rplidar.Config())
    written: list[Scan] = []
    packets: list[tuple[int, bytes]] = []
    stamp_ns = 5_000_000_000
    for count in counts:
        angles = np.linspace(3.0, -3.0, count)
        ranges = rng.integers(800, 120_000, count) / 4000
        times: FloatArray = np.arange(count, dtype=np.float64) * (sample_ns * 1e-9)
        written.append(Scan(stamp_ns, angles, ranges, times, np.full(count, 10.0)))
        packets += encoder.add(written[-1])
        stamp_ns = written[-1].end_stamp_ns + pause * sample_ns
    packets += encoder.flush()
    read = [m for at_ns, data in packets for m in sensor.feed(data, at_ns) if isinstance(m, Scan)]
    assert len(read) == len(written)
    for old, new in zip(written, read, strict=True):
        assert new.ranges == pytest.approx(old.ranges, abs=1e-9)
        assert new.angles == pytest.approx(old.angles, abs=1e-4)
        if pause != 3:  # the device's clock has no room for beams that come irregularly
            assert new.stamp_ns == pytest.approx(old.stamp_ns, abs=sample_ns // 2 + 4 * len(old.angles))


def test_a_silent_sensor_sends_nothing_for_a_while(log: Log, records: list[Record]) -> None:
    found = edited(records, log, f"silent:sensor=uwb,at={AT},for={END - AT}")
    gone = {r.stamp_ns for r in chunks(records, "uwb")} - {r.stamp_ns for r in chunks(found, "uwb")}
    assert gone
    assert all(AT <= seconds(log, stamp_ns) < END for stamp_ns in gone)
    assert not any(AT <= seconds(log, r.stamp_ns) < END for r in chunks(found, "uwb"))
    assert chunks(found, "lidar") == chunks(records, "lidar")


def test_late_bytes_keep_their_order(log: Log, records: list[Record]) -> None:
    found = edited(records, log, f"late:sensor=uwb,by=0.3,at={AT},for={END - AT}")
    before, after = chunks(records, "uwb"), chunks(found, "uwb")
    assert [r.data for r in after] == [r.data for r in before]
    late = [a.stamp_ns - b.stamp_ns for a, b in zip(after, before, strict=True)]
    assert max(late) == 300_000_000
    assert min(late) == 0
    stamps = [r.stamp_ns for r in found]
    assert stamps == sorted(stamps)


def test_a_dead_anchor_has_no_ranges_and_the_others_keep_theirs(log: Log, records: list[Record]) -> None:
    before, after = (
        range_frames(records, log),
        range_frames(edited(records, log, f"drop:anchor=3,at={AT}"), log),
    )
    for old, new in zip(before, after, strict=True):
        keep = old.anchor_ids != 3 if seconds(log, old.stamp_ns) > AT + 0.1 else slice(None)
        if seconds(log, old.stamp_ns) > AT + 0.1 or seconds(log, old.stamp_ns) < AT - 0.1:
            assert new.anchor_ids.tolist() == old.anchor_ids[keep].tolist()
            assert new.ranges.tolist() == old.ranges[keep].tolist()


def test_blocked_ranges_are_longer_and_weaker_by_at_least_what_was_asked(
    log: Log, records: list[Record]
) -> None:
    found = edited(records, log, f"nlos:anchor=2,least=0.4,mean=0.1,at={AT},for={END - AT}")
    for old, new in zip(range_frames(records, log), range_frames(found, log), strict=True):
        hit = (old.anchor_ids == 2) & (AT + 0.1 < seconds(log, old.stamp_ns) < END - 0.1)
        longer = new.ranges - old.ranges
        assert np.all(longer[hit] >= 0.4 - 1e-3)
        assert np.all((new.rx_power - new.fp_power)[hit] > (old.rx_power - old.fp_power)[hit] + 5.0)
        outside = (old.anchor_ids != 2) | (seconds(log, old.stamp_ns) > END + 0.1)
        assert np.all(longer[outside] == 0.0)


def test_spikes_hit_the_share_of_ranges_that_was_asked_for(log: Log, records: list[Record]) -> None:
    pairs = zip(
        range_frames(records, log),
        range_frames(edited(records, log, "spike:size=5,share=0.25"), log),
        strict=True,
    )
    changes = np.concatenate([new.ranges - old.ranges for old, new in pairs])
    assert np.mean(changes != 0.0) == pytest.approx(0.25, abs=0.05)
    assert np.std(changes[changes != 0.0]) > 2.0


def test_a_moved_anchor_measures_from_where_it_stands_now(log: Log, records: list[Record]) -> None:
    found = edited(records, log, "moved:anchor=0,x=1.5,y=-0.5,z=0.2")
    config = config_of(log, [])
    truths = {r.stamp_ns: r.pose for r in records if isinstance(r, Truth)}
    for old, new in zip(range_frames(records, log), range_frames(found, log), strict=True):
        pose = truths[min(truths, key=lambda stamp_ns: abs(stamp_ns - old.stamp_ns))]
        tag = tag_of(pose, config)
        anchor = np.array(config.anchors[0])
        longer = np.linalg.norm(anchor + np.array([1.5, -0.5, 0.2]) - tag) - np.linalg.norm(anchor - tag)
        hit = old.anchor_ids == 0
        assert (new.ranges - old.ranges)[hit] == pytest.approx(longer, abs=0.02)
        assert np.all((new.ranges - old.ranges)[~hit] == 0.0)


def tag_of(pose: FloatArray, config: Config) -> FloatArray:
    x, y = transform(pose, np.array([config.body.tag[:2]]))[0]
    return np.array([x, y, config.body.height + config.body.tag[2]])


def test_without_truth_no_anchor_can_be_moved(log: Log, records: list[Record]) -> None:
    bare = [r for r in records if isinstance(r, RawChunk)]
    with pytest.raises(UserError, match="the log has no truth with heading"):
        edited(bare, log, "moved:anchor=0,x=1")


def test_a_clock_that_jumps_leaves_ranges_and_arrivals_alone(log: Log, records: list[Record]) -> None:
    found = edited(records, log, f"clock:by=-1.5,at={AT}")
    decoder, again = LinkTrack(LinkTrack.Config()), LinkTrack(LinkTrack.Config())
    jumps = set()
    for old_chunk, new_chunk in zip(chunks(records, "uwb"), chunks(found, "uwb"), strict=True):
        assert new_chunk.stamp_ns == old_chunk.stamp_ns
        for old, new in zip(decoder.frames(old_chunk.data), again.frames(new_chunk.data), strict=True):
            difference = (getattr(new, "local_time_ms", 0) - getattr(old, "local_time_ms", 0) + 2**31) % 2**32
            jumps.add((seconds(log, old_chunk.stamp_ns) >= AT, difference - 2**31))
    assert jumps == {(False, 0), (True, -1500)}


def test_a_turned_tag_feels_the_same_in_other_axes(log: Log, records: list[Record]) -> None:
    before = measured(records, log, "uwb")
    after = measured(edited(records, log, "rotated:yaw_deg=90"), log, "uwb")
    for old, new in zip(before, after, strict=True):
        if isinstance(old, ImuSample) and isinstance(new, ImuSample):
            # Turned to the left by 90 deg: what was ahead is now at its right.
            assert new.accel == pytest.approx([old.accel[1], -old.accel[0], old.accel[2]], abs=1e-5)
            assert new.gyro == pytest.approx([old.gyro[1], -old.gyro[0], old.gyro[2]], abs=1e-5)
        if isinstance(old, Attitude) and isinstance(new, Attitude):
            assert wrap_angle(yaw_of(new) - yaw_of(old)) == pytest.approx(np.pi / 2, abs=1e-5)


def yaw_of(attitude: Attitude) -> float:
    w, x, y, z = attitude.quat_wxyz
    return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def test_a_blocked_sector_hides_what_is_in_it_and_nothing_else(log: Log, records: list[Record]) -> None:
    found = edited(records, log, "blocked:from_deg=150,to_deg=-150,distance=0.5")
    for old, new in zip(scans(records, log), scans(found, log), strict=False):
        behind = np.abs(old.angles) > np.deg2rad(150.1)
        ahead = np.abs(old.angles) < np.deg2rad(149.9)
        assert np.all(new.ranges[behind] == 0.5)
        assert np.all(new.ranges[ahead] == old.ranges[ahead])


def test_of_lost_beams_the_rest_stays(log: Log, records: list[Record]) -> None:
    for old, new in zip(
        scans(records, log), scans(edited(records, log, "gone:share=0.5"), log), strict=False
    ):
        assert np.mean(new.ranges[old.ranges > 0] == 0.0) == pytest.approx(0.5, abs=0.05)
        assert np.all((new.ranges == old.ranges) | (new.ranges == 0.0))


SENDER = {"id": 1, "role": 2, "local_time_ms": 5, "system_time_ms": 5, "voltage": 5.0}
NODES = (NodeRange(1, 0, 2.0, -80.0, -79.0), NodeRange(1, 5, 3.0, -80.0, -79.0))
STATE = {
    **SENDER,
    **dict.fromkeys(("pos", "vel", "eop", "gyro", "acc", "angle_deg"), (0.0, 0.0, 0.0)),
    "quat_wxyz": (1.0, 0.0, 0.0, 0.0),
}
DISTANCES = (2.0, 0.0, 0.0, 0.0, 0.0, 3.0, 0.0, 0.0)
FRAMES: list[Frame] = [
    NodeFrame3(**SENDER, nodes=NODES),  # type: ignore[arg-type]
    NodeFrame5(**SENDER, nodes=NODES),  # type: ignore[arg-type]
    AoaNodeFrame0(**SENDER, nodes=tuple(AoaNodeRange(*n[:3], 0.0, *n[3:]) for n in NODES)),  # type: ignore[arg-type]
    NodeFrame4(**SENDER, tags=(TagRanges(1, 5.0, (AnchorRange(0, 2.0), AnchorRange(5, 3.0))),)),  # type: ignore[arg-type]
    TagFrame0(**STATE, dis=DISTANCES),  # type: ignore[arg-type]
    AnchorFrame0(**{**SENDER, "role": 3}, nodes=(TagBlock(Role.TAG, 1, (0.0, 0.0, 0.0), DISTANCES),)),  # type: ignore[arg-type]
]


@pytest.mark.parametrize("frame", FRAMES, ids=lambda frame: type(frame).__name__)
def test_ranges_of_every_frame_type_can_be_changed_and_dropped(frame: Frame) -> None:
    changed = change_ranges(frame, lambda anchor, dis: None if anchor == 0 else Changed(dis + 0.5))
    (found,) = LinkTrack(LinkTrack.Config()).frames(encode(changed))
    ranges = [m for m in measurements(found, 1) if isinstance(m, RangeFrame)]
    assert [r.anchor_ids.tolist() for r in ranges] == [[5]]
    assert ranges[0].ranges == pytest.approx([3.5])


def test_a_range_never_becomes_negative_or_void(log: Log) -> None:
    changed = change_ranges(FRAMES[0], lambda _, dis: Changed(dis - 100.0, 200.0, 200.0))
    (found,) = LinkTrack(LinkTrack.Config()).frames(encode(changed))
    (ranges,) = [m for m in measurements(found, 1) if isinstance(m, RangeFrame)]
    assert ranges.ranges.tolist() == [0.001, 0.001]
    assert ranges.rx_power.tolist() == [-127.5, -127.5]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("flood", r"--fault flood: unknown kind 'flood', there are: silent, late, drop"),
        ("drop:anchor=9", r"anchor=9: the site has no such anchor, there are: 0, 1, 2, 3"),
        ("silent:sensor=radar", r"sensor=radar: the site has no such sensor, there are: uwb, lidar"),
        ("drop:at=5", r"anchor: this key is required and missing"),
        ("drop:anchor=1,when=5", r"when: unknown key"),
        ("drop:anchor=1,at", r"'at' is no key=value"),
        ("spike:share=1.5", r"share: Input should be less than or equal to 1, got '1.5'"),
        ("nlos:at=-1", r"at: Input should be greater than or equal to 0"),
        ("nlos:for=0", r"for: Input should be greater than 0"),
    ],
)
def test_a_wrong_fault_is_named(config: Config, text: str, said: str) -> None:
    with pytest.raises(UserError, match=said):
        parse_fault(text, config)


def test_the_library_has_a_fault_of_every_kind_and_all_of_them_are_valid(config: Config) -> None:
    texts = library(config)
    assert {text.partition(":")[0] for text in texts} == set(KINDS)
    for text in texts:
        assert parse_fault(text, config).active(16.0) or "for=0.25" in text


def test_every_fault_of_the_library_is_survived(log: Log, records: list[Record], tmp_path: Path) -> None:
    """One log with all of them in turn: no exception, no pose that is not finite."""
    config = config_of(log, [])
    for i, text in enumerate(library(config)):
        fault = parse_fault(text.replace("at=15", f"at={2.0 + 0.4 * i}"), config)
        records = edit_records(records, config, log.start_ns, [fault], np.random.default_rng(i))
    path = tmp_path / "all.mcap"
    write_log(path, config, log.start_ns, records)
    result = replay(Log(path), config, ["ekf"])
    assert result.poses["ekf"]
    assert all(np.isfinite(pose.T_map_body).all() for pose in result.poses["ekf"])


def test_the_same_seed_gives_the_same_log(log: Log, tmp_path: Path) -> None:
    config = config_of(log, [])
    faults = [parse_fault("spike", config), parse_fault("nlos:at=2", config)]
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        edit_log(log, config, faults, seed, tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes() != (tmp_path / "c").read_bytes()


def test_the_log_that_is_read_is_not_overwritten(log: Log) -> None:
    with pytest.raises(UserError, match="is the log that is read"):
        edit_log(log, config_of(log, []), [], 0, log.path)


def test_evaluate_puts_the_fault_into_every_trial(short_log: Path) -> None:
    whole = evaluate_scenario(short_log, 1, choices=["uwb_ls"])
    found = evaluate_scenario(short_log, 2, choices=["uwb_ls"], faults=["spike:size=5,share=0.3"])
    assert found.trials == 2
    before, after = whole.estimators["uwb_ls"], found.estimators["uwb_ls"]
    assert before is not None
    assert after is not None
    assert after.rmse_m > 2.0 * before.rmse_m
    first, second = found.errors["uwb_ls"].values()
    assert first.error.tobytes() != second.error.tobytes()


def test_a_scenario_without_bytes_takes_no_fault(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="has no bytes to put a fault into"):
        evaluate_scenario(write_scenario(tmp_path, more=FEW), 1, choices=["ekf"], faults=["spike"])


@pytest.mark.parametrize("shift", ["x=0.5", "x=0.2"])
def test_a_pose_that_followed_a_moved_anchor_does_not_claim_to_be_sure(shift: str) -> None:
    # Furniture hides two of the others while the robot is near it, so that it cannot be told at once.
    scenario = params_dir() / "scenarios" / "square_room.toml"
    names = ["ekf", "pf_ibas_graph"]
    found = evaluate_scenario(scenario, 2, choices=names, faults=[f"moved:anchor=3,{shift},at=15"])
    for name in names:
        figures = found.estimators[name]
        assert figures is not None
        assert figures.integrity is not None
        assert figures.integrity < 0.03


def test_the_command_says_what_is_wrong_in_one_line(short_log: Path, command: Command) -> None:
    done = command("evaluate", short_log, "--fault", "drop:anchor=77")
    assert done.returncode == 2
    assert "--fault drop:anchor=77: anchor=77: the site has no such anchor" in done.stderr
    assert done.stderr.count("\n") == 1
