"""The emulated LinkTrack module: what its bytes say is what the simulated world holds."""

import re
from pathlib import Path

import numpy as np
import pytest

from companion.sim.robot import Robot
from companion.sim.scenario import Scenario, load_scenario
from companion.sim.uwb_device import TAG_ID, LinkTrackDevice
from drivers.linktrack import LinkTrack
from drivers.linktrack_frames import encode
from drivers.linktrack_types import ErrorFrame0, NodeFrame0, SettingFrame0, SystemFrame0
from estimators.geometry import transform
from estimators.messages import ImuSample, RangeFrame
from tests.conftest import write_scenario
from tests.vectors import load

NOISELESS = "sigma = 0\ndropout = 0\n"
FRAMES = [
    "node_frame2",
    "node_frame3",
    "tag_frame0",
    "node_frame4",
    "node_frame5",
    "aoa_node_frame0",
    "anchor_frame0",
]
SECOND = 1_000_000_000


def scenario(folder: Path, uwb: str = NOISELESS, more: str = "") -> Scenario:
    return load_scenario(write_scenario(folder, more=f"[uwb]\n{uwb}{more}"), 5, [])


def decoder() -> LinkTrack:
    return LinkTrack(LinkTrack.Config())


def printed(name: str) -> bytes:
    """A frame that the vendor's manual prints."""
    (frame,) = (f for f in load("linktrack_setting_frames")["frames"] if f["id"] == name)
    return bytes.fromhex(frame["hex"])


def run_tag(setup: Scenario, seconds: float, step_ns: int) -> bytes:
    robot = Robot(setup)
    tag = LinkTrackDevice(robot, np.random.default_rng(0))
    robot.begin(0)
    return b"".join(tag.poll(now) for now in range(0, round(seconds * SECOND) + 1, step_ns))


@pytest.mark.parametrize("frame", FRAMES)
def test_ranges_are_distances_in_the_world(tmp_path: Path, frame: str) -> None:
    setup = scenario(tmp_path, f'frame = "{frame}"\n{NOISELESS}')
    config = setup.config
    robot = Robot(setup)
    tag = LinkTrackDevice(robot, np.random.default_rng(0))
    robot.begin(0)
    driver = decoder()
    anchors = config.setup().anchors
    least_mm = (
        5.0 if frame == "anchor_frame0" else 0.5
    )  # that frame carries centimetres, the others millimetres
    excess_of_blocked = []
    for now in range(0, 8 * SECOND, 40_000_000):
        (ranges,) = (m for m in driver.feed(tag.poll(now), now) if isinstance(m, RangeFrame))
        assert ranges.tag_id == TAG_ID
        pose = robot.motion(now).pose[0]
        antenna = np.array(
            [*transform(pose, np.array([config.body.tag[:2]]))[0], config.body.height + config.body.tag[2]]
        )
        for anchor_id, measured in zip(ranges.anchor_ids, ranges.ranges, strict=True):
            anchor = anchors[int(anchor_id)]
            excess = measured - float(np.linalg.norm(anchor - antenna))
            if setup.world.line_of_sight(antenna, anchor[None])[0]:
                assert abs(excess) <= (least_mm + 0.1) * 1e-3
            else:
                excess_of_blocked.append(excess)
    assert len(excess_of_blocked) > 20
    assert min(excess_of_blocked) >= setup.file.uwb.nlos_least - 0.006
    assert driver.stats.bad == driver.stats.skipped_bytes == 0


def test_power_tells_blocked_from_free(tmp_path: Path) -> None:
    setup = scenario(tmp_path)
    frames = [m for m in decoder().feed(run_tag(setup, 8.0, 10_000_000), 0) if isinstance(m, RangeFrame)]
    difference = np.concatenate([frame.rx_power - frame.fp_power for frame in frames])
    # LinkTrack manual: below 6 dB line of sight is likely, above 10 dB it is not, between it is open.
    assert (difference < 6.0).sum() > (difference > 10.0).sum() > 20
    assert ((difference >= 6.0) & (difference <= 10.0)).mean() < 0.2


def test_bytes_do_not_depend_on_how_often_they_are_asked_for(tmp_path: Path) -> None:
    setup = scenario(tmp_path, "other_traffic = true\n")
    assert run_tag(setup, 2.0, 1_000_000) == run_tag(setup, 2.0, 50_000_000)


def test_inertial_sample_is_gravity_and_the_turn(tmp_path: Path) -> None:
    setup = scenario(tmp_path, more="[imu]\ngyro_sigma = 0\ngyro_bias = 0\naccel_sigma = 0\n")
    samples = [m for m in decoder().feed(run_tag(setup, 9.0, 10_000_000), 0) if isinstance(m, ImuSample)]
    gyro, accel = (np.array([getattr(s, name) for s in samples]) for name in ("gyro", "accel"))
    assert accel[:, 2] == pytest.approx(9.81, abs=1e-5)
    assert gyro[:, 2].max() == pytest.approx(np.deg2rad(60.0), rel=0.01)
    assert gyro[:, 2].sum() / setup.file.uwb.rate == pytest.approx(np.pi / 2, rel=0.02)


def test_other_traffic_leaves_the_ranges_as_they_are(tmp_path: Path) -> None:
    alone = decoder().feed(run_tag(scenario(tmp_path), 4.0, 10_000_000), 0)
    driver = decoder()
    data = run_tag(scenario(tmp_path, NOISELESS + "other_traffic = true\n"), 4.0, 10_000_000)
    assert [m.ranges.tolist() for m in driver.feed(data, 0) if isinstance(m, RangeFrame)] == [
        m.ranges.tolist() for m in alone if isinstance(m, RangeFrame)
    ]
    text = re.findall(rb"\$[A-Z]{5},[ -~]*\r\n", data)
    assert driver.stats.skipped_bytes == sum(map(len, text)) > 0
    assert driver.stats.bad == 0
    kinds = {type(frame) for frame in decoder().frames(data)}
    assert {NodeFrame0, ErrorFrame0} < kinds


def test_a_request_to_read_gives_settings_with_the_anchors_and_versions(tmp_path: Path) -> None:
    setup = scenario(tmp_path)
    tag = LinkTrackDevice(Robot(setup), np.random.default_rng(0))
    tag.poll(0)
    tag.feed(printed("setting_read_request"), 1_000_000)
    tag.feed(encode(SystemFrame0(1, (0, 0), (0, 0), (0, 0, 0, 0), 0, 0, 0)), 1_000_000)
    settings, versions = decoder().frames(tag.poll(1_000_000))
    assert isinstance(settings, SettingFrame0)
    assert isinstance(versions, SystemFrame0)
    assert settings.mix == versions.mix == 0
    assert settings.id == versions.id == TAG_ID
    for anchor_id, position in setup.config.anchors.items():
        assert settings.anchors[anchor_id] == pytest.approx(position)
    assert settings.anchors[9] == (None, None, None)


def test_a_write_is_not_obeyed_and_power_starts_the_clocks_anew(tmp_path: Path) -> None:
    tag = LinkTrackDevice(Robot(scenario(tmp_path)), np.random.default_rng(0))
    first = tag.poll(0)
    tag.poll(5 * SECOND)
    tag.feed(printed("setting_read_reply"), 5 * SECOND)  # what a module answers would write if sent to it
    assert tag.poll(5 * SECOND) == b""
    tag.power_on(6 * SECOND)
    again = decoder().frames(tag.poll(6 * SECOND))
    assert [f.local_time_ms for f in again if hasattr(f, "local_time_ms")] == [0]
    assert len(first) == len(encode(again[0]))
