"""An emulated SLAMTEC RPLIDAR on the robot, any model, in all its scan modes."""

import struct
from dataclasses import dataclass, field

import numpy as np

from companion.sim.lidar_models import LIDAR_MODELS, ScanMode
from companion.sim.lidar_packets import OPTICS, encode_samples, ultra_offset
from companion.sim.robot import Robot
from companion.sim.scenario import LidarTable
from drivers.rplidar_protocol import (
    PACKET_SAMPLES,
    AccBoardFlag,
    Answer,
    AnswerType,
    Command,
    ConfKey,
    DeviceInfo,
    Health,
    HealthStatus,
    LidarConf,
    RequestDecoder,
    SampleRate,
    encode_answer,
    encode_descriptor,
)
from estimators.geometry import transform_each
from estimators.messages import FloatArray

ROTATION_RPM, ROTATION_PWM = 600, 660
RESET_BANNER = b"RP LIDAR System.\r\nFirmware Ver 1.29, HW Ver 7\r\nModel: emulated\r\n"
ERROR_CODE = 0x8002
_CONF_FIRMWARE, _CONF_SERIES = (1, 24), 4
_PWM_SERIES, _RPM_SERIES = (2, 3), 6
_REBOOT_NS = 400_000_000
_SPIN_UP_NS = 300_000_000


@dataclass(slots=True)
class _RunningScan:
    """A scan that was asked for: when its first sample was due, samples sent, distances measured ahead."""

    mode: ScanMode
    begin_ns: int | None = None
    sent: int = 0
    ahead: FloatArray = field(default_factory=lambda: np.empty(0))


class RplidarDevice:
    """An RPLIDAR on the robot: answers requests, and scans while asked to and turning.

    Args:
        robot: that carries it; the walk begins with the first scan.
        rng: noise of its distances.
    """

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        self._robot = robot
        self._rng = rng
        self._lidar: LidarTable = robot.scenario.file.lidar
        self._model = LIDAR_MODELS[self._lidar.model]
        self._series = self._model.model >> 4
        self._has_conf = self._model.firmware >= _CONF_FIRMWARE or self._series >= _CONF_SERIES
        self._mounting = robot.scenario.config.lidar_mounting()
        self._height = robot.scenario.config.body.height + self._lidar.height
        self._protecting = False
        self.power_on(0)

    def power_on(self, now_ns: int) -> None:
        """Boot: nothing runs; only an A1 and a C1 turn by themselves."""
        self._requests = RequestDecoder()
        self._answers = b""
        self._error = self._protecting
        self._deaf_until_ns = now_ns
        needs_command = self._series in _PWM_SERIES or self._series >= _RPM_SERIES
        self._turning_since_ns = None if needs_command else now_ns
        self._stop()

    def protect(self, active: bool) -> None:
        """While active, and then until a reset, it does not scan and reports an error."""
        self._protecting = active
        if active and not self._error:
            self._error = True
            self._stop()

    def feed(self, data: bytes, now_ns: int) -> None:
        """Obey requests; any request ends a running scan, as on the real device."""
        if now_ns < self._deaf_until_ns:
            return
        for command, payload in self._requests.feed(data):
            self._stop()
            self._obey(command, payload, now_ns)

    def poll(self, now_ns: int) -> bytes:
        """Answers, and the packets whose last sample was taken by now."""
        out, self._answers = self._answers, b""
        scan = self._scan
        if scan is None or self._turning_since_ns is None:
            return out
        if scan.begin_ns is None:
            if now_ns < self._turning_since_ns + _SPIN_UP_NS:
                return out
            scan.begin_ns = now_ns
            self._robot.begin(now_ns)
        kind = scan.mode.kind
        group = PACKET_SAMPLES[kind]
        # An ultra packet also tells of the first sample of the next one.
        extra = 1 if kind is AnswerType.ULTRA_SCAN else 0
        taken = int((now_ns - scan.begin_ns) // (scan.mode.sample_us * 1000))
        count = (taken - extra - scan.sent) // group * group
        if count > 0:
            turns = self._turns(scan.mode, scan.sent, count + extra)
            fresh = self._measure(scan, turns[1 + len(scan.ahead) :])
            distances = np.append(scan.ahead, fresh)
            out += encode_samples(kind, turns[: count + 1], distances, is_first=scan.sent == 0)
            scan.sent += count
            scan.ahead = distances[count:]
        return out

    def _obey(self, command: int, payload: bytes, now_ns: int) -> None:
        if self._error and command not in (Command.RESET, Command.GET_INFO, Command.GET_HEALTH):
            return
        modes = self._model.modes
        match command:
            case Command.GET_INFO:
                serial = f"{self._robot.scenario.seed:032X}"[-32:]
                self._answer(DeviceInfo(self._model.model, self._model.firmware, 7, serial))
            case Command.GET_HEALTH:
                self._answer(
                    Health(HealthStatus.ERROR, ERROR_CODE) if self._error else Health(HealthStatus.GOOD, 0)
                )
            case Command.GET_SAMPLERATE:
                self._answer(SampleRate(round(modes[0].sample_us), round(modes[1].sample_us)))
            case Command.GET_LIDAR_CONF if self._has_conf:
                self._answer_conf(payload)
            case Command.GET_ACC_BOARD_FLAG:
                self._answer(AccBoardFlag(has_motor_pwm=self._series in _PWM_SERIES))
            case Command.SET_MOTOR_PWM if self._series in _PWM_SERIES:
                self._turn(payload, now_ns)
            case Command.HQ_MOTOR_SPEED_CTRL if self._series >= _RPM_SERIES:
                self._turn(payload, now_ns)
            case Command.SCAN | Command.FORCE_SCAN:
                self._begin(modes[0])
            case Command.EXPRESS_SCAN:
                # Without configuration queries there is one express mode, and it is called 0.
                number = payload[0] if self._has_conf else 1
                if number < len(modes) and modes[number].kind is not AnswerType.STANDARD_SCAN:
                    self._begin(modes[number])
            case Command.HQ_SCAN:
                self._begin(ScanMode("HQ", AnswerType.HQ_SCAN, modes[0].sample_us))
            case Command.RESET:
                self.power_on(now_ns)
                self._deaf_until_ns = now_ns + _REBOOT_NS
                self._answers += RESET_BANNER

    def _answer(self, answer: Answer) -> None:
        self._answers += encode_answer(answer)

    def _answer_conf(self, payload: bytes) -> None:
        """A key that the device does not know, and a mode that it does not have, stay unanswered."""
        key, number = struct.unpack("<IH", payload.ljust(6, b"\0")[:6])
        if number >= len(self._model.modes):
            return
        mode = self._model.modes[number]
        values = {
            ConfKey.DESIRED_ROTATION: struct.pack("<HH", ROTATION_RPM, ROTATION_PWM),
            ConfKey.MODE_COUNT: struct.pack("<H", len(self._model.modes)),
            ConfKey.TYPICAL_MODE: struct.pack("<H", self._model.typical),
            ConfKey.MODE_SAMPLE_TIME: struct.pack("<I", round(mode.sample_us * 256)),
            ConfKey.MODE_MAX_DISTANCE: struct.pack("<I", round(self._model.max_distance * 256)),
            ConfKey.MODE_ANSWER_TYPE: bytes((mode.kind,)),
            ConfKey.MODE_NAME: mode.name.encode() + b"\0",
        }
        if key in values:
            self._answer(LidarConf(key, values[key]))

    def _turn(self, payload: bytes, now_ns: int) -> None:
        if not any(payload):
            self._turning_since_ns = None
        elif self._turning_since_ns is None:
            self._turning_since_ns = now_ns

    def _stop(self) -> None:
        self._scan: _RunningScan | None = None

    def _begin(self, mode: ScanMode) -> None:
        """Answer with the descriptor; samples follow once the head turns steadily."""
        self._answers += encode_descriptor(mode.kind)
        self._scan = _RunningScan(mode)

    def _turns(self, mode: ScanMode, first: int, count: int) -> FloatArray:
        """Turns of the head since the scan began, before a sample and at each from it on, (count + 1,)."""
        taken = np.arange(first, first + count + 1, dtype=np.float64)
        return taken * (mode.sample_us * 1e-6 * self._lidar.rotation_hz)

    def _measure(self, scan: _RunningScan, turns: FloatArray) -> FloatArray:
        """Distances [m] of the samples at these turns; 0 where nothing comes back."""
        assert scan.begin_ns is not None
        begin = self._robot.seconds(scan.begin_ns)
        times = np.asarray(turns / self._lidar.rotation_hz + begin, dtype=np.float64)
        pose = self._robot.scenario.trajectory.at(times).pose
        origins = transform_each(pose, self._mounting[None, :2])
        beams = pose[:, 2] + self._mounting[2] - 2.0 * np.pi * turns
        distances = self._cast(origins, beams)
        if scan.mode.kind is AnswerType.ULTRA_SCAN:
            # The optics see near targets at another angle, which changes what they see.
            for _ in range(2):
                distances = self._cast(origins, beams - OPTICS + ultra_offset(distances))
        distances = distances + self._rng.standard_normal(len(turns)) * self._lidar.sigma
        missing = self._rng.random(len(turns)) < self._lidar.dropout
        seen = (distances >= self._lidar.min_range) & (distances <= self._lidar.max_range) & ~missing
        return np.where(seen, distances, 0.0)

    def _cast(self, origins: FloatArray, beams: FloatArray) -> FloatArray:
        return self._robot.scenario.world.ray_cast(origins, beams, self._height)
