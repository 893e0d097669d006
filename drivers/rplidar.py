"""SLAMTEC RPLIDAR (A1, A2, A3, C1, S series): bytes to scans, and the dialogue that makes it scan.

Source: Slamtec interface protocol rev 2.2, figure 5-1; rplidar_sdk @99478e5 sl_lidar_driver.cpp.
"""

import logging
import struct
from collections import deque
from enum import Enum, auto
from itertools import pairwise
from typing import ClassVar, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from drivers.framing import DecodeStats
from drivers.rplidar_decoder import AnswerDecoder
from drivers.rplidar_protocol import (
    PACKET_BYTES,
    PACKET_SAMPLES,
    AccBoardFlag,
    Answer,
    AnswerType,
    Command,
    DeviceInfo,
    Health,
    HealthStatus,
    SampleRate,
    Samples,
    ScanStarted,
    encode_request,
)
from estimators.messages import IntArray, Measurement, Scan

_log = logging.getLogger(__name__)

_MS = 1_000_000
_QUIET_NS = 100 * _MS  # after STOP old scan bytes are still on their way (SDK: 100 ms)
_ANSWER_NS = 1000 * _MS
_REBOOT_NS = 2000 * _MS
_MOTOR_NS = 10 * _MS  # pause after a motor command (SDK)
_FIRST_SAMPLES_NS = 3000 * _MS  # samples come only once the rotation is stable
_SILENCE_NS = 2000 * _MS

_SAMPLERATE_FIRMWARE = (1, 17)
_DEFAULT_SAMPLE_NS = {AnswerType.STANDARD_SCAN: 500_000, AnswerType.EXPRESS_SCAN: 250_000}
_MIN_SAMPLES = 30  # fewer are not a revolution
_MAX_REVOLUTION_NS = 1000 * _MS  # slower than any of these devices turns
_LOOKBACK_BYTES = 2 * max(PACKET_BYTES.values())  # a pending packet and one that is incomplete


class _State(Enum):
    """What the dialogue waits for."""

    CLOSED = auto()  # a port
    START = auto()  # nothing: STOP is due
    QUIET = auto()  # the end of what an earlier scan still sends
    INFO = auto()  # the answer of that name, and so on
    HEALTH = auto()
    SAMPLE_RATE = auto()
    BOARD_FLAG = auto()
    REBOOT = auto()  # the end of the reboot after RESET
    MOTOR = auto()  # the pause after the motor command
    SCAN = auto()  # samples, and more of them as long as all is well


_AWAITED: dict[_State, type[Answer]] = {
    _State.INFO: DeviceInfo,
    _State.HEALTH: Health,
    _State.SAMPLE_RATE: SampleRate,
    _State.BOARD_FLAG: AccBoardFlag,
}


class _Revolution:
    """Samples since the last start of a revolution; knows whether they may become a `Scan`."""

    def __init__(self) -> None:
        self._parts: list[IntArray] = []  # (4, n): angle_q14, distance_q2, quality, time [ns]
        self._intact = True

    def add(self, part: IntArray) -> None:
        """Append samples; (4, n)."""
        if self._intact and part.shape[1]:
            self._parts.append(part)
            if part[3, -1] - self._parts[0][3, 0] > _MAX_REVOLUTION_NS:
                self.spoil()

    def spoil(self) -> None:
        """It has a gap or takes too long: give up, and keep nothing more of it."""
        self._intact = False
        self._parts.clear()

    def scan(self, min_range: float, max_range: float) -> Scan | None:
        """The finished revolution; None when it is spoilt or has too few samples."""
        if sum(part.shape[1] for part in self._parts) < _MIN_SAMPLES:
            return None
        angle_q14, distance_q2, quality, times_ns = np.concatenate(self._parts, axis=1)
        # clockwise in 65536 parts of a turn -> counter-clockwise in [-pi, pi)
        half_turns = ((32768 - angle_q14) % 65536 - 32768) / 32768
        ranges = distance_q2 / 4000
        ranges[(ranges < min_range) | (ranges > max_range)] = 0.0
        return Scan(
            stamp_ns=int(times_ns[0]),
            angles=half_turns * np.pi,
            ranges=ranges,
            beam_times=(times_ns - times_ns[0]) * 1e-9,
            quality=quality.astype(np.float64),
        )


class Rplidar:
    """Sensor: one `Scan` a revolution, in the lidar frame (x forward at the device's 0 deg, y left).

    Attributes:
        stats: what the decoder made of the bytes.
        info: who the device is, once it said so.
        health: how it is, once it said so.
        dropped_scans: revolutions not given out: with a gap, with too few samples, or too slow.
    """

    class Config(BaseModel):
        """How to run the device."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        mode: Literal["express", "standard"] = "express"
        """Scan mode to ask for; what comes is decoded by its own type."""
        motor_pwm: int = Field(660, ge=0, le=1023)
        """For devices with an accessory board (A2, A3)."""
        motor_rpm: int = Field(600, ge=0, le=1500)
        """Revolutions per minute, for devices that regulate them (S series)."""
        min_range: float = Field(0.15, ge=0)
        """Nearest return that counts [m]; nearer ones become 0, "nothing came back"."""
        max_range: float = Field(12.0, gt=0)
        """Farthest return that counts [m]."""

        @model_validator(mode="after")
        def _ordered(self) -> "Rplidar.Config":
            if self.min_range >= self.max_range:
                raise ValueError(f"min_range {self.min_range} is not below max_range {self.max_range}")
            return self

    MEASURES: ClassVar[frozenset[type]] = frozenset({Scan})

    def __init__(self, config: Config) -> None:
        self.stats = DecodeStats()
        self.info: DeviceInfo | None = None
        self.health: Health | None = None
        self.dropped_scans = 0
        self._config = config
        self._decoder = AnswerDecoder(self.stats)
        self._sample_ns = dict(_DEFAULT_SAMPLE_NS)
        self._chunks: deque[tuple[int, int]] = deque()  # recent: (bytes fed up to its end, stamp)
        self._fed = 0
        self._last_sample_ns: int | None = None
        self._revolution: _Revolution | None = None  # None before the first start of one
        self._state = _State.CLOSED
        self._deadline_ns = 0
        self._answer: Answer | None = None
        self._motor_off = b""

    def feed(self, data: bytes, stamp_ns: int) -> list[Measurement]:
        """Scans whose next revolution began with these bytes; needs no dialogue, so it serves replay.

        A beam's time is the arrival of its packet's last byte, less the sample duration for every later
        beam of that packet, and less the packet duration for every later packet of the same chunk.
        """
        if not data:
            return []
        self._fed += len(data)
        self._chunks.append((self._fed, stamp_ns))
        scans: list[Measurement] = []
        for event in self._decoder.feed(data):
            if isinstance(event, Samples):
                scans += self._assemble(event)
                if self._state is _State.SCAN:
                    self._deadline_ns = max(self._deadline_ns, stamp_ns + _SILENCE_NS)
            elif isinstance(event, ScanStarted):
                self._revolution = None
            else:
                self._note(event)
        while self._chunks[0][0] <= self._fed - _LOOKBACK_BYTES:
            self._chunks.popleft()
        return scans

    def _note(self, answer: Answer) -> None:
        """Keep what the device says of itself; the dialogue goes on if it waited for this."""
        if isinstance(answer, DeviceInfo):
            self.info = answer
        elif isinstance(answer, Health):
            self.health = answer
        elif isinstance(answer, SampleRate):
            self._sample_ns = {
                AnswerType.STANDARD_SCAN: 1000 * max(1, answer.standard_us),
                AnswerType.EXPRESS_SCAN: 1000 * max(1, answer.express_us),
            }
        if self._state in _AWAITED and isinstance(answer, _AWAITED[self._state]):
            self._answer = answer

    def _assemble(self, samples: Samples) -> list[Scan]:
        """Append samples to the revolution, and finish it wherever one of them starts the next."""
        table = np.stack(
            (samples.angle_q14, samples.distance_q2, samples.quality, self._sample_times(samples))
        )
        if samples.scan_type is AnswerType.EXPRESS_SCAN:
            table[2] = 0  # these packets carry no quality
        if samples.gap and self._revolution is not None:
            self._revolution.spoil()
        scans: list[Scan] = []
        starts = np.flatnonzero(samples.starts).tolist()
        if self._revolution is not None:
            self._revolution.add(table[:, : starts[0] if starts else None])
        for first, end in pairwise([*starts, table.shape[1]]):
            if self._revolution is not None:
                scan = self._revolution.scan(self._config.min_range, self._config.max_range)
                if scan is None:
                    self.dropped_scans += 1
                else:
                    scans.append(scan)
            self._revolution = _Revolution()
            self._revolution.add(table[:, first:end])
        return scans

    def _sample_times(self, samples: Samples) -> IntArray:
        """Time of each sample [ns], strictly ascending over all calls.

        Chunks that come sooner than their samples take (a late one came before) have theirs packed evenly
        into the time there is. Only chunks with equal stamps force times past the arrival, by 1 ns each.
        """
        while self._chunks[0][0] < samples.end:
            self._chunks.popleft()
        chunk_end, arrival_ns = self._chunks[0]
        sample_ns = self._sample_ns[samples.scan_type]
        later_packets = (chunk_end - samples.end) // PACKET_BYTES[samples.scan_type]
        last_ns = arrival_ns - later_packets * PACKET_SAMPLES[samples.scan_type] * sample_ns
        number = np.arange(1, len(samples.angle_q14) + 1)
        times_ns: IntArray = last_ns - (number[-1] - number) * sample_ns
        before_ns = self._last_sample_ns
        if before_ns is not None and times_ns[0] <= before_ns:
            times_ns = before_ns + number * max(number[-1], last_ns - before_ns) // number[-1]
        self._last_sample_ns = int(times_ns[-1])
        return times_ns

    def connected(self, now_ns: int) -> None:
        """The port is open: the next `poll` begins the dialogue."""
        self.info = None
        self.health = None
        self._enter(_State.START, now_ns, 0)

    def poll(self, now_ns: int) -> bytes:
        """The request that is due now, if any; any missing answer starts the dialogue over."""
        answer, self._answer = self._answer, None
        if self._state is _State.CLOSED or (answer is None and now_ns < self._deadline_ns):
            return b""
        match self._state, answer:
            case _State.QUIET, _:
                self._decoder.discard()  # a packet that STOP cut short
                return self._enter(_State.INFO, now_ns, _ANSWER_NS, encode_request(Command.GET_INFO))
            case _State.INFO, DeviceInfo():
                return self._enter(_State.HEALTH, now_ns, _ANSWER_NS, encode_request(Command.GET_HEALTH))
            case _State.HEALTH, Health(HealthStatus.ERROR, error_code):
                _log.warning("RPLIDAR stopped itself with error 0x%04X; resetting it", error_code)
                return self._enter(_State.REBOOT, now_ns, _REBOOT_NS, encode_request(Command.RESET))
            case _State.HEALTH, Health():
                if self.info is not None and self.info.firmware >= _SAMPLERATE_FIRMWARE:
                    request = encode_request(Command.GET_SAMPLERATE)
                    return self._enter(_State.SAMPLE_RATE, now_ns, _ANSWER_NS, request)
                return self._start_motor(now_ns)
            case _State.SAMPLE_RATE, _:  # some do not answer; the defaults are near
                return self._start_motor(now_ns)
            case _State.BOARD_FLAG, AccBoardFlag(has_motor_pwm=True):
                return self._set_motor(Command.SET_MOTOR_PWM, self._config.motor_pwm, now_ns)
            case ((_State.BOARD_FLAG | _State.MOTOR), _):
                return self._enter(_State.SCAN, now_ns, _FIRST_SAMPLES_NS, self._scan_request())
            case _:
                if self._state not in (_State.START, _State.REBOOT):
                    _log.warning("RPLIDAR silent while waiting for %s; starting over", self._state.name)
                return self._enter(_State.QUIET, now_ns, _QUIET_NS, encode_request(Command.STOP))

    def closing(self) -> bytes:
        """STOP, and the motor off if it was switched on from here."""
        return encode_request(Command.STOP) + self._motor_off

    def _enter(self, state: _State, now_ns: int, wait_ns: int, request: bytes = b"") -> bytes:
        self._state = state
        self._deadline_ns = now_ns + wait_ns
        self._answer = None
        return request

    def _start_motor(self, now_ns: int) -> bytes:
        """First request of what makes this model turn. Source: rplidar_sdk setMotorSpeed."""
        series = 0 if self.info is None else self.info.series
        if series >= 6:
            return self._set_motor(Command.HQ_MOTOR_SPEED_CTRL, self._config.motor_rpm, now_ns)
        if series in (2, 3):
            request = encode_request(Command.GET_ACC_BOARD_FLAG, bytes(4))
            return self._enter(_State.BOARD_FLAG, now_ns, _ANSWER_NS, request)
        # A1 turns by the port's DTR line, C1 by itself
        return self._enter(_State.MOTOR, now_ns, _MOTOR_NS)

    def _set_motor(self, command: Command, speed: int, now_ns: int) -> bytes:
        self._motor_off = encode_request(command, struct.pack("<H", 0))
        request = encode_request(command, struct.pack("<H", speed))
        return self._enter(_State.MOTOR, now_ns, _MOTOR_NS, request)

    def _scan_request(self) -> bytes:
        if self._config.mode == "standard":
            return encode_request(Command.SCAN)
        return encode_request(Command.EXPRESS_SCAN, bytes(5))  # mode 0, legacy; flags 0
