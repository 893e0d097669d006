"""RPLIDARs of every generation as a driver meets them, and the line between the two, in simulated time."""

import struct
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from drivers.rplidar import Rplidar
from drivers.rplidar_protocol import (
    AccBoardFlag,
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
    encode_conf_request,
    encode_request,
)
from estimators.messages import Scan
from tests import vectors
from tests.drivers.rplidar_streams import MS, SECOND, T0_NS, Stream, stream

STANDARD, EXPRESS, ULTRA, DENSE = (
    AnswerType.STANDARD_SCAN,
    AnswerType.EXPRESS_SCAN,
    AnswerType.ULTRA_SCAN,
    AnswerType.DENSE_SCAN,
)
SERIAL = "00" * 16
GOOD = Health(HealthStatus.GOOD, 0)
BANNER = b"RP LIDAR System.\r\nFirmware Ver 1.29, HW Ver 7\r\nModel: 18\r\n"
SCAN_SECONDS = 6.0

STOP, INFO, HEALTH, RESET, RATE, SCAN, FLAG = (
    encode_request(command, payload)
    for command, payload in (
        (Command.STOP, b""),
        (Command.GET_INFO, b""),
        (Command.GET_HEALTH, b""),
        (Command.RESET, b""),
        (Command.GET_SAMPLERATE, b""),
        (Command.SCAN, b""),
        (Command.GET_ACC_BOARD_FLAG, bytes(4)),
    )
)
TYPICAL, COUNT, ROTATION = (
    encode_conf_request(key) for key in (ConfKey.TYPICAL_MODE, ConfKey.MODE_COUNT, ConfKey.DESIRED_ROTATION)
)
kind_of, name_of, time_of = (
    partial(encode_conf_request, key)
    for key in (ConfKey.MODE_ANSWER_TYPE, ConfKey.MODE_NAME, ConfKey.MODE_SAMPLE_TIME)
)


def express(mode: int) -> bytes:
    """Request for a scan in the mode of that number."""
    return encode_request(Command.EXPRESS_SCAN, bytes((mode, 0, 0, 0, 0)))


def pwm(value: int) -> bytes:
    """Motor command of A2 and A3."""
    return encode_request(Command.SET_MOTOR_PWM, struct.pack("<H", value))


def rpm(value: int) -> bytes:
    """Motor command of the S series."""
    return encode_request(Command.HQ_MOTOR_SPEED_CTRL, struct.pack("<H", value))


Fault = Callable[[bytes, bytes], tuple[bytes, int]]


class FakeDevice:
    """A lidar on a serial line; it obeys requests, and sends a scan at the pace of its samples.

    Args:
        answers: to requests, byte for byte; what is missing stays unanswered.
        scans: that requests begin.
        motor: command that makes it turn; without, it turns by itself. No samples come while it stands.

    Attributes:
        fault: what happens to an answer on its way: request and answer in, answer and delay [ms] out.
        lost: requests that do not arrive, each once.
        after_reset: answers that change with a reset.
        log: requests and when they were sent [ns].
        turns: whether the head turns.
    """

    def __init__(
        self, answers: Mapping[bytes, bytes], scans: Mapping[bytes, Stream], motor: Command | None = None
    ) -> None:
        self.answers = dict(answers)
        self.scans = dict(scans)
        self.after_reset: dict[bytes, bytes] = {}
        self.fault: Fault = lambda _, answer: (answer, 0)
        self.lost: list[bytes] = []
        self.log: list[tuple[int, bytes]] = []
        self.turns = motor is None
        self._motor = motor
        self._requests = RequestDecoder()
        self._answers: list[tuple[int, bytes]] = []
        self._busy_until_ns = 0
        self._scan = (b"", np.empty(0, np.int64))
        self._scan_sent = 0

    def exchange(self, data: bytes, now_ns: int) -> bytes:
        """What the device sends by now, after it was sent `data`."""
        for command, payload in self._requests.feed(data):
            request = encode_request(command, payload)
            self.log.append((now_ns, request))
            if request in self.lost:
                self.lost.remove(request)
            else:
                self._obey(request, Command(command), payload, now_ns)
        due = [answer for due_ns, answer in self._answers if due_ns <= now_ns]
        self._answers = [(due_ns, answer) for due_ns, answer in self._answers if due_ns > now_ns]
        sent, self._scan_sent = self._scan_sent, int(np.searchsorted(self._scan[1], now_ns, side="right"))
        return b"".join(due) + self._scan[0][sent : self._scan_sent]

    def scan_from(self, source: Stream, now_ns: int) -> None:
        """Begin a scan, or pretend that it began at some time."""
        data, arrivals = source.line()
        if not self.turns:
            data, arrivals = source.descriptor, arrivals[: len(source.descriptor)]
        self._scan, self._scan_sent = (data, arrivals - T0_NS + max(now_ns, self._busy_until_ns)), 0

    def stall(self) -> None:
        """Send nothing more until the next request."""
        self._scan, self._scan_sent = (b"", np.empty(0, np.int64)), 0

    @property
    def heard(self) -> list[bytes]:
        """Requests so far."""
        return [request for _, request in self.log]

    def when(self, request: bytes) -> list[int]:
        """Times at which a request came [ns]."""
        return [now_ns for now_ns, logged in self.log if logged == request]

    def _obey(self, request: bytes, command: Command, payload: bytes, now_ns: int) -> None:
        self.stall()  # any request ends a scan
        if command == self._motor:
            self.turns = any(payload)
        if request == RESET:
            self.answers |= self.after_reset
        if request in self.answers:
            answer, delay_ms = self.fault(request, self.answers[request])
            self._busy_until_ns = max(self._busy_until_ns, now_ns + delay_ms * MS)  # nothing overtakes
            self._answers.append((self._busy_until_ns, answer))
        if request in self.scans:
            self.scan_from(self.scans[request], now_ns)


Modes = Sequence[tuple[str, AnswerType, int]]
"""Name, kind of packets and sample duration [ns] of each mode."""
OF_A1: Modes = [
    ("Standard", STANDARD, 508_000),
    ("Express", EXPRESS, 254_000),
    ("Boost", ULTRA, 127_000),
    ("Sensitivity", ULTRA, 127_000),
    ("Stability", ULTRA, 201_000),
]
OF_A3: Modes = [(name, kind, duration // 2) for name, kind, duration in OF_A1]
OF_S1: Modes = [("Standard", STANDARD, 244_000), ("DenseBoost", DENSE, 108_000)]
MOTORS = {2: Command.SET_MOTOR_PWM, 3: Command.SET_MOTOR_PWM, 6: Command.HQ_MOTOR_SPEED_CTRL}


def conf_answer(key: ConfKey, layout: str, *values: int) -> bytes:
    """Answer to GET_LIDAR_CONF."""
    return encode_answer(LidarConf(key, struct.pack(layout, *values)))


def _with_conf(model: int, firmware: tuple[int, int], modes: Modes, typical: int) -> FakeDevice:
    answers = {
        INFO: encode_answer(DeviceInfo(model, firmware, 7, SERIAL)),
        HEALTH: encode_answer(GOOD),
        RESET: BANNER,
        FLAG: encode_answer(AccBoardFlag(model >> 4 in (2, 3))),
        TYPICAL: conf_answer(ConfKey.TYPICAL_MODE, "<H", typical),
        COUNT: conf_answer(ConfKey.MODE_COUNT, "<H", len(modes)),
        ROTATION: conf_answer(ConfKey.DESIRED_ROTATION, "<HH", 600, 660),
    }
    scans = {}
    for number, (name, kind, sample_ns) in enumerate(modes):
        answers[kind_of(number)] = conf_answer(ConfKey.MODE_ANSWER_TYPE, "<B", kind)
        answers[name_of(number)] = encode_answer(LidarConf(ConfKey.MODE_NAME, name.encode() + b"\0"))
        answers[time_of(number)] = conf_answer(ConfKey.MODE_SAMPLE_TIME, "<I", sample_ns * 256 // 1000)
        request = SCAN if kind is STANDARD else express(number)
        scans[request] = stream(kind, SCAN_SECONDS, sample_ns)
    return FakeDevice(answers, scans, MOTORS.get(model >> 4))


def _without_conf(model: int, firmware: tuple[int, int]) -> FakeDevice:
    answers = {
        INFO: encode_answer(DeviceInfo(model, firmware, 7, SERIAL)),
        HEALTH: encode_answer(GOOD),
        RESET: BANNER,
        RATE: encode_answer(SampleRate(508, 254)),
        FLAG: encode_answer(AccBoardFlag(model >> 4 == 2)),
    }
    scans = {
        SCAN: stream(STANDARD, SCAN_SECONDS, 508_000),
        express(0): stream(EXPRESS, SCAN_SECONDS, 254_000),
    }
    return FakeDevice(answers, scans, MOTORS.get(model >> 4))


def a1(firmware: tuple[int, int] = (1, 29)) -> FakeDevice:
    """An A1; firmware below 1.24 knows no configuration."""
    return _with_conf(0x18, firmware, OF_A1, 3) if firmware >= (1, 24) else _without_conf(0x18, firmware)


def a2m8() -> FakeDevice:
    """An A2 with old firmware."""
    return _without_conf(0x28, (1, 20))


def a3() -> FakeDevice:
    """An A3; its sample durations are half of an A1's, as its sample rates say."""
    return _with_conf(0x31, (1, 29), OF_A3, 3)


def c1() -> FakeDevice:
    """A C1; its modes are assumed."""
    return _with_conf(0x41, (1, 1), OF_S1, 1)


def s1() -> FakeDevice:
    """An S1."""
    return _with_conf(0x61, (1, 28), OF_S1, 1)


def a2m12(session: str) -> FakeDevice:
    """The device that the vendor's SDK talked to in the session of the test vectors."""
    answers = {}
    for exchange in vectors.load(session)["exchanges"]:
        if exchange["device"] and exchange["command"] not in ("SCAN", "EXPRESS_SCAN"):
            answers[bytes.fromhex(exchange["host"])] = bytes.fromhex("".join(exchange["device"]))
    scans = {
        SCAN: stream(STANDARD, SCAN_SECONDS, 252_000),
        express(3): stream(ULTRA, SCAN_SECONDS, 63_000),
    }
    return FakeDevice(answers, scans, Command.SET_MOTOR_PWM)


class Line:
    """A driver and a device, connected; time goes on in steps, and an answer takes none."""

    def __init__(self, device: FakeDevice, **config: str | int) -> None:
        self.device = device
        self.rplidar = Rplidar(Rplidar.Config.model_validate(config))
        self.arrived: list[tuple[bytes, int]] = []
        self.now_ns = SECOND
        self.rplidar.connected(self.now_ns)

    def run(self, seconds: float, step_ns: int = 4 * MS) -> list[Scan]:
        """Scans of this time."""
        end_ns = self.now_ns + round(seconds * SECOND)
        scans = []
        while self.now_ns < end_ns:
            request = self.rplidar.poll(self.now_ns)
            data = self.device.exchange(request, self.now_ns)
            if data:
                self.arrived.append((data, self.now_ns))
                scans += [scan for scan in self.rplidar.feed(data, self.now_ns) if isinstance(scan, Scan)]
            self.now_ns += step_ns
        return scans
