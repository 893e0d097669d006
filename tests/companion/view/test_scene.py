"""The Rerun recording of a replay, read back from its file."""

import itertools
import resource
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink2
from rerun.chunk import RrdReader

from companion.config import Config
from companion.errors import UserError
from companion.log import Direction, Log, RawChunk, Truth
from companion.map_table import MapTable
from companion.pipeline import Tick
from companion.replay import config_of, replay
from companion.sim.world import World
from companion.view.files import RerunFiles
from estimators.base import Verdict
from estimators.lidar.floor_map import FloorMap
from estimators.messages import FloatArray, RangeFrame, Scan
from tests.companion.view.recordings import Recording, read

NAMES = ["ekf", "least_squares", "lidar_odometry"]
GREEN, VERMILION, ORANGE, GREY = 0x009E73FF, 0xD55E00FF, 0xE69F00FF, 0x787878FF


class Run:
    """The ticks of a short replay, to be shown again and again."""

    def __init__(self, path: Path) -> None:
        log = Log(path)
        self.config = config_of(log, [])
        self.ticks: list[tuple[Tick, Truth | None]] = []
        replay(log, self.config, NAMES, lambda tick, truth: self.ticks.append((tick, truth)))

    def measurements(self, kind: type[RangeFrame] | type[Scan]) -> list[Any]:
        outcomes = [outcome for tick, _ in self.ticks for outcome in tick.outcomes]
        return [outcome.measurement for outcome in outcomes if isinstance(outcome.measurement, kind)]

    def verdicts(self, name: str) -> list[Verdict]:
        outcomes = [outcome for tick, _ in self.ticks for outcome in tick.outcomes]
        reports = [o.reports[name] for o in outcomes if isinstance(o.measurement, RangeFrame)]
        return [verdict for report in reports for verdict in report.verdicts]

    def show(
        self,
        path: Path,
        primary: str = "ekf",
        change: Callable[[int, Tick, Truth | None], tuple[Tick, Truth | None]] = lambda _, *both: both,
    ) -> Recording:
        names = [primary, *(name for name in NAMES if name != primary)]
        view = RerunFiles(self.config, names, path, self.ticks[0][0].stamp_ns)
        for i, (tick, truth) in enumerate(self.ticks):
            view.tick(*change(i, tick, truth))
        view.close()
        return read(path)


@pytest.fixture(scope="module")
def run(short_log: Path) -> Run:
    return Run(short_log)


@pytest.fixture(scope="module")
def recording(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return run.show(tmp_path_factory.mktemp("view") / "new folder" / "run.rrd")


def test_every_tick_has_a_row_for_every_estimator(run: Run, recording: Recording) -> None:
    for name in NAMES:
        rows = recording[f"map/estimate/{name}/position"]["Points2D:positions"]
        poses = [tick.poses[name] for tick, _ in run.ticks]
        assert [len(row) for row in rows] == [int(pose is not None) for pose in poses]
        shown = np.array([row[0] for row in rows if row])
        assert shown == pytest.approx(np.array([pose.xy for pose in poses if pose is not None]), abs=1e-5)


def test_time_begins_with_the_log(run: Run, recording: Recording) -> None:
    times = [time.total_seconds() for time in recording["map/estimate/ekf/position"]["time"]]
    assert times[0] == 0.0
    assert times[-1] == pytest.approx((run.ticks[-1][0].stamp_ns - run.ticks[0][0].stamp_ns) * 1e-9, abs=1e-6)


def test_map_holds_map_coordinates_and_only_its_transform_is_mirrored(run: Run, recording: Recording) -> None:
    assert recording["map"]["Transform3D:scale"] == [[[1.0, -1.0, 1.0]]]
    (anchors,) = recording["map/anchors"]["Points2D:positions"]
    assert np.array(anchors) == pytest.approx(np.array([a[:2] for a in run.config.anchors.values()]))
    (walls,) = recording["map/walls"]["LineStrips2D:strips"]
    assert np.array(walls) == pytest.approx(np.array(run.config.site.walls))
    truths = {truth.stamp_ns: truth.pose[:2] for _, truth in run.ticks if truth is not None}
    shown = np.array([row[0] for row in recording["map/truth/position"]["Points2D:positions"]])
    assert shown == pytest.approx(np.array(list(truths.values())), abs=1e-5)


def test_scans_lie_on_the_walls(run: Run, recording: Recording) -> None:
    rows = recording["map/scan"]["Points2D:positions"]
    assert len(rows) == len(run.measurements(Scan))
    points = np.array([point for row in rows for point in row])
    assert len(points) > 10_000
    world = World([list(wall) for wall in run.config.site.walls], [(4.0, 3.6, 0.6, 0.6, 0.0, 3.0)])
    distances = np.min([distance_to(points, segment) for segment in world.segments], axis=0)
    assert np.median(distances) < 0.05
    assert np.percentile(distances, 95) < 0.2


def distance_to(points: FloatArray, segment: FloatArray) -> FloatArray:
    start, along = segment[:2], segment[2:] - segment[:2]
    share = np.clip((points - start) @ along / (along @ along), 0.0, 1.0)
    distances: FloatArray = np.linalg.norm(points - start - share[:, None] * along, axis=1)
    return distances


def test_evenly_spread_beams_are_drawn_and_none_without_a_return(run: Run, tmp_path: Path) -> None:
    most = 70
    config = run.config.model_copy(update={"view": run.config.view.model_copy(update={"scan_points": most})})
    scans = run.measurements(Scan)
    assert all(len(scan.ranges) > most and len(scan.ranges) % most for scan in scans)
    view = RerunFiles(config, ["ekf"], tmp_path / "run.rrd", run.ticks[0][0].stamp_ns)
    for tick, truth in run.ticks:
        outcomes = [
            replace(o, measurement=half_blind(o.measurement)) if isinstance(o.measurement, Scan) else o
            for o in tick.outcomes
        ]
        view.tick(replace(tick, outcomes=outcomes), truth)
    view.close()
    drawn = [len(row) for row in read(tmp_path / "run.rrd")["map/scan"]["Points2D:positions"]]
    assert len(drawn) == len(scans)
    assert 0.7 * most / 2 < np.median(drawn) <= max(drawn) <= most / 2


def half_blind(scan: Scan) -> Scan:
    """A scan whose first half met nothing."""
    count = len(scan.ranges)
    return replace(scan, ranges=np.where(np.arange(count) < count / 2, 0.0, 3.0))


def test_ranges_go_from_tag_to_anchor_in_the_colour_of_their_verdict(run: Run, recording: Recording) -> None:
    frames = run.measurements(RangeFrame)
    assert len(recording["map/ranges"]["LineStrips2D:strips"]) == len(frames)
    colours = [colour for row in recording["map/ranges"]["LineStrips2D:colors"] for colour in row]
    verdicts = run.verdicts("ekf")
    # The first frames come before the first pose: there is no tag yet to draw them from.
    hidden = len(verdicts) - len(colours)
    assert 0 < hidden < 20
    expected = {Verdict.ACCEPTED: GREEN, Verdict.TOO_LONG: VERMILION, Verdict.SUSPECT: ORANGE}
    told = [(c, v) for c, v in zip(colours, verdicts[hidden:], strict=True) if v in expected]
    assert [colour for colour, _ in told] == [expected[verdict] for _, verdict in told]
    assert len(set(colours)) == len(set(verdicts[hidden:])), "a colour for every reason"
    labels = [label for row in recording["map/ranges"]["LineStrips2D:labels"] for label in row]
    assert labels == ["" if verdict.is_used else verdict for verdict in verdicts[hidden:]]
    assert Verdict.TOO_LONG in labels

    ends = np.array([strip[1] for row in recording["map/ranges"]["LineStrips2D:strips"] for strip in row])
    anchors = np.array(list(run.config.anchors.values()))[:, :2]
    assert np.linalg.norm(ends[:, None] - anchors, axis=2).min(axis=1).max() < 1e-5


def test_plots_hold_errors_residuals_nis_and_gate(run: Run, recording: Recording) -> None:
    for entity in ("error/position/ekf", "error/position/sigma", "error/yaw/lidar_odometry"):
        assert len(recording[entity]["Scalars:scalars"]) == len(run.ticks)
    errors = np.array(recording["error/position/ekf"]["Scalars:scalars"])
    assert 0.0 < np.nanmax(errors) < 0.5
    assert "error/yaw/least_squares" not in recording  # it has no heading
    for anchor in run.config.anchors:
        assert len(recording[f"ranges/residual/A{anchor}"]["Scalars:scalars"]) > 100
    ((gate,), *others) = recording["ranges/nis/gate"]["Scalars:scalars"]
    assert all(other == [gate] for other in others)
    nis = [v for i in run.config.anchors for (v,) in recording[f"ranges/nis/A{i}"]["Scalars:scalars"]]
    accepted = run.verdicts("ekf").count(Verdict.ACCEPTED)
    assert accepted <= sum(value <= gate for value in nis) < len(nis)


@pytest.mark.parametrize("batch", [7, 600])
def test_while_a_port_stalls_its_sensor_ages_and_its_rate_falls_to_none(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, batch: int
) -> None:
    def stalling(i: int, tick: Tick, truth: Truth | None) -> tuple[Tick, Truth | None]:
        held = [outcome for tick, _ in run.ticks[100:150] for outcome in tick.outcomes]
        outcomes = [] if i < 40 or 100 <= i < 150 else held * (i == 150) + tick.outcomes
        return replace(tick, outcomes=outcomes), truth

    monkeypatch.setattr("companion.view.files.BATCH", batch)
    recording = run.show(tmp_path / "run.rrd", change=stalling)
    arrived: list[int] = []
    ages, rates = [], []
    for i, (original, truth) in enumerate(run.ticks):
        tick, _ = stalling(i, original, truth)
        arrived += [o.measurement.stamp_ns for o in tick.outcomes if isinstance(o.measurement, RangeFrame)]
        ages.append((tick.stamp_ns - arrived[-1]) * 1e-6 if arrived else np.nan)
        recent = sum(stamp_ns > tick.stamp_ns - 1_000_000_000 for stamp_ns in arrived)
        rates.append(recent if arrived else np.nan)
    assert np.isnan(rates[39])
    assert rates[149] == 0 < rates[99]
    for entity, expected in (("sensors/age/ranges", ages), ("sensors/rate/ranges", rates)):
        drawn = [value for (value,) in recording[entity]["Scalars:scalars"]]
        # Nothing is drawn of a batch before the first range.
        np.testing.assert_allclose(drawn, expected[len(expected) - len(drawn) :], rtol=1e-12)
        assert len(drawn) >= len(expected) - 40


def test_a_lane_tells_what_became_of_most_ranges_of_an_anchor_in_half_a_second(
    run: Run, recording: Recording
) -> None:
    told = {i: dict[float, str]() for i in run.config.anchors}
    for i, states in told.items():
        rows = recording[f"ranges/verdict/A{i}"]
        times = [time.total_seconds() for time in rows["time"]]
        states |= dict(zip(times, (state for (state,) in rows["StateChange:state"]), strict=True))
        assert all(a != b for a, b in itertools.pairwise(states.values()))
    begin_ns, seen = run.ticks[0][0].stamp_ns, set()
    for k in range(0, len(run.ticks), 15):
        window = [o for tick, _ in run.ticks[k : k + 15] for o in tick.outcomes]
        time = (run.ticks[k][0].stamp_ns - begin_ns) * 1e-9
        for i in run.config.anchors:
            given = [
                verdict
                for o in window
                if isinstance(o.measurement, RangeFrame)
                for anchor_id, verdict in zip(
                    o.measurement.anchor_ids, o.reports["ekf"].verdicts, strict=True
                )
                if anchor_id == i
            ]
            used = [verdict.is_used for verdict in given]
            state = [states for at, states in told[i].items() if at <= time + 1e-6][-1]
            if sum(used) * 2 != len(used):
                assert Verdict(state).is_used == (sum(used) * 2 > len(used))
                votes = Counter(v for v in given if v.is_used == Verdict(state).is_used)
                assert votes[Verdict(state)] == max(votes.values())
                seen.add(state)
    assert len(seen) > 1


def test_a_lane_shows_the_most_common_reason_though_a_third_is_accepted(run: Run, tmp_path: Path) -> None:
    kinds = "accepted too_long obstructed accepted too_long too_long".upper().split()
    verdicts = itertools.cycle(Verdict[kind] for kind in kinds)
    # The last look of a lane is not as long as the others.
    late = len(run.ticks) - 1 - len(run.ticks) % 15

    def judge(i: int, tick: Tick, truth: Truth | None) -> tuple[Tick, Truth | None]:
        outcomes = []
        for outcome in tick.outcomes:
            if isinstance(outcome.measurement, RangeFrame):
                count = len(outcome.measurement.ranges)
                given = (Verdict.GATED if i > late else next(verdicts),) * count
                report = replace(outcome.reports["ekf"], verdicts=given)
                outcome = replace(outcome, reports={**outcome.reports, "ekf": report})
            outcomes.append(outcome)
        return replace(tick, outcomes=outcomes), truth

    recording = run.show(tmp_path / "run.rrd", change=judge)
    assert len(run.ticks) % 15 > 1
    for i in run.config.anchors:
        states = [state for (state,) in recording[f"ranges/verdict/A{i}"]["StateChange:state"]]
        assert states[-2:] == [Verdict.TOO_LONG, Verdict.GATED]
        assert set(states[:-2]) <= {"no range"}


def test_an_anchor_that_is_not_heard_any_more_has_a_lane_that_says_so(run: Run, tmp_path: Path) -> None:
    def without_ranges(i: int, tick: Tick, truth: Truth | None) -> tuple[Tick, Truth | None]:
        outcomes = [o for o in tick.outcomes if i < 150 or not isinstance(o.measurement, RangeFrame)]
        return replace(tick, outcomes=outcomes), truth

    recording = run.show(tmp_path / "run.rrd", change=without_ranges)
    for i in run.config.anchors:
        rows = recording[f"ranges/verdict/A{i}"]
        assert rows["StateChange:state"][-1] == ["no range"]
        assert 5.0 < rows["time"][-1].total_seconds() <= 6.5


def test_health_changes_are_a_state_and_a_line_of_text(run: Run, recording: Recording) -> None:
    states = [tick.health.state for tick, _ in run.ticks]
    changes = [b for a, b in zip([None, *states], states, strict=False) if a is not b]
    assert [state for (state,) in recording["health/state"]["StateChange:state"]] == changes
    texts = [text for (text,) in recording["log"]["TextLog:text"]]
    assert [text.split()[3].rstrip(":") for text in texts if " s  health " in text] == changes


def test_the_file_says_how_it_opens(run: Run, tmp_path: Path) -> None:
    run.show(tmp_path / "run.rrd")
    assert len(RrdReader(tmp_path / "run.rrd").blueprints()) == 1


def test_missing_and_nan_poses_leave_gaps(run: Run, tmp_path: Path) -> None:
    def spoil(i: int, tick: Tick, truth: Truth | None) -> tuple[Tick, Truth | None]:
        pose = tick.poses["ekf"]
        if 100 <= i < 120:
            pose = None
        elif 150 <= i < 160:
            assert pose is not None
            pose = replace(pose, T_map_body=np.full((4, 4), np.nan))
        elif 200 <= i < 210:
            assert pose is not None
            pose = replace(pose, cov=np.full((6, 6), np.inf))
        return replace(tick, poses={**tick.poses, "ekf": pose}), truth

    recording = run.show(tmp_path / "run.rrd", change=spoil)
    shown = [len(row) for row in recording["map/estimate/ekf/position"]["Points2D:positions"]]
    assert sum(shown[100:120]) == sum(shown[150:160]) == 0
    assert sum(shown[200:210]) == 10
    assert (
        sum(len(row) for row in recording["map/estimate/ekf/ellipse_95"]["LineStrips2D:strips"][200:210]) == 0
    )
    (pieces,) = recording["map/estimate/ekf/track"]["LineStrips2D:strips"]
    assert len(pieces) == 3
    errors = np.array(recording["error/position/ekf"]["Scalars:scalars"])[:, 0]
    assert np.isnan(errors[100:120]).all()


def test_without_truth_there_are_no_errors(run: Run, tmp_path: Path) -> None:
    recording = run.show(tmp_path / "run.rrd", change=lambda _, tick, __: (tick, None))
    assert "map/truth/track" not in recording
    assert "error/position/ekf" not in recording
    assert len(recording["error/position/sigma"]["Scalars:scalars"]) == len(run.ticks)


def test_truth_without_heading_gives_errors_in_position_only(run: Run, tmp_path: Path) -> None:
    def blind(_: int, tick: Tick, truth: Truth | None) -> tuple[Tick, Truth | None]:
        return tick, truth and replace(truth, pose=np.array([*truth.pose[:2], np.nan]))

    recording = run.show(tmp_path / "run.rrd", change=blind)
    assert "error/position/ekf" in recording
    assert "error/yaw/ekf" not in recording


@pytest.mark.parametrize("primary", ["least_squares", "lidar_odometry"])
def test_estimators_without_heading_or_ranges_can_be_primary(run: Run, tmp_path: Path, primary: str) -> None:
    recording = run.show(tmp_path / "run.rrd", primary)
    colours = {colour for row in recording["map/ranges"]["LineStrips2D:colors"] for colour in row}
    if primary == "least_squares":
        assert sum(len(row) for row in recording["map/scan"]["Points2D:positions"]) == 0
        assert GREEN in colours
    else:
        assert colours == {GREY}
        assert "Scalars:scalars" not in recording["ranges/residual/A0"]


def test_a_run_of_no_ticks_is_an_empty_map(config: Config, tmp_path: Path) -> None:
    RerunFiles(config, ["ekf"], tmp_path / "run.rrd", 0).close()
    assert "map/walls" in read(tmp_path / "run.rrd")


def test_a_saved_map_is_drawn_where_it_stands(config: Config, tmp_path: Path) -> None:
    floor = FloorMap(np.eye(3, dtype=bool), ~np.eye(3, dtype=bool), 0.1, np.array([1.0, 2.0, 0.3]))
    site = config.site.model_copy(update={"map": MapTable.of(floor, "room.yaml")})
    RerunFiles(config.model_copy(update={"site": site}), ["ekf"], tmp_path / "run.rrd", 0).close()
    (cells,) = read(tmp_path / "run.rrd")["map/obstacles"]["Points2D:positions"]
    assert np.array(cells) == pytest.approx(floor.obstacle_points(floor.cell), abs=1e-6)


def test_a_file_that_cannot_be_written_is_the_users_error(config: Config, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"cannot write the view .*run\.rrd: File exists"):
        RerunFiles(config, ["ekf"], tmp_path / "file" / "run.rrd", 0)
    with pytest.raises(UserError, match="Is a directory"):
        RerunFiles(config, ["ekf"], tmp_path, 0)


@pytest.mark.skipif(sys.platform != "linux", reason="needs /dev/full and a limit on the size of files")
def test_a_full_disk_is_the_users_error(run: Run, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"cannot write the view /dev/full: .*No space left on device"):
        RerunFiles(run.config, NAMES, Path("/dev/full"), 0)
    view = RerunFiles(run.config, NAMES, tmp_path / "run.rrd", 0)
    for tick, truth in run.ticks:
        view.tick(tick, truth)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, limits[1]))
    try:
        with pytest.raises(UserError, match=r"cannot write the view .*run\.rrd: File-writer"):
            view.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_the_autopilots_own_position_and_texts_are_shown(run: Run, tmp_path: Path) -> None:
    view = RerunFiles(run.config, NAMES, tmp_path / "run.rrd", run.ticks[0][0].stamp_ns)
    packer = mavlink2.MAVLink(None, srcSystem=1, srcComponent=1)
    position = mavlink2.MAVLink_local_position_ned_message(0, 1.0, 2.0, 0.0, 0.0, 0.0, 0.0)
    text = mavlink2.MAVLink_statustext_message(4, b"EKF lane switch", 0, 0)
    for tick, truth in run.ticks[:90]:
        view.tick(tick, truth)
    data = bytes(position.pack(packer)) + bytes(text.pack(packer))
    view.chunk(RawChunk("mavlink", Direction.IN, run.ticks[60][0].stamp_ns, data))
    view.close()
    recording = read(tmp_path / "run.rrd")
    (((x, y),),) = recording["map/autopilot/position"]["Points2D:positions"]
    heading = run.config.map_heading()
    assert (x * np.cos(heading) + y * np.sin(heading), x * np.sin(heading) - y * np.cos(heading)) == (
        pytest.approx((1.0, 2.0), abs=1e-5)
    )
    assert any("autopilot: EKF lane switch" in line for (line,) in recording["log"]["TextLog:text"])


def test_long_runs_go_into_several_files_that_hold_every_tick_once(run: Run, tmp_path: Path) -> None:
    view = run.config.view.model_copy(update={"file_minutes": 0.1, "scan_points": 50})
    config = run.config.model_copy(update={"view": view})
    files = RerunFiles(config, NAMES, tmp_path / "run.rrd", run.ticks[0][0].stamp_ns)
    for tick, truth in run.ticks:
        files.tick(tick, truth)
    files.close()
    parts = [read(path) for path in sorted(tmp_path.glob("run*.rrd"))]
    rows = [len(part["map/estimate/ekf/position"]["time"]) for part in parts]
    assert {path.name for path in tmp_path.iterdir()} == {"run.rrd", "run-2.rrd", "run-3.rrd"}
    assert sorted(rows)[-1] == pytest.approx(180, abs=2)
    assert sum(rows) == len(run.ticks)
    assert all("map/walls" in part for part in parts)
    points = [len(row) for part in parts for row in part["map/scan"]["Points2D:positions"]]
    assert 0 < max(points) <= 50


def test_small_batches_draw_what_one_large_one_draws(
    run: Run, recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.view.files.BATCH", 40)
    small = run.show(tmp_path / "run.rrd")
    for entity, component in (
        ("map/estimate/ekf/position", "Points2D:positions"),
        ("map/scan", "Points2D:positions"),
        ("map/ranges", "LineStrips2D:strips"),
        ("error/position/ekf", "Scalars:scalars"),
        ("ranges/verdict/A1", "StateChange:state"),
        ("sensors/age/increments", "Scalars:scalars"),
        ("sensors/rate/ranges", "Scalars:scalars"),
    ):
        rows = [list(zip(r[entity]["time"], r[entity][component], strict=True)) for r in (small, recording)]
        assert str(rows[0]) == str(rows[1]), entity
