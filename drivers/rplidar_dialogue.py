"""The conversation that makes an RPLIDAR scan, in its best mode, and makes it scan again when it stops.

No I/O and no clock: events of the decoder go in, requests come out when they are due. The course of the talk
is written as generators, which give what is to be said and get what was answered, so that it reads in the
order in which it happens.

Source: Slamtec interface protocol rev 2.2, figure 5-1; rplidar_sdk @99478e5 sl_lidar_driver.cpp.
"""

import logging
import struct
from collections.abc import Callable, Generator
from typing import NamedTuple, TypeAlias, TypeVar

from drivers.rplidar_protocol import (
    AccBoardFlag,
    Answer,
    AnswerType,
    Command,
    ConfKey,
    DeviceInfo,
    Health,
    HealthStatus,
    LidarConf,
    SampleRate,
    ScanStarted,
    encode_conf_request,
    encode_request,
)
from estimators.messages import Scan

_log = logging.getLogger(__name__)

_MS = 1_000_000
_STOPPING_NS = 80 * _MS  # after STOP a buffer of old scan bytes is still on its way (SDK: 100 ms in all)
_SILENCE_NS = 20 * _MS
_ANSWER_NS = 1000 * _MS
_OPTIONAL_NS = 300 * _MS  # firmware that lacks a question may not answer at all
_REBOOT_NS = 1000 * _MS
_MOTOR_NS = 10 * _MS  # pause after a motor command (SDK)
_DESCRIPTOR_NS = 1500 * _MS
_FIRST_SCAN_NS = 5000 * _MS  # samples come only once the rotation is stable
_NEXT_SCAN_NS = 2000 * _MS  # several revolutions of the slowest
_PATIENCE = 3  # attempts before the device is reset
_MOST_MODES = 16  # of which names are asked for
_LAST_MODE = 255  # the request to scan has one byte for it

_SAMPLERATE_FIRMWARE = (1, 17)
_CONF_FIRMWARE = (1, 24)
_CONF_SERIES = 4  # C and later always have it
_BOARD_SERIES = 2  # A2 and later may have an accessory board
_RPM_SERIES = 6  # S and later regulate their speed

AUTO = "auto"
MAX_PWM, MAX_RPM = 1023, 1500
Heard: TypeAlias = Answer | ScanStarted | Scan
A = TypeVar("A", bound=Heard)
T = TypeVar("T")


class _Turn(NamedTuple):
    """What is said, and how long an answer is waited for."""

    request: bytes
    wait_ns: int
    awaits: Callable[[Heard], bool] = lambda _: False


_Talk: TypeAlias = Generator[_Turn, Heard | None, T]


class _Mode(NamedTuple):
    """A way of scanning, with its number in requests; the standard scan has a request of its own."""

    number: int
    name: str
    is_standard: bool


_STANDARD = _Mode(0, "standard", is_standard=True)
_LEGACY_EXPRESS = _Mode(0, "express", is_standard=False)


class _Motor(NamedTuple):
    """A way to set the speed of a motor. Answers have no checksum: not every reference is believed."""

    command: Command
    default: int
    believed: range


_BY_PWM = _Motor(Command.SET_MOTOR_PWM, 660, range(200, MAX_PWM + 1))
_BY_RPM = _Motor(Command.HQ_MOTOR_SPEED_CTRL, 600, range(300, MAX_RPM + 1))


class Dialogue:
    """Talk with one device, from the opening of its port to the next.

    Args:
        mode: name of a scan mode as the device has it, or `AUTO` for the one it recommends.
        motor_pwm: for devices with an accessory board; 0 = the device's own reference.
        motor_rpm: for devices that regulate their speed; 0 = the device's own reference.
    """

    def __init__(self, mode: str, motor_pwm: int, motor_rpm: int) -> None:
        self.mode = ""
        """Name of the scan mode in use, once it was chosen."""
        self._wanted = mode
        self._motor_pwm = motor_pwm
        self._motor_rpm = motor_rpm
        self._motor_off = b""
        self._talk: _Talk[None] | None = None
        self._turn = _Turn(b"", 0)
        self._deadline_ns = 0
        self._heard: Heard | None = None
        self._bytes_came = False
        self._refusals = 0
        self._complaints: set[str] = set()  # since the last scan

    def connected(self, now_ns: int) -> None:
        """The port is open: the next `poll` begins the talk."""
        self.mode = ""
        self._talk = self._converse()
        self._turn = _Turn(b"", 0)
        self._deadline_ns = now_ns
        self._heard = None
        self._refusals = 0

    def hear_bytes(self) -> None:
        """The device sent something, understood or not."""
        self._bytes_came = True

    def hear(self, event: Heard) -> None:
        """The device answered, began a scan, or completed a revolution."""
        if self._heard is None and self._turn.awaits(event):
            self._heard = event

    def poll(self, now_ns: int) -> bytes:
        """The request that is due now, if any."""
        if self._talk is None or (self._heard is None and now_ns < self._deadline_ns):
            return b""
        heard, self._heard = self._heard, None
        self._turn = self._talk.send(heard)
        self._deadline_ns = now_ns + self._turn.wait_ns
        return self._turn.request

    def closing(self) -> list[bytes]:
        """STOP, and the motor off if it was switched on from here."""
        return [encode_request(Command.STOP), *([self._motor_off] if self._motor_off else [])]

    def _converse(self) -> _Talk[None]:
        """Everything, over and over: whatever goes wrong, it starts again with STOP."""
        unanswered = 0
        while True:
            is_quiet = yield from self._quieten()
            info = yield from self._ask(Command.GET_INFO, DeviceInfo)
            health = None if info is None else (yield from self._ask(Command.GET_HEALTH, Health))
            if info is None or health is None:
                unanswered += 1
                self._complain(
                    "does not answer (power, cable, baud rate?)"
                    if is_quiet
                    else "does not answer, but something else arrives (other device, other baud rate?)"
                )
                if unanswered % _PATIENCE == 0:
                    yield from self._reset()
                continue
            unanswered = 0
            if health.status is HealthStatus.ERROR:
                self._complain(f"stopped itself with error 0x{health.error_code:04X}; resetting it")
                yield from self._reset()
            else:
                yield from self._start(info)

    def _quieten(self) -> _Talk[bool]:
        """End what an earlier session left running; whether the device is silent now."""
        for _ in range(_PATIENCE):
            yield _Turn(encode_request(Command.STOP), _STOPPING_NS)
            self._bytes_came = False
            yield _Turn(b"", _SILENCE_NS)
            if not self._bytes_came:
                return True
        return False

    def _reset(self) -> _Talk[None]:
        yield _Turn(encode_request(Command.RESET), _REBOOT_NS)

    def _start(self, info: DeviceInfo) -> _Talk[None]:
        """Choose a mode, turn the motor on, and scan until scans stop."""
        has_conf = info.firmware >= _CONF_FIRMWARE or info.series >= _CONF_SERIES
        if not has_conf and info.firmware >= _SAMPLERATE_FIRMWARE:
            yield from self._ask_for(SampleRate, encode_request(Command.GET_SAMPLERATE))
        modes = yield from self._modes_to_try(has_conf)
        # A mode that gave nothing twice makes place for a plainer one.
        mode = modes[self._refusals // 2 % len(modes)]
        if has_conf:
            mode = yield from self._described(mode)
        if mode is _STANDARD and self._wanted.lower() != _STANDARD.name:
            self._complain("gets no better mode than the standard scan")
        yield from self._turn_motor(info, has_conf)
        self.mode = mode.name
        request = (
            encode_request(Command.SCAN)
            if mode.is_standard
            else encode_request(Command.EXPRESS_SCAN, struct.pack("<B4x", mode.number))
        )
        started = yield _Turn(request, _DESCRIPTOR_NS, lambda event: isinstance(event, ScanStarted))
        wait_ns = _FIRST_SCAN_NS
        while started and (yield _Turn(b"", wait_ns, lambda event: isinstance(event, Scan))):
            wait_ns = _NEXT_SCAN_NS
            self._refusals -= self._refusals % 2  # the mode that works is the one to start again in
            self._complaints.clear()
        if wait_ns == _FIRST_SCAN_NS:
            self._refusals += 1
            self._complain(f"gives no scan in mode {mode.name}; starting over")
            if self._refusals % (2 * len(modes)) == 0:
                yield from self._reset()
        else:
            self._complain("stopped scanning; starting over")

    def _modes_to_try(self, has_conf: bool) -> _Talk[list[_Mode]]:
        """The mode asked for, or else the device's own choice; and then the standard scan."""
        chosen = None
        if self._wanted.lower() != AUTO:
            offered = (yield from self._named_modes()) if has_conf else [_STANDARD, _LEGACY_EXPRESS]
            chosen = next((mode for mode in offered if mode.name.lower() == self._wanted.lower()), None)
            if chosen is None:
                names = ", ".join(mode.name for mode in offered) or "none that it names"
                self._complain(f"has no scan mode {self._wanted!r}, it has {names}; taking its own choice")
        if chosen is None:
            chosen = (yield from self._typical_mode()) if has_conf else _LEGACY_EXPRESS
        return list(dict.fromkeys((chosen, _STANDARD)))

    def _named_modes(self) -> _Talk[list[_Mode]]:
        conf = yield from self._ask_conf(ConfKey.MODE_COUNT)
        names: list[str] = []
        for number in range(min((conf.mode_count if conf else None) or 0, _MOST_MODES)):
            conf = yield from self._ask_conf(ConfKey.MODE_NAME, number)
            name = conf.mode_name if conf else None
            # Answers do not say of which mode they are: the same again is a late one, of the mode before.
            if not name or name in names:
                break
            names.append(name)
        return [_Mode(number, name, is_standard=False) for number, name in enumerate(names)]

    def _typical_mode(self) -> _Talk[_Mode]:
        conf = yield from self._ask_conf(ConfKey.TYPICAL_MODE)
        number = conf.typical_mode if conf else None
        if number is None or number > _LAST_MODE:
            return _STANDARD
        return _Mode(number, f"{number}", is_standard=False)

    def _described(self, mode: _Mode) -> _Talk[_Mode]:
        """The mode with its name; the standard scan when its packets are of no known kind.

        The duration of a sample is asked for last: it holds for the scan that begins next.
        """
        if not mode.is_standard:
            conf = yield from self._ask_conf(ConfKey.MODE_ANSWER_TYPE, mode.number)
            kind = conf.answer_type if conf else None
            if kind is None:
                mode = _STANDARD
            else:
                conf = yield from self._ask_conf(ConfKey.MODE_NAME, mode.number)
                name = (conf.mode_name if conf else None) or mode.name
                mode = _Mode(mode.number, name, kind is AnswerType.STANDARD_SCAN)
        yield from self._ask_conf(ConfKey.MODE_SAMPLE_TIME, mode.number)
        return mode

    def _turn_motor(self, info: DeviceInfo, has_conf: bool) -> _Talk[None]:
        """Make it turn: A1 does by the port's DTR line, C1 by itself. Source: rplidar_sdk setMotorSpeed."""
        if info.series >= _RPM_SERIES:
            motor, speed = _BY_RPM, self._motor_rpm
        elif info.series >= _BOARD_SERIES:
            request = encode_request(Command.GET_ACC_BOARD_FLAG, bytes(4))
            flag = yield from self._ask_for(AccBoardFlag, request)
            if flag is None or not flag.has_motor_pwm:
                return
            motor, speed = _BY_PWM, self._motor_pwm
        else:
            return
        if not speed and has_conf:
            conf = yield from self._ask_conf(ConfKey.DESIRED_ROTATION)
            rpm, pwm = (conf.desired_rotation if conf else None) or (0, 0)
            reference = rpm if motor is _BY_RPM else pwm
            speed = reference if reference in motor.believed else 0
        self._motor_off = encode_request(motor.command, bytes(2))
        yield _Turn(encode_request(motor.command, struct.pack("<H", speed or motor.default)), _MOTOR_NS)

    def _ask(self, command: Command, kind: type[A]) -> _Talk[A | None]:
        answer = yield _Turn(encode_request(command), _ANSWER_NS, lambda event: isinstance(event, kind))
        assert answer is None or isinstance(answer, kind)
        return answer

    def _ask_conf(self, key: ConfKey, mode: int | None = None) -> _Talk[LidarConf | None]:
        return (
            yield from self._ask_for(
                LidarConf, encode_conf_request(key, mode), lambda answer: answer.key == key
            )
        )

    def _ask_for(
        self, kind: type[A], request: bytes, is_meant: Callable[[A], bool] = lambda _: True
    ) -> _Talk[A | None]:
        """Ask what a device may not know; once more where an answer was lost, not to do without it."""
        for _ in range(2):
            answer = yield _Turn(
                request, _OPTIONAL_NS, lambda event: isinstance(event, kind) and is_meant(event)
            )
            if answer is not None:
                break
        assert answer is None or isinstance(answer, kind)
        return answer

    def _complain(self, what: str) -> None:
        """Warn, but not of the same thing over and over."""
        if what not in self._complaints:
            self._complaints.add(what)
            _log.warning("RPLIDAR %s", what)
