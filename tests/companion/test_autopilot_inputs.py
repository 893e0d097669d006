"""Wheels beside UWB, with a LiDAR and without, and UWB alone, replayed as they were recorded."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import all as mavlink2

from companion.evaluate import Accuracy
from companion.log import Direction, Log, LogWriter, RawChunk, Truth
from companion.mavlink.link import NAME
from companion.mavlink.session import MavlinkSession
from companion.pipeline import Chain, make_pipeline
from companion.replay import Replay, config_of, replay, tum_line
from companion.sim.scenario import Scenario, load_scenario
from companion.sim.simulate import START_NS, converse
from estimators.geometry import between
from estimators.messages import PoseEstimate
from tests.companion.mavlink.flight import messages
from tests.companion.mavlink.scripted_autopilot import SYSTEM, ScriptedAutopilot
from tests.conftest import COLUMN, SHORT_WALK, SITE

TRACK = 0.4


def without_lidar(folder: Path, more: str) -> Scenario:
    """The short walk of a robot that has a tag alone."""
    site = SITE.read_text(encoding="utf-8").split("[sensor.lidar]")[0]
    # No odometry says when it begins to move: without this it would be held on its mark.
    site = site.replace("sigma_yaw_deg = 2.0", "sigma_yaw_deg = 2.0\nstill_for = 0.0")
    (folder / "site.toml").write_text(f"{site}\n{more}", encoding="utf-8")
    path = folder / "walk.toml"
    path.write_text(f'site = "{folder / "site.toml"}"\n{SHORT_WALK}{COLUMN}', encoding="utf-8")
    return load_scenario(path, 3, [])


def with_wheels(scenario: Scenario, chain: Chain) -> Iterator[RawChunk | Truth]:
    """What crosses the ports, and WHEEL_DISTANCE at 25 Hz of wheels that slip a little."""
    rng = np.random.default_rng(1)
    packer = mavlink2.MAVLink(None, srcSystem=SYSTEM, srcComponent=1)
    beat = mavlink2.MAVLink_heartbeat_message(10, 3, 0, 0, 3, 3)
    yield RawChunk(NAME, Direction.IN, START_NS, bytes(beat.pack(packer)))
    before: Truth | None = None
    wheels, count = np.zeros(2), 0
    for item in converse(scenario, chain.sensors):
        yield item
        if not isinstance(item, Truth):
            continue
        count += 1
        if count % 2:
            continue
        if before is not None:
            ahead, _, turn = between(before.pose, item.pose)
            steps = ahead + np.array([-turn, turn]) * TRACK / 2.0
            wheels = wheels + steps * (1.0 + 0.02 * rng.standard_normal(2))
        before = item
        distances = [*wheels.tolist(), *[0.0] * 14]
        message = mavlink2.MAVLink_wheel_distance_message((item.stamp_ns - 400_000_000) // 1000, 2, distances)
        yield RawChunk(NAME, Direction.IN, item.stamp_ns, bytes(message.pack(packer)))


def record(
    scenario: Scenario, path: Path
) -> tuple[list[mavlink2.MAVLink_message], list[PoseEstimate], Counter[str]]:
    """Log a run; gives the poses on the wire, all poses, and ticks in each state of health."""
    config = scenario.config
    chain = Chain(config, START_NS, make_pipeline(config, ["ekf"]), "ekf")
    session = MavlinkSession(config)
    writer = LogWriter(path, config.to_toml(), START_NS)
    sent, given, states = [], [], Counter[str]()
    items = (
        with_wheels(scenario, chain) if config.mavlink.inputs.wheels else converse(scenario, chain.sensors)
    )
    beat = ScriptedAutopilot(START_NS).poll(START_NS)
    session.receive(NAME, beat, START_NS, START_NS)
    for item in items:
        if isinstance(item, Truth):
            writer.truth(item)
            continue
        writer.raw(item)
        for tick in chain.feed(item):
            states[tick.health.state] += 1
            session.tick(tick.poses["ekf"], tick.health, tick.stamp_ns)
            sent.append(session.take().get(NAME, b""))
            if (pose := tick.poses["ekf"]) is not None:
                given.append(pose)
    writer.close()
    wire = [m for m in messages(b"".join(sent)) if m.get_type() == "VISION_POSITION_ESTIMATE"]
    return wire, given, states


def test_wheels_give_the_heading_that_a_lidar_would_and_replay_repeats_it(tmp_path: Path) -> None:
    scenario = without_lidar(tmp_path, f"[mavlink.inputs]\nwheels = 25.0\nwheel_track = {TRACK}\n")
    path = tmp_path / "raw.mcap"
    sent, given, states = record(scenario, path)
    assert states["ok"] > 150
    assert len(sent) > 150
    result = replay(Log(path), config_of(Log(path), []), ["ekf"])
    accuracy = result.accuracy("ekf")
    assert accuracy is not None
    assert accuracy.rmse < 0.15
    assert result.verdicts["ekf"]["accepted"] > 200
    assert [tum_line(pose) for pose in result.poses["ekf"]] == [tum_line(pose) for pose in given]


def test_uwb_alone_sends_a_position_without_heading_when_the_site_says_so(tmp_path: Path) -> None:
    found, _, states = record(without_lidar(tmp_path, "[mavlink]\nheading = false\n"), tmp_path / "a.mcap")
    assert len(found) > 150
    assert np.isnan([m.yaw for m in found]).all()
    assert np.isfinite([m.covariance for m in found]).all()
    assert states["lost"] < 30
    (tmp_path / "with").mkdir()
    found, _, _ = record(without_lidar(tmp_path / "with", "[mavlink]\nheading = true\n"), tmp_path / "b.mcap")
    assert len(found) < 60


def with_lidar(folder: Path, more: str) -> Scenario:
    """The short walk of a robot with tag, LiDAR and wheels."""
    site = SITE.read_text(encoding="utf-8")
    inputs = f"[mavlink.inputs]\nwheels = 25.0\nwheel_track = {TRACK}\n"
    (folder / "site.toml").write_text(f"{site}\n{inputs}", encoding="utf-8")
    path = folder / "walk.toml"
    path.write_text(f'site = "{folder / "site.toml"}"\n{SHORT_WALK}{COLUMN}{more}', encoding="utf-8")
    return load_scenario(path, 3, [])


def accuracy_of(scenario: Scenario, path: Path) -> tuple[Replay, Accuracy]:
    record(scenario, path)
    result = replay(Log(path), config_of(Log(path), []), ["ekf"])
    accuracy = result.accuracy("ekf")
    assert accuracy is not None
    return result, accuracy


def test_wheels_beside_a_lidar_count_once_and_disturb_nothing(tmp_path: Path) -> None:
    result, accuracy = accuracy_of(with_lidar(tmp_path, ""), tmp_path / "raw.mcap")
    assert accuracy.rmse < 0.05
    assert accuracy.nees < 6.0
    assert result.verdicts["ekf"]["no reference"] == 0
    assert result.verdicts["ekf"]["late"] == 0
    # One increment a scan: those of the wheels reach the filter within them.
    assert result.update_times["scan_matcher"].calls > 80


def test_wheels_go_on_when_the_lidar_is_pulled(tmp_path: Path) -> None:
    pulled = '[[faults]]\nsensor = "lidar"\nkind = "silence"\nat = 3.0\nduration = 6.0\n'
    result, accuracy = accuracy_of(with_lidar(tmp_path, pulled), tmp_path / "raw.mcap")
    assert accuracy.rmse < 0.12
    assert accuracy.yaw_rmse_deg is not None
    assert accuracy.yaw_rmse_deg < 6.0
    # Without them it would be degraded for want of increments after a second.
    assert result.health["degraded"] < 30
    assert result.health["lost"] < 5
