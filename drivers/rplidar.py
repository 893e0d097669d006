"""SLAMTEC RPLIDAR (A1, A2, A3, C1, S series): bytes to scans.

Source: Slamtec interface protocol rev 2.2; rplidar_sdk @99478e5.
"""

from itertools import pairwise
from typing import ClassVar

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
from drivers.rplidar_revolution import PackedLine, Revolution, TimeLine
from estimators.messages import Measurement, Scan

_DEFAULT_SAMPLE_NS = {  # where the device was not asked or did not say (protocol figure 3-3)
    AnswerType.STANDARD_SCAN: 500_000,
    AnswerType.EXPRESS_SCAN: 250_000,
    AnswerType.ULTRA_SCAN: 125_000,
    AnswerType.DENSE_SCAN: 108_000,
    AnswerType.ULTRA_DENSE_SCAN: 31_250,
    AnswerType.HQ_SCAN: 125_000,
}
_WITH_QUALITY = (AnswerType.STANDARD_SCAN, AnswerType.ULTRA_DENSE_SCAN, AnswerType.HQ_SCAN)
_ANSWER_START = b"\xa5\x5a"
_PAUSE_NS = 50_000_000  # packets follow each other sooner, answers after a STOP do not


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
        self._revolution: Revolution | None = None  # None before the first start of one

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
        self._clock.note_starts([samples.first + start for start in samples.starts])
        line = self._time_line(samples, arrival_ns)
        ends = [*samples.starts, samples.count]
        scans: list[Scan] = []
        if self._revolution is not None:
            self._revolution.add(samples, 0, ends[0], line)
        for first, end in pairwise(ends):
            if self._revolution is not None:
                scan = self._revolution.scan(self._config.min_range, self._config.max_range)
                if scan is None:
                    self.dropped_scans += 1
                else:
                    scans.append(scan)
                    self._dialogue.hear(scan)
            self._revolution = Revolution(samples.scan_type in _WITH_QUALITY)
            self._revolution.add(samples, first, end, line)
        return scans

    def _time_line(self, samples: Samples, arrival_ns: int) -> TimeLine:
        """Times of samples, strictly ascending over all calls.

        Where the clock learns that earlier times were too late, the next ones are packed evenly into the
        time there is.
        """
        scan_type = samples.scan_type
        # what arrived after them in the same chunk, or is what their packet had to wait for
        later = (self._fed - samples.end) // PACKET_BYTES[scan_type] * PACKET_SAMPLES[scan_type]
        end = samples.first + samples.count
        line: TimeLine = self._clock.line(end, end + later, arrival_ns)
        before_ns = self._last_sample_ns
        if before_ns is not None and line.host_ns(samples.first + 1) <= before_ns:
            line = PackedLine(before_ns, samples.first, samples.count, line.host_ns(end) - before_ns)
        self._last_sample_ns = line.host_ns(end)
        return line
