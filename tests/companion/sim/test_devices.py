"""Emulated devices: what their bytes say is what the simulated world holds."""

from pathlib import Path

import numpy as np
import pytest

from companion.sim.devices import LinkTrackDevice, Robot, RplidarDevice
from companion.sim.scenario import Scenario, load_scenario
from drivers import make_sensor, sensor_config_class
from drivers.framing import DecodeStats, Sensor
from drivers.rplidar import Rplidar
from drivers.rplidar_decoder import AnswerDecoder
from drivers.rplidar_protocol import Command, DeviceInfo, Health, HealthStatus, SampleRate, encode_request
from estimators.geometry import compose, transform
from estimators.messages import ImuSample, Measurement, RangeFrame, Scan
from tests.conftest import write_scenario

NOISELESS = "[uwb]\nsigma = 0\ndropout = 0\n[lidar]\nsigma = 0\ndropout = 0\n"
SECOND = 1_000_000_000


def scenario(folder: Path, more: str = NOISELESS) -> Scenario:
    return load_scenario(write_scenario(folder, more=more), 5, [])


def sensor(driver: str, **settings: object) -> Sensor:
    return make_sensor(driver, sensor_config_class(driver).model_validate(settings))


def run_tag(setup: Scenario, seconds: float, step_ns: int) -> bytes:
    robot = Robot(setup)
    tag = LinkTrackDevice(robot, np.random.default_rng(0), 0)
    robot.begin(0)
    return b"".join(tag.poll(now) for now in range(0, round(seconds * SECOND) + 1, step_ns))


@pytest.mark.parametrize("frame", ["node_frame2", "node_frame3", "tag_frame0"])
def test_tag_ranges_are_distances_in_the_world(tmp_path: Path, frame: str) -> None:
    setup = scenario(tmp_path, f'[uwb]\nframe = "{frame}"\nsigma = 0\ndropout = 0\n')
    config = setup.config
    robot = Robot(setup)
    tag = LinkTrackDevice(robot, np.random.default_rng(0), 0)
    robot.begin(0)
    decoder = sensor("linktrack")
    anchors = config.setup().anchors
    excess_of_blocked = []
    for now in range(0, 8 * SECOND, 40_000_000):
        frames = [m for m in decoder.feed(tag.poll(now), now) if isinstance(m, RangeFrame)]
        assert len(frames) == 1
        pose = robot.motion(now).pose[0]
        antenna = np.array(
            [*transform(pose, np.array([config.body.tag[:2]]))[0], config.body.height + config.body.tag[2]]
        )
        for anchor_id, measured in zip(frames[0].anchor_ids, frames[0].ranges, strict=True):
            anchor = anchors[int(anchor_id)]
            excess = measured - float(np.linalg.norm(anchor - antenna))
            if setup.world.line_of_sight(antenna, anchor[None])[0]:
                assert abs(excess) <= 0.0006  # the wire carries millimetres
            else:
                excess_of_blocked.append(excess)
    assert len(excess_of_blocked) > 20
    assert min(excess_of_blocked) >= setup.file.uwb.nlos_least - 0.001


def test_power_tells_blocked_from_free(tmp_path: Path) -> None:
    setup = scenario(tmp_path)
    decoder = sensor("linktrack")
    frames = [m for m in decoder.feed(run_tag(setup, 8.0, 10_000_000), 0) if isinstance(m, RangeFrame)]
    difference = np.concatenate([frame.rx_power - frame.fp_power for frame in frames])
    # LinkTrack manual: below 6 dB line of sight is likely, above 10 dB it is not.
    assert set(np.unique(difference > 8.0)) == {True, False}
    assert ((difference < 6.0) | (difference > 10.0)).all()


def test_tag_bytes_do_not_depend_on_how_often_they_are_asked_for(tmp_path: Path) -> None:
    setup = scenario(tmp_path, "")
    assert run_tag(setup, 2.0, 1_000_000) == run_tag(setup, 2.0, 50_000_000)


def test_inertial_sample_is_gravity_and_the_turn(tmp_path: Path) -> None:
    setup = scenario(tmp_path, "[imu]\ngyro_sigma = 0\ngyro_bias = 0\naccel_sigma = 0\n")
    samples = [
        m for m in sensor("linktrack").feed(run_tag(setup, 9.0, 10_000_000), 0) if isinstance(m, ImuSample)
    ]
    gyro, accel = (np.array([getattr(s, name) for s in samples]) for name in ("gyro", "accel"))
    assert accel[:, 2] == pytest.approx(9.81, abs=1e-5)
    assert gyro[:, 2].max() == pytest.approx(np.deg2rad(60.0), rel=0.01)
    assert gyro[:, 2].sum() / setup.file.uwb.rate == pytest.approx(np.pi / 2, rel=0.02)


def scan_in_memory(setup: Scenario, mode: str, seconds: float) -> tuple[Robot, list[Measurement], Rplidar]:
    robot = Robot(setup)
    device = RplidarDevice(robot, np.random.default_rng(0))
    driver = Rplidar(Rplidar.Config.model_validate({"mode": mode}))
    driver.connected(0)
    measurements: list[Measurement] = []
    for now in range(0, round(seconds * SECOND), 2_000_000):
        device.feed(driver.poll(now), now)
        data = device.poll(now)
        measurements += driver.feed(data, now)
    return robot, measurements, driver


@pytest.mark.parametrize(("mode", "beams"), [("express", 400), ("standard", 200)])
@pytest.mark.parametrize("model", ["A1", "A2", "S1"])
def test_driver_and_device_agree_on_the_room(tmp_path: Path, model: str, mode: str, beams: int) -> None:
    setup = scenario(tmp_path, f'[lidar]\nmodel = "{model}"\nsigma = 0\ndropout = 0\n')
    robot, scans, driver = scan_in_memory(setup, mode, 6.0)
    assert len(scans) > 50
    assert driver.dropped_scans == 0
    assert driver.info is not None
    assert driver.info.series == {"A1": 1, "A2": 2, "S1": 6}[model]
    height = setup.config.body.height + setup.file.lidar.height
    mounting = setup.config.lidar_mounting()
    errors = []
    for scan in scans:
        assert isinstance(scan, Scan)
        assert len(scan.ranges) == pytest.approx(beams, abs=2)
        for k in range(0, len(scan.ranges), 10):
            taken_ns = scan.stamp_ns + round(scan.beam_times[k] * 1e9)
            lidar = compose(robot.motion(taken_ns).pose[0], mounting)
            expected = setup.world.ray_cast(lidar[None, :2], np.array([lidar[2] + scan.angles[k]]), height)
            errors.append(scan.ranges[k] - expected[0])
    # A beam that just passes a box's edge may fall on either side of it: hence the median and a share.
    assert np.median(np.abs(errors)) < 0.005
    assert np.mean(np.abs(errors) < 0.03) > 0.97


def test_lidar_answers_and_any_request_ends_the_scan(tmp_path: Path) -> None:
    device = RplidarDevice(Robot(scenario(tmp_path)), np.random.default_rng(0))
    decoder = AnswerDecoder(DecodeStats())

    def ask(command: Command, now_ns: int) -> list[object]:
        device.feed(encode_request(command), now_ns)
        return list(decoder.feed(device.poll(now_ns)))

    assert isinstance(ask(Command.GET_INFO, 0)[0], DeviceInfo)
    assert ask(Command.GET_HEALTH, 0) == [Health(HealthStatus.GOOD, 0)]
    assert ask(Command.GET_SAMPLERATE, 0) == [SampleRate(500, 250)]
    assert device.poll(SECOND) == b""
    assert ask(Command.SCAN, SECOND)
    assert len(device.poll(2 * SECOND)) == 2000 * 5
    assert ask(Command.STOP, 2 * SECOND) == []
    assert device.poll(3 * SECOND) == b""


def test_the_walk_begins_with_the_first_scan(tmp_path: Path) -> None:
    robot = Robot(scenario(tmp_path))
    device = RplidarDevice(robot, np.random.default_rng(0))
    assert robot.seconds(5 * SECOND) == 0.0
    device.feed(encode_request(Command.SCAN), 5 * SECOND)
    device.feed(encode_request(Command.SCAN), 9 * SECOND)
    assert robot.seconds(10 * SECOND) == pytest.approx(5.0)
