"""The emulated RPLIDAR: what its bytes say is what the simulated world holds, in every model and mode."""

from pathlib import Path

import numpy as np
import pytest

from companion.sim.lidar_device import ERROR_CODE, RESET_BANNER, RplidarDevice
from companion.sim.lidar_models import LIDAR_MODELS
from companion.sim.robot import Robot
from companion.sim.scenario import Scenario, load_scenario
from drivers.framing import DecodeStats
from drivers.rplidar import Rplidar
from drivers.rplidar_decoder import AnswerDecoder
from drivers.rplidar_protocol import (
    AccBoardFlag,
    Command,
    ConfKey,
    DeviceInfo,
    Event,
    Health,
    HealthStatus,
    LidarConf,
    SampleRate,
    Samples,
    ScanStarted,
    encode_conf_request,
    encode_request,
)
from estimators.geometry import compose
from estimators.messages import Scan
from tests.conftest import write_scenario

MS = 1_000_000
SECOND = 1000 * MS


def scenario(folder: Path, model: str = "A2") -> Scenario:
    more = f'[lidar]\nmodel = "{model}"\nsigma = 0\ndropout = 0\n'
    return load_scenario(write_scenario(folder, more=more), 5, [])


class Host:
    """Asks a device and decodes what it answers."""

    def __init__(self, folder: Path, model: str) -> None:
        self.robot = Robot(scenario(folder, model))
        self.device = RplidarDevice(self.robot, np.random.default_rng(0))
        self._decoder = AnswerDecoder(DecodeStats())

    def ask(self, request: bytes, now_ns: int = 0) -> list[Event]:
        self.device.feed(request, now_ns)
        return self.listen(now_ns)

    def listen(self, now_ns: int) -> list[Event]:
        return self._decoder.feed(self.device.poll(now_ns))


def errors_in_the_world(setup: Scenario, robot: Robot, scans: list[Scan]) -> list[float]:
    height = setup.config.body.height + setup.file.lidar.height
    mounting = setup.config.lidar_mounting()
    errors = []
    for scan in scans[::4]:
        for k in range(0, len(scan.ranges), max(1, len(scan.ranges) // 60)):
            taken_ns = scan.stamp_ns + round(scan.beam_times[k] * 1e9)
            lidar = compose(robot.motion(taken_ns).pose[0], mounting)
            expected = setup.world.ray_cast(lidar[None, :2], np.array([lidar[2] + scan.angles[k]]), height)
            errors.append(scan.ranges[k] - expected[0])
    return errors


@pytest.mark.parametrize(
    ("model", "mode"),
    [(name, mode.name) for name, model in LIDAR_MODELS.items() for mode in model.modes],
)
def test_driver_and_device_agree_on_the_room(tmp_path: Path, model: str, mode: str) -> None:
    setup = scenario(tmp_path, model)
    robot = Robot(setup)
    device = RplidarDevice(robot, np.random.default_rng(0))
    driver = Rplidar(Rplidar.Config(mode=mode))
    driver.connected(0)
    scans: list[Scan] = []
    for now in range(0, 4 * SECOND, 2 * MS):
        device.feed(driver.poll(now), now)
        scans += [m for m in driver.feed(device.poll(now), now) if isinstance(m, Scan)]
    assert driver.mode.lower() == mode.lower()
    assert driver.info is not None
    assert driver.info.model == LIDAR_MODELS[model].model
    assert len(scans) > 25
    assert driver.dropped_scans == 0
    assert driver.stats.bad == 0
    (kind,) = (m for m in LIDAR_MODELS[model].modes if m.name == mode)
    for scan in scans:
        assert len(scan.ranges) == pytest.approx(1e6 / kind.sample_us / setup.file.lidar.rotation_hz, abs=2)
    errors = np.abs(errors_in_the_world(setup, robot, scans))
    # A beam that just passes a box's edge may fall on either side of it: hence the median and a share.
    assert np.median(errors) < 0.008
    assert np.mean(errors < 0.03) > 0.96


@pytest.mark.parametrize("model", LIDAR_MODELS)
def test_the_driver_takes_the_typical_mode(tmp_path: Path, model: str) -> None:
    device = RplidarDevice(Robot(scenario(tmp_path, model)), np.random.default_rng(0))
    driver = Rplidar(Rplidar.Config())
    driver.connected(0)
    scans = []
    for now in range(0, 2 * SECOND, 2 * MS):
        device.feed(driver.poll(now), now)
        scans += driver.feed(device.poll(now), now)
    assert driver.mode.lower() == LIDAR_MODELS[model].modes[LIDAR_MODELS[model].typical].name.lower()
    assert len(scans) > 5


def test_single_answers(tmp_path: Path) -> None:
    host = Host(tmp_path, "A2M12")
    assert host.ask(encode_request(Command.GET_INFO)) == [DeviceInfo(0x2C, (1, 32), 7, f"{5:032X}")]
    assert host.ask(encode_request(Command.GET_HEALTH)) == [Health(HealthStatus.GOOD, 0)]
    assert host.ask(encode_request(Command.GET_SAMPLERATE)) == [SampleRate(252, 126)]
    assert host.ask(encode_request(Command.GET_ACC_BOARD_FLAG, bytes(4))) == [AccBoardFlag(True)]
    (conf,) = host.ask(encode_conf_request(ConfKey.MODE_NAME, 4))
    assert isinstance(conf, LidarConf)
    assert conf.mode_name == "Stability"
    (conf,) = host.ask(encode_conf_request(ConfKey.MODE_SAMPLE_TIME, 4))
    assert isinstance(conf, LidarConf)
    assert conf.sample_ns == 100_000


def test_old_firmware_and_unknown_keys_and_modes_stay_unanswered(tmp_path: Path) -> None:
    assert Host(tmp_path, "A1-old").ask(encode_conf_request(ConfKey.TYPICAL_MODE)) == []
    host = Host(tmp_path, "S1")
    assert host.ask(encode_conf_request(ConfKey.MAC_ADDRESS)) == []
    assert host.ask(encode_conf_request(ConfKey.MODE_NAME, 2)) == []
    assert host.ask(encode_request(Command.EXPRESS_SCAN, bytes((7, 0, 0, 0, 0)))) == []


@pytest.mark.parametrize(
    ("model", "command"), [("A2", Command.SET_MOTOR_PWM), ("S1", Command.HQ_MOTOR_SPEED_CTRL)]
)
def test_nothing_is_seen_until_the_motor_turns_and_any_request_ends_the_scan(
    tmp_path: Path, model: str, command: Command
) -> None:
    host = Host(tmp_path, model)
    assert [type(e) for e in host.ask(encode_request(Command.SCAN))] == [ScanStarted]
    assert host.listen(SECOND) == []
    assert host.robot.seconds(SECOND) == 0.0
    host.ask(encode_request(command, b"\x58\x02"), SECOND)
    assert [type(e) for e in host.ask(encode_request(Command.SCAN), SECOND)] == [ScanStarted]
    assert host.listen(SECOND + 200 * MS) == []
    host.listen(SECOND + 400 * MS)
    assert host.robot.seconds(2 * SECOND) == pytest.approx(0.6)
    samples = host.listen(2 * SECOND)
    assert all(isinstance(event, Samples) for event in samples)
    assert samples
    assert host.ask(encode_request(Command.STOP), 2 * SECOND) == []
    assert host.listen(3 * SECOND) == []


def test_a_protection_stop_lasts_until_a_reset_after_its_cause(tmp_path: Path) -> None:
    host = Host(tmp_path, "A1")
    error = [Health(HealthStatus.ERROR, ERROR_CODE)]
    host.ask(encode_request(Command.SCAN), SECOND)
    assert host.listen(2 * SECOND)
    host.device.protect(True)
    assert host.listen(3 * SECOND) == []
    assert host.ask(encode_request(Command.GET_HEALTH), 3 * SECOND) == error
    assert host.ask(encode_request(Command.SCAN), 3 * SECOND) == []
    host.device.feed(encode_request(Command.RESET), 3 * SECOND)
    assert host.device.poll(3 * SECOND) == RESET_BANNER
    assert host.ask(encode_request(Command.GET_HEALTH), 3 * SECOND + 100 * MS) == []  # it reboots
    assert host.ask(encode_request(Command.GET_HEALTH), 4 * SECOND) == error
    host.device.protect(False)
    assert host.ask(encode_request(Command.GET_HEALTH), 4 * SECOND) == error
    host.device.feed(encode_request(Command.RESET), 4 * SECOND)
    assert host.ask(encode_request(Command.GET_HEALTH), 5 * SECOND) == [Health(HealthStatus.GOOD, 0)]


def test_it_goes_on_scanning_when_the_host_goes_away_and_forgets_all_without_power(tmp_path: Path) -> None:
    host = Host(tmp_path, "A2")
    host.ask(encode_request(Command.SET_MOTOR_PWM, b"\x94\x02"))
    host.ask(encode_request(Command.SCAN))
    host.listen(SECOND)
    assert host.listen(60 * SECOND)
    host.device.power_on(61 * SECOND)
    assert host.listen(62 * SECOND) == []
    host.ask(encode_request(Command.SCAN), 62 * SECOND)
    assert host.listen(70 * SECOND) == []  # the motor too


def test_ultra_beams_leave_the_head_at_an_angle_that_depends_on_the_distance(tmp_path: Path) -> None:
    host = Host(tmp_path, "A1")
    host.ask(encode_request(Command.EXPRESS_SCAN, bytes((3, 0, 0, 0, 0))), SECOND)
    host.listen(SECOND)
    samples = [e for e in host.listen(2 * SECOND) if isinstance(e, Samples)]
    angle = np.concatenate([s.columns.angle_q14 for s in samples])
    distance = np.concatenate([s.columns.distance_q2 for s in samples]) / 4000
    residual = np.rad2deg(np.unwrap(angle / 32768 * np.pi)) - np.arange(len(angle)) * 360 * 10 * 127e-6
    near, far = (distance > 0.5) & (distance < 1.5), distance > 4.0
    # Spec of the optics: some 6.2 to 7.1 deg for the near ones, 7.7 for the far ones.
    assert 0.5 < np.mean(residual[near]) - np.mean(residual[far]) < 1.5
