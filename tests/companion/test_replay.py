"""Replay of simulated logs: the figures that the demo shows, and that a replay repeats itself."""

import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.tools import file_interface

from companion.config import Config
from companion.errors import UserError
from companion.log import Direction, Log, LogWriter, RawChunk, Truth
from companion.pipeline import Chain, Tick, make_pipeline
from companion.replay import Replay, config_of, replay, write_outputs
from companion.sim.scenario import load_scenario
from companion.tables import sensor_lines
from tests.conftest import SCENARIO, write_log

SENSORS_AND_FUSED = ["ekf", "least_squares", "lidar_odometry"]
SEEDS = (1, 2)
FLAT = ["[0.15, 0.15, 2.1]", "[0.15, 6.85, 2.1]", "[7.85, 6.85, 2.1]", "[7.85, 0.15, 2.1]"]
"""The room's anchors, as if they were all at one height."""


def run(path: Path, names: list[str], sets: list[str] | None = None) -> Replay:
    log = Log(path)
    return replay(log, config_of(log, sets or []), names)


@pytest.fixture(scope="module", params=SEEDS)
def room(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Replay:
    path = tmp_path_factory.mktemp("room") / "room.mcap"
    return run(write_log(load_scenario(SCENARIO, request.param, []), path), SENSORS_AND_FUSED)


def test_fused_is_within_a_decimetre_and_not_worse_than_either_sensor(room: Replay) -> None:
    fused, uwb, lidar = (room.accuracy(name) for name in ("ekf", "least_squares", "lidar_odometry"))
    assert fused is not None
    assert uwb is not None
    assert lidar is not None
    assert fused.rmse <= 0.10
    assert fused.rmse <= min(uwb.rmse, lidar.rmse)
    assert fused.availability > 0.99


def test_covariance_is_of_the_size_of_the_error(room: Replay) -> None:
    # One run is one sample of a correlated error, so no tight bound holds; an order of magnitude must.
    # The Monte Carlo bounds on both sides are in the tests of the filter itself.
    fused = room.accuracy("ekf")
    assert fused is not None
    assert fused.nees_dof == 3
    assert 0.3 < fused.nees < 3.0 * fused.nees_dof


def test_all_bytes_are_understood_and_none_comes_late(room: Replay) -> None:
    assert room.complete
    assert room.late == 0
    for stats in room.sensors.values():
        assert stats.good > 1000
        assert (stats.bad, stats.skipped_bytes) == (0, 0)


def test_the_same_log_twice_gives_the_same_bytes(short_log: Path, tmp_path: Path) -> None:
    # That each estimator repeats itself is a test of its own; here it is the chain round them.
    names = ["ekf", "pf_ibas_graph", "least_squares"]
    for folder in ("a", "b"):
        write_outputs(run(short_log, names), tmp_path / folder)
    files = sorted(path.name for path in (tmp_path / "a").glob("*.tum"))
    assert files == ["poses.tum", "poses_least_squares.tum", "poses_pf_ibas_graph.tum"]
    for name in [*files, "config.toml"]:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert len((tmp_path / "a" / "poses.tum").read_text().splitlines()) > 300


def test_bytes_that_a_busy_machine_takes_late_are_replayed_as_late(short_log: Path) -> None:
    log = Log(short_log)
    config = config_of(log, [])

    def chain() -> Chain:
        return Chain(config, log.start_ns, make_pipeline(config, ["ekf"]), "ekf")

    def told(ticks: Iterable[Tick]) -> list[tuple[int, bytes]]:
        poses = [(tick.stamp_ns, tick.poses["ekf"]) for tick in ticks]
        return [(stamp_ns, pose.T_map_body.tobytes()) for stamp_ns, pose in poses if pose is not None]

    rng = np.random.default_rng(1)
    live, logged, lived = chain(), [], []
    arrived = [chunk for chunk in log if isinstance(chunk, RawChunk)]
    for chunk in (c for c in arrived if c.stamp_ns < log.start_ns + 5_000_000_000):
        if rng.random() < 0.05:
            # The loop's turn comes late, and once more before these bytes are handed over.
            lived += told(live.advance(chunk.stamp_ns + 80_000_000))
            logged.append(RawChunk("mavlink", Direction.OUT, chunk.stamp_ns + 160_000_000, b""))
        logged.append(replace(chunk, stamp_ns=live.stamp_to_log(chunk.stamp_ns)))
        lived += told(live.feed(logged[-1]))
    again = chain()
    replayed = [pose for chunk in logged for pose in told(again.feed(chunk))]
    assert len(lived) > 100
    assert replayed == lived[: len(replayed)]
    assert len(lived) - len(replayed) < 4


def test_other_estimators_beside_it_change_nothing(short_log: Path, tmp_path: Path) -> None:
    write_outputs(run(short_log, ["ekf"]), tmp_path / "alone")
    write_outputs(run(short_log, ["ekf", "least_squares"]), tmp_path / "beside")
    alone, beside = ((tmp_path / name / "poses.tum").read_bytes() for name in ("alone", "beside"))
    assert alone == beside


def test_a_height_that_ranges_cannot_show_is_the_sites_and_is_said_to_be(
    short_log: Path, tmp_path: Path
) -> None:
    solved = "estimator.momentum_gd.dimensions=3"
    flat = [solved, *(f"anchors.{i}={place}" for i, place in enumerate(FLAT))]
    for sets, is_shown in (([solved], True), (flat, False)):
        result = run(short_log, ["momentum_gd", "ekf"], sets)
        folder = tmp_path / str(is_shown)
        write_outputs(result, folder)
        said = json.loads((folder / "summary.json").read_text())["estimators"]
        count, without = len(result.poses["momentum_gd"]), said["momentum_gd"]["poses_without_height"]
        told = f"momentum_gd: height unobservable in {without} of {count} poses; the site's is kept"
        assert told in sensor_lines(result)
        # Of a single frame with three ranges in the room, of all where the anchors lie in one plane.
        assert 0 < without < count / 4 if is_shown else without == count
        # Who is told the height by the site does not pretend to look for it.
        assert said["ekf"]["poses_without_height"] == 0
        heights = np.loadtxt(folder / "poses.tum")[:, 3]
        kept = int(np.isclose(heights, result.config.body.height, rtol=0.0, atol=1e-8).sum())
        assert kept == without


def test_poses_come_at_the_rate_asked_for(short_log: Path) -> None:
    stamps = [pose.stamp_ns for pose in run(short_log, ["ekf"], ["pipeline.rate=20"]).poses["ekf"]]
    assert {b - a for a, b in pairwise(stamps)} == {50_000_000}


def test_error_agrees_with_evo(short_log: Path, tmp_path: Path) -> None:
    result = run(short_log, ["ekf"])
    write_outputs(result, tmp_path)
    truth = tmp_path / "truth.tum"
    errors = result.errors["ekf"]
    lines = []
    for stamp_ns, (x, y, yaw) in zip(errors.stamps_ns.tolist(), errors.truth, strict=True):
        seconds, rest = divmod(stamp_ns, 1_000_000_000)
        quaternion = f"0 0 {np.sin(yaw / 2):.9f} {np.cos(yaw / 2):.9f}"
        lines.append(f"{seconds}.{rest:09d} {x:.9f} {y:.9f} {result.config.body.height} {quaternion}\n")
    truth.write_text("".join(lines))
    reference, estimate = sync.associate_trajectories(
        file_interface.read_tum_trajectory_file(str(truth)),
        file_interface.read_tum_trajectory_file(str(tmp_path / "poses.tum")),
    )
    ours = result.accuracy("ekf")
    assert ours is not None
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, estimate))
    assert ours.rmse == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), abs=1e-7)
    assert ours.max == pytest.approx(ape.get_statistic(metrics.StatisticsType.max), abs=1e-7)
    turn = metrics.APE(metrics.PoseRelation.rotation_angle_deg)
    turn.process_data((reference, estimate))
    assert ours.yaw_rmse_deg == pytest.approx(turn.get_statistic(metrics.StatisticsType.rmse), abs=1e-5)


def edited(source: Path, target: Path, keep: Callable[[RawChunk | Truth], RawChunk | Truth | None]) -> Path:
    """A copy of a log with some records left out or changed."""
    log = Log(source)
    writer = LogWriter(target, log.config_toml, log.start_ns)
    for record in log:
        changed = keep(record)
        if isinstance(changed, Truth):
            writer.truth(changed)
        elif changed is not None:
            writer.raw(changed)
    writer.close()
    return target


def silent(
    source: str, begin_ns: int, end_ns: int = 2**62
) -> Callable[[RawChunk | Truth], RawChunk | Truth | None]:
    """Leaves out what a sensor sent in some time."""

    def keep(record: RawChunk | Truth) -> RawChunk | Truth | None:
        is_its = isinstance(record, RawChunk) and record.source == source
        return None if is_its and begin_ns <= record.stamp_ns < end_ns else record

    return keep


def test_without_lidar_it_says_so_and_stops_before_it_is_wrong(short_log: Path, tmp_path: Path) -> None:
    off_ns = 5_000_000_000
    path = edited(
        short_log,
        tmp_path / "dark.mcap",
        silent("lidar", off_ns),
    )
    log = Log(path)
    config = config_of(log, [])
    states: list[tuple[int, str]] = []
    result = replay(log, config, ["ekf"], lambda tick, _: states.append((tick.stamp_ns, tick.health.state)))
    assert {state for stamp, state in states if 3.5e9 < stamp < off_ns} == {"ok"}
    after = [state for stamp, state in states if stamp > off_ns + 1.2e9]
    assert "ok" not in after
    # What is still sent is as good as its covariance says.
    errors = result.errors["ekf"]
    sent = np.isin(errors.stamps_ns, [stamp for stamp, state in states if state in ("ok", "degraded")])
    sigma = np.sqrt(np.linalg.eigvalsh(errors.cov[:, :2, :2])[:, 1])
    assert (errors.distance[sent] < 5.0 * sigma[sent]).all()


@pytest.mark.parametrize("off", [0.4, 1.0, 2.0, 4.0])
def test_after_a_gap_in_the_scans_no_wrong_heading_is_sent(
    short_log: Path, tmp_path: Path, off: float
) -> None:
    # The robot turns from 5.9 s to 8 s after the start.
    begin_ns = 6_500_000_000
    path = edited(
        short_log,
        tmp_path / "gap.mcap",
        silent("lidar", begin_ns, begin_ns + round(off * 1e9)),
    )
    log = Log(path)
    sent: list[int] = []
    result = replay(
        log,
        config_of(log, []),
        ["ekf"],
        lambda tick, _: sent.append(tick.stamp_ns) if tick.health.sends else None,
    )
    errors = result.errors["ekf"]
    rows = np.isin(errors.stamps_ns, sent)
    assert rows.any()
    yaw_error, yaw_sigma = np.abs(errors.error[rows, 2]), np.sqrt(errors.cov[rows, 2, 2])
    assert (yaw_error < np.maximum(4.0 * yaw_sigma, np.deg2rad(3.0))).all()
    assert yaw_error.max() < np.deg2rad(60.0)


def test_without_uwb_it_goes_on_and_says_so(short_log: Path, tmp_path: Path) -> None:
    off_ns = 5_000_000_000
    path = edited(
        short_log,
        tmp_path / "silent.mcap",
        silent("uwb", off_ns),
    )
    result = run(path, ["ekf"])
    assert result.health["degraded"] > 100
    assert result.health["lost"] == 0
    accuracy = result.accuracy("ekf")
    assert accuracy is not None
    assert accuracy.rmse < 0.15


@pytest.mark.parametrize(
    ("wrong", "limit"),
    [
        ("start.yaw_deg=60", 1.0),
        ("start.yaw_deg=120", 1.0),
        ("start.yaw_deg=180", 1.0),
        ("start.x=3.5", 0.3),
        ("start.y=3.0", 0.3),
    ],
)
def test_a_wrong_start_heading_is_found_out_within_a_metre_and_a_wrong_place_at_once_and_both_mended(
    short_log: Path, wrong: str, limit: float
) -> None:
    log = Log(short_log)
    sent: list[int] = []
    result = replay(
        log,
        config_of(log, [wrong]),
        ["ekf"],
        lambda tick, _: sent.append(tick.stamp_ns) if tick.health.sends else None,
    )
    errors = result.errors["ekf"]
    assert errors.distance.max() > 0.9
    assert errors.distance[np.isin(errors.stamps_ns, sent)].max() < limit
    assert errors.distance[-90:].max() < 0.3
    assert result.poses["ekf"][-1].reset_counter == 1


def test_damaged_bytes_cost_frames_not_the_run(short_log: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)

    def flip(record: RawChunk | Truth) -> RawChunk | Truth:
        if isinstance(record, Truth) or record.direction is Direction.OUT or rng.random() > 0.05:
            return record
        data = bytearray(record.data)
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        return RawChunk(record.source, record.direction, record.stamp_ns, bytes(data))

    result = run(edited(short_log, tmp_path / "damaged.mcap", flip), ["ekf"])
    assert all(stats.bad > 0 for stats in result.sensors.values())
    accuracy = result.accuracy("ekf")
    assert accuracy is not None
    assert accuracy.rmse < 0.12


def test_a_torn_log_is_replayed_up_to_the_tear(short_log: Path, tmp_path: Path) -> None:
    torn = tmp_path / "torn.mcap"
    content = short_log.read_bytes()
    torn.write_bytes(content[: len(content) // 2])
    result = run(torn, ["ekf"])
    assert not result.complete
    assert result.duration == pytest.approx(run(short_log, ["ekf"]).duration / 2, rel=0.1)


def test_a_log_without_the_sites_sensors_is_refused(config: Config, tmp_path: Path) -> None:
    writer = LogWriter(tmp_path / "other.mcap", config.to_toml(), 0)
    writer.raw(RawChunk("radar", Direction.IN, 1, b"x"))
    writer.close()
    with pytest.raises(UserError, match=r"no bytes of the site's sensors in it \(sensors: uwb, lidar\)"):
        run(tmp_path / "other.mcap", ["ekf"])


def test_a_log_whose_configuration_no_longer_fits_is_refused(tmp_path: Path) -> None:
    LogWriter(tmp_path / "old.mcap", "[anchors]\n", 0).close()
    with pytest.raises(
        UserError, match=r"old\.mcap \(recorded by version .*--site FILE.*\): anchors: 0 anchors"
    ):
        run(tmp_path / "old.mcap", ["ekf"])
