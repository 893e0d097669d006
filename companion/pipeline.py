"""The one path from bytes to poses, shared by live runs, replay, simulation and tests.

`Pipeline.step`, `Chain.feed` and `Chain.advance` are pure: no clock, no thread, no I/O. Whoever calls them
says what time it is. Poses are given at fixed instants (ticks) counted from the start of the run, so a
replay of the log asks for exactly the poses that the live run gave.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from companion.config import Config, HealthTable
from companion.health import AnchorState, Health, HealthMonitor
from companion.log import Direction, RawChunk
from companion.mavlink.link import NAME as MAVLINK
from companion.mavlink.signing import read_key
from companion.sequencer import Sequencer
from drivers import make_sensor
from drivers.autopilot import Autopilot
from drivers.framing import Sensor
from estimators import make_estimator
from estimators.base import Estimator, Report
from estimators.lidar.front_ends import ScanFrontEnd, make_scan_front_end
from estimators.messages import Measurement, PoseEstimate, PoseIncrement, RangeFrame, Scan


class FrontEnd(Protocol):
    """Turns scans, or what else tells motion, into increments."""

    def update(self, measurement: Measurement) -> PoseIncrement | None:
        """Increment up to the time of the measurement; None when it gives none."""
        ...


class Decoder(Protocol):
    """Turns bytes into measurements."""

    def feed(self, data: bytes, stamp_ns: int) -> list[Measurement]:
        """Decode bytes that arrived at `stamp_ns`; never raises on any bytes."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """One measurement and what each estimator made of it."""

    measurement: Measurement
    reports: dict[str, Report]


@dataclass(frozen=True, slots=True, eq=False)
class Tick:
    """All that happened up to one output instant.

    Attributes:
        stamp_ns: the instant.
        outcomes: measurements processed since the tick before.
        poses: estimator name -> pose at `stamp_ns`, None while it has none.
        health: judgement of the primary estimator's pose.
    """

    stamp_ns: int
    outcomes: list[Outcome]
    poses: dict[str, PoseEstimate | None]
    health: Health


class Pipeline:
    """Front end and estimators side by side on the same measurements.

    Args:
        front_end: gives the increments.
        estimators: name -> estimator.
    """

    def __init__(self, front_end: FrontEnd, estimators: Mapping[str, Estimator]) -> None:
        self._front_end = front_end
        self._estimators = dict(estimators)

    def step(self, measurement: Measurement) -> list[Outcome]:
        """Process one measurement; a scan also yields the outcome of its increment."""
        outcomes = [self._update(measurement)]
        increment = self._front_end.update(measurement)
        if increment is not None:
            outcomes.append(self._update(increment))
        return outcomes

    def poses_at(self, stamp_ns: int) -> dict[str, PoseEstimate | None]:
        """Each estimator's pose."""
        return {name: estimator.pose_at(stamp_ns) for name, estimator in self._estimators.items()}

    def _update(self, measurement: Measurement) -> Outcome:
        return Outcome(
            measurement, {name: estimator.update(measurement) for name, estimator in self._estimators.items()}
        )


class Chain:
    """Bytes in, poses out: decoders, sequencer, pipeline and health of one run.

    Args:
        config: of the site.
        start_ns: time of the first tick.
        pipeline: front end and estimators.
        primary: name of the estimator whose pose is judged and sent.
    """

    def __init__(self, config: Config, start_ns: int, pipeline: Pipeline, primary: str) -> None:
        self.sensors = make_sensors(config)
        self._decoders: dict[str, Decoder] = {**self.sensors, **make_autopilot_input(config)}
        self.sequencer = Sequencer(round(config.pipeline.hold_ms * 1e6))
        self._pipeline = pipeline
        self._primary = primary
        measured = {kind for sensor in self.sensors.values() for kind in sensor.MEASURES}
        inputs = config.mavlink.inputs
        self._monitor = HealthMonitor(
            config.health,
            RangeFrame in measured,
            Scan in measured or bool(inputs.odometry or inputs.wheels),
            config.anchors,
            config.mavlink.heading,
        )
        self._start_ns = start_ns
        self._period_ns = 1e9 / config.pipeline.rate
        self._ticks = 0

    @property
    def next_tick_ns(self) -> int:
        """When the next pose is due."""
        return self._start_ns + round(self._ticks * self._period_ns)

    def anchors(self, now_ns: int) -> list[AnchorState]:
        """What became lately of each anchor's ranges, by the primary estimator."""
        return self._monitor.anchors(now_ns)

    def feed(self, chunk: RawChunk) -> Iterator[Tick]:
        """Give the ticks that were due before these bytes arrived, then decode the bytes."""
        yield from self.advance(chunk.stamp_ns)
        decoder = self._decoders.get(chunk.source)
        if decoder is not None and chunk.direction is Direction.IN:
            for measurement in decoder.feed(chunk.data, chunk.stamp_ns):
                self.sequencer.push(measurement)

    def set_health(self, table: HealthTable) -> None:
        """Judge by other limits from now on; the poses do not change with them."""
        self._monitor.set_table(table)

    def advance(self, now_ns: int) -> Iterator[Tick]:
        """Give every tick that is due at `now_ns`."""
        while self.next_tick_ns <= now_ns:
            yield self._tick(self.next_tick_ns)
            self._ticks += 1

    def _tick(self, stamp_ns: int) -> Tick:
        outcomes: list[Outcome] = []
        for measurement in self.sequencer.release(stamp_ns):
            for outcome in self._pipeline.step(measurement):
                self._monitor.observe(outcome.measurement, outcome.reports[self._primary])
                outcomes.append(outcome)
        poses = self._pipeline.poses_at(stamp_ns)
        return Tick(stamp_ns, outcomes, poses, self._monitor.judge(poses[self._primary], stamp_ns))


def make_sensors(config: Config) -> dict[str, Sensor]:
    """A driver for every sensor of the site, by its name."""
    return {name: make_sensor(table.driver, table.settings) for name, table in config.sensor.items()}


def make_autopilot_input(config: Config) -> dict[str, Decoder]:
    """Decoder of what the autopilot measures, by the name of its link; none when nothing of it is used."""
    inputs, key = config.mavlink.inputs, config.mavlink.signing_key
    if not any((inputs.attitude, inputs.imu, inputs.height, inputs.odometry, inputs.wheels)):
        return {}
    return {MAVLINK: Autopilot(inputs, config.mavlink.autopilot_id, read_key(Path(key)) if key else None)}


def make_parts(config: Config, names: list[str]) -> tuple[FrontEnd, dict[str, Estimator]]:
    """Front end and the named estimators with the site's settings."""
    setup = config.setup()
    return make_front_end(config), {
        name: make_estimator(name, config.estimator_config(name), setup, config.relocation) for name in names
    }


def make_front_end(config: Config) -> ScanFrontEnd:
    """What turns the site's scans into increments."""
    name, mounting = config.pipeline.front_end, config.lidar_mounting()
    return make_scan_front_end(name, config.front_end_config(), mounting, config.scan_preparation)


def make_pipeline(config: Config, names: list[str]) -> Pipeline:
    """Pipeline of these parts."""
    return Pipeline(*make_parts(config, names))
