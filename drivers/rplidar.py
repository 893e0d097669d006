"""SLAMTEC RPLIDAR (A1, A2, A3, C1, S series): bytes to scans.

Source: Slamtec interface protocol rev 2.2; rplidar_sdk @99478e5.
"""

from itertools import pairwise
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from drivers.framing import DecodeStats
from drivers.rplidar_clock import SampleClock
from drivers.rplidar_decoder import AnswerDecoder
from drivers.rplidar_dialogue import AUTO, MAX_PWM, MAX_RPM, Dialogue
from drivers.rplidar_protocol import (
    PACKET_BYTES,
    PACKET_SAMPLES,
    Answer,
    AnswerType,
    ConfKey,
    DeviceInfo,
    Health,
    LidarConf,
    SampleRate,
    Samples,
    ScanStarted,
)
from estimators.messages import IntArray, Measurement, Scan

_DEFAULT_SAMPLE_NS = {  # where the device was not asked or did not say (protocol figure 3-3)
    AnswerType.STANDARD_SCAN: 500_000,
    AnswerType.EXPRESS_SCAN: 250_000,
    AnswerType.ULTRA_SCAN: 125_000,
    AnswerType.DENSE_SCAN: 108_000,
    AnswerType.ULTRA_DENSE_SCAN: 31_250,
    AnswerType.HQ_SCAN: 125_000,
}
_WITH_QUALITY = (AnswerType.STANDARD_SCAN, AnswerType.ULTRA_DENSE_SCAN, AnswerType.HQ_SCAN)
_MIN_SAMPLES = 30  # fewer are not a revolution
_MAX_REVOLUTION_NS = 1_000_000_000  # slower than any of these devices turns
_ANSWER_START = b"\xa5\x5a"
_PAUSE_NS = 50_000_000  # packets follow each other sooner, answers after a STOP do not


class _Part(NamedTuple):
    """Consecutive samples, (n,) each."""

    angle_q14: IntArray
    distance_q2: IntArray
    quality: IntArray
    times_ns: IntArray

    def cut(self, first: int, end: int) -> "_Part":
        """Those from the first up to the end."""
        return _Part(*(column[first:end] for column in self))


class _Revolution:
    """Samples since the last start of a revolution; knows whether they may become a `Scan`."""

    def __init__(self) -> None:
        self._parts: list[_Part] = []
        self._intact = True

    def add(self, part: "_Part") -> None:
        """Append samples."""
        if self._intact and len(part.times_ns):
            self._parts.append(part)
            if part.times_ns[-1] - self._parts[0].times_ns[0] > _MAX_REVOLUTION_NS:
                self.spoil()

    def spoil(self) -> None:
        """It has a gap or takes too long: give up, and keep nothing more of it."""
        self._intact = False
        self._parts.clear()

    def scan(self, min_range: float, max_range: float) -> Scan | None:
        """The finished revolution; None when it is spoilt or has too few samples."""
        if sum(len(part.times_ns) for part in self._parts) < _MIN_SAMPLES:
            return None
        angle_q14, distance_q2, quality, times_ns = map(np.concatenate, zip(*self._parts, strict=True))
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

        mode: str = Field(
            AUTO,
            min_length=1,
            description="scan mode by the device's own name for it (standard, express, boost, sensitivity, "
            "stability, denseboost, ...), or auto for the one it recommends",
        )
        motor_pwm: int = Field(
            0, ge=0, le=MAX_PWM, description="with an accessory board (A2, A3); 0 = the device's own choice"
        )
        motor_rpm: int = Field(
            0, ge=0, le=MAX_RPM, description="revolutions per minute (S series); 0 = the device's own choice"
        )
        latency_ms: float = Field(
            0.0, ge=0, le=1000, description="time from a packet's last beam to its arrival, at the least [ms]"
        )
        min_range: float = Field(
            0.15,
            ge=0,
            description='nearest return that counts [m]; nearer ones become 0, "nothing came back"',
        )
        max_range: float = Field(40.0, gt=0, description="farthest return that counts [m]")

        @model_validator(mode="after")
        def _ordered(self) -> "Rplidar.Config":
            if self.min_range >= self.max_range:
                raise ValueError(f"min_range {self.min_range} is not below max_range {self.max_range}")
            return self

    MEASURES: ClassVar[frozenset[type]] = frozenset({Scan})
    DTR_STOPS: ClassVar[bool] = True  # A1
    BAUDS: ClassVar[tuple[int, ...]] = (115_200, 256_000, 460_800, 1_000_000)

    def __init__(self, config: Config) -> None:
        self.stats = DecodeStats()
        self.info: DeviceInfo | None = None
        self.health: Health | None = None
        self.dropped_scans = 0
        self._config = config
        self._latency_ns = round(config.latency_ms * 1e6)
        self._decoder = AnswerDecoder(self.stats)
        self._dialogue = Dialogue(config.mode, config.motor_pwm, config.motor_rpm)
        self._sample_ns = dict(_DEFAULT_SAMPLE_NS)
        self._mode_sample_ns: int | None = None  # of the scan that begins next
        self._clock = SampleClock(1)
        self._fed = 0
        self._last_feed_ns = 0
        self._last_sample_ns: int | None = None
        self._revolution: _Revolution | None = None  # None before the first start of one

    @property
    def mode(self) -> str:
        """Name of the scan mode in use; empty before it is chosen, and in a replay."""
        return self._dialogue.mode

    def feed(self, data: bytes, stamp_ns: int) -> list[Measurement]:
        """Scans whose next revolution began with these bytes; needs no dialogue, so it serves replay.

        A packet that was cut by STOP, or an answer that was cut by a fault, would swallow the answer that
        comes next: it is dropped when something begins like an answer after a pause.
        """
        scans: list[Measurement] = []
        if not data:
            return scans
        self._dialogue.hear_bytes()
        if _ANSWER_START.startswith(data[:2]) and stamp_ns - self._last_feed_ns > _PAUSE_NS:
            self._decoder.discard()
        self._fed += len(data)
        self._last_feed_ns = stamp_ns
        for event in self._decoder.feed(data):
            if isinstance(event, Samples):
                scans += self._assemble(event, stamp_ns - self._latency_ns)
            elif isinstance(event, ScanStarted):
                self._begin_scan(event.scan_type)
                self._dialogue.hear(event)
            else:
                self._note(event)
                self._dialogue.hear(event)
        return scans

    def connected(self, now_ns: int) -> None:
        """The port is open: the next `poll` begins the dialogue."""
        self.info = None
        self.health = None
        self._dialogue.connected(now_ns)

    def poll(self, now_ns: int) -> bytes:
        """The request that is due now, if any."""
        return self._dialogue.poll(now_ns)

    def closing(self) -> list[bytes]:
        """STOP, and the motor off if it was switched on from here."""
        return self._dialogue.closing()

    def _note(self, answer: Answer) -> None:
        """Keep what the device says of itself."""
        match answer:
            case DeviceInfo():
                self.info = answer
                self._mode_sample_ns = None
            case Health():
                self.health = answer
            case SampleRate(standard_us, express_us):
                self._sample_ns[AnswerType.STANDARD_SCAN] = 1000 * max(1, standard_us)
                self._sample_ns[AnswerType.EXPRESS_SCAN] = 1000 * max(1, express_us)
            case LidarConf(key=ConfKey.MODE_SAMPLE_TIME):
                self._mode_sample_ns = answer.sample_ns

    def _begin_scan(self, scan_type: AnswerType) -> None:
        self._revolution = None
        self._clock = SampleClock(self._mode_sample_ns or self._sample_ns[scan_type])

    def _assemble(self, samples: Samples, arrival_ns: int) -> list[Scan]:
        """Append samples to the revolution, and finish it wherever one of them starts the next."""
        if samples.gap:
            self._clock.restart()
            if self._revolution is not None:
                self._revolution.spoil()
        starts = samples.starts.nonzero()[0]
        self._clock.note_starts(samples.first + starts)
        times_ns = self._sample_times(samples, arrival_ns)
        quality = samples.quality if samples.scan_type in _WITH_QUALITY else np.zeros_like(times_ns)
        part, count = _Part(samples.angle_q14, samples.distance_q2, quality, times_ns), len(times_ns)
        scans: list[Scan] = []
        begins = starts.tolist()
        if self._revolution is not None:
            self._revolution.add(part.cut(0, begins[0]) if begins else part)
        for first, end in pairwise([*begins, count]):
            if self._revolution is not None:
                scan = self._revolution.scan(self._config.min_range, self._config.max_range)
                if scan is None:
                    self.dropped_scans += 1
                else:
                    scans.append(scan)
                    self._dialogue.hear(scan)
            self._revolution = _Revolution()
            self._revolution.add(part.cut(first, end))
        return scans

    def _sample_times(self, samples: Samples, arrival_ns: int) -> IntArray:
        """Time of each sample [ns], strictly ascending over all calls.

        Where the clock learns that earlier times were too late, the next ones are packed evenly into the
        time there is.
        """
        scan_type, count = samples.scan_type, len(samples.angle_q14)
        # what arrived after them in the same chunk, or is what their packet had to wait for
        later = (self._fed - samples.end) // PACKET_BYTES[scan_type] * PACKET_SAMPLES[scan_type]
        end = samples.first + count
        times_ns = self._clock.times_ns(samples.first, end, end + later, arrival_ns)
        before_ns = self._last_sample_ns
        if before_ns is not None and times_ns[0] <= before_ns:
            number = np.arange(1, count + 1)
            times_ns = before_ns + number * max(count, int(times_ns[-1]) - before_ns) // count
        self._last_sample_ns = int(times_ns[-1])
        return times_ns
