"""The one path from bytes to poses, shared by live runs, replay, simulation and tests.

`Pipeline.step`, `Chain.feed` and `Chain.advance` are pure: no clock, no thread, no I/O. Whoever calls them
says what time it is. Poses are given at fixed instants (ticks) counted from the start of the run, so a
replay of the log asks for exactly the poses that the live run gave.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import field
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from companion.config import Config
from companion.config_tables import HealthTable
from companion.health import AnchorState, Health, HealthMonitor
from companion.log import Direction, RawChunk
from companion.look_back import LookBack, make_look_back
from companion.mavlink.link import NAME as MAVLINK
from companion.mavlink.signing import read_key
from companion.sequencer import Sequencer
from drivers import make_sensor
from drivers.autopilot import Autopilot
from drivers.framing import Sensor
from estimators import make_estimator
from estimators.base import Estimator, Report, Sketch, Sketched, Verdict, taken_by
from estimators.immutable import immutable
from estimators.lidar.front_ends import ScanFrontEnd, make_scan_front_end
from estimators.lidar.fused_odometry import FusedOdometry
from estimators.lidar.scan_matching import ScanMatcher
from estimators.messages import (
    FloatArray,
    LoopClosure,
    Measurement,
    PoseEstimate,
    PoseIncrement,
    RangeFrame,
    Scan,
)
from estimators.models.range_bias import without_bias

NO_LANDMARKS = np.empty((0, 2))


class FrontEnd(Protocol):
    """Turns scans, or what else tells motion, into increments."""

    def update(self, measurement: Measurement) -> PoseIncrement | None:
        """Increment up to the time of the measurement; None when it gives none."""
        ...


@runtime_checkable
class Landmarked(Protocol):
    """A front end that can show what it knows the room by."""

    @property
    def landmarks(self) -> FloatArray:
        """(N, 2) [m] corners and poles, in the body frame at the end of the newest scan."""
        ...


class Decoder(Protocol):
    """Turns bytes into measurements."""

    def feed(self, data: bytes, stamp_ns: int) -> list[Measurement]:
        """Decode bytes that arrived at `stamp_ns`; never raises on any bytes."""
        ...


@immutable
class Outcome:
    """One measurement and what each estimator made of it."""

    measurement: Measurement
    reports: dict[str, Report]


@immutable
class Tick:
    """All that happened up to one output instant.

    Attributes:
        stamp_ns: the instant.
        outcomes: measurements processed since the tick before.
        poses: estimator name -> pose at `stamp_ns`, None while it has none.
        health: judgement of the primary estimator's pose.
        sketches: estimator -> what it holds besides; empty unless somebody watches.
        landmarks: (N, 2) [m] of the front end, as seen at the end of the newest scan; empty likewise.
    """

    stamp_ns: int
    outcomes: list[Outcome]
    poses: dict[str, PoseEstimate | None]
    health: Health
    sketches: dict[str, Sketch] = field(default_factory=dict)
    landmarks: FloatArray = field(default_factory=lambda: NO_LANDMARKS)


class Pipeline:
    """Front end and estimators side by side on the same measurements.

    Args:
        front_end: gives the increments.
        estimators: name -> estimator; the first one's poses say where to look for loop closures.
        look_back: finds them; None where nobody has a use for them.
    """

    def __init__(
        self,
        front_end: FrontEnd,
        estimators: Mapping[str, Estimator],
        look_back: LookBack | None = None,
    ) -> None:
        self._front_end = front_end
        self._estimators = dict(estimators)
        self._look_back = look_back
        self._takes = {name: taken_by(estimator) for name, estimator in self._estimators.items()}
        # Whether a protocol is kept takes longer to find out than most of what is then called.
        self._sketched = {name: e for name, e in self._estimators.items() if isinstance(e, Sketched)}
        self._landmarked = front_end if isinstance(front_end, Landmarked) else None
        self._unused = dict.fromkeys(self._estimators, Report((Verdict.NOT_USED,)))
        # Most of what arrives are inertial samples, and most estimators have no use for them.
        self._takers: dict[type[Measurement], list[str]] = {}

    def step(self, measurement: Measurement) -> list[Outcome]:
        """Process one measurement; a scan also yields the outcomes of its increment and of a loop closure."""
        # Odometry from outside reaches the estimators by the front end alone, so that it counts once.
        outcomes = [] if isinstance(measurement, PoseIncrement) else [self._update(measurement)]
        increment = self._front_end.update(measurement)
        if increment is not None:
            outcomes.append(self._update(increment))
            closure = self._closure(increment)
            if closure is not None:
                outcomes.append(self._update(closure))
        return outcomes

    def _closure(self, increment: PoseIncrement) -> LoopClosure | None:
        if self._look_back is None or not increment.is_keyframe:
            return None
        guide = next(iter(self._estimators.values()))
        return self._look_back.update(increment, guide.pose_at(increment.stamp_ns))

    def poses_at(self, stamp_ns: int) -> dict[str, PoseEstimate | None]:
        """Each estimator's pose."""
        return {name: estimator.pose_at(stamp_ns) for name, estimator in self._estimators.items()}

    def sketches(self) -> dict[str, Sketch]:
        """What estimators hold besides their poses, of those that can show it."""
        shown = {name: estimator.sketch() for name, estimator in self._sketched.items()}
        return {name: sketch for name, sketch in shown.items() if sketch is not None}

    def landmarks(self) -> FloatArray:
        """(N, 2) [m] of the front end, in the body frame at the end of the newest scan."""
        return NO_LANDMARKS if self._landmarked is None else self._landmarked.landmarks

    def _update(self, measurement: Measurement) -> Outcome:
        kind = type(measurement)
        takers = self._takers.get(kind)
        if takers is None:
            takers = [name for name, taken in self._takes.items() if taken is None or kind in taken]
            self._takers[kind] = takers
        if not takers:
            return Outcome(measurement, self._unused)
        taken = {name: self._estimators[name].update(measurement) for name in takers}
        return Outcome(measurement, taken if len(taken) == len(self._unused) else self._unused | taken)


class Chain:
    """Bytes in, poses out: decoders, sequencer, pipeline and health of one run.

    Args:
        config: of the site.
        start_ns: time of the first tick.
        pipeline: front end and estimators.
        primary: name of the estimator whose pose is judged and sent.
        watched: whether ticks hold the estimators' sketches.
    """

    def __init__(
        self, config: Config, start_ns: int, pipeline: Pipeline, primary: str, watched: bool = False
    ) -> None:
        self.sensors = make_sensors(config)
        self._decoders: dict[str, Decoder] = {**self.sensors, **make_autopilot_input(config)}
        self.sequencer = Sequencer(round(config.pipeline.hold_ms * 1e6))
        self._pipeline = pipeline
        self._primary = primary
        self._watched = watched
        self._monitor = make_monitor(config, self.sensors)
        self._range_biases, self._tag_biases = config.range_biases(), config.tag_biases()
        self._start_ns = start_ns
        self._period_ns = 1e9 / config.pipeline.rate
        self._ticks = 0
        self.next_tick_ns = start_ns
        """When the next pose is due."""

    def anchors(self, now_ns: int) -> list[AnchorState]:
        """What became lately of each anchor's ranges, by the primary estimator."""
        return self._monitor.anchors(now_ns)

    def stamp_to_log(self, arrival_ns: int) -> int:
        """Stamp of bytes that are only taken now: not before the last tick, which was given without them.

        On a busy machine bytes may wait for longer than `pipeline.hold_ms`. A replay of the log must not have
        them any earlier.
        """
        return max(arrival_ns, self._tick_ns(self._ticks - 1))

    def _tick_ns(self, number: int) -> int:
        return self._start_ns + round(number * self._period_ns)

    def feed(self, chunk: RawChunk) -> Iterator[Tick]:
        """Give the ticks that were due before these bytes arrived, then decode the bytes.

        What went out says nothing: a loop that is behind writes for one tick when the next are due, too, and
        takes what has arrived before it gives them.
        """
        if chunk.direction is Direction.OUT:
            return
        if chunk.stamp_ns >= self.next_tick_ns:
            yield from self.advance(chunk.stamp_ns)
        decoder = self._decoders.get(chunk.source)
        if decoder is not None:
            for measurement in decoder.feed(chunk.data, chunk.stamp_ns):
                # Here once, so that logs stay as measured and replay takes off what it is told to.
                if isinstance(measurement, RangeFrame):
                    measurement = without_bias(measurement, self._range_biases, self._tag_biases)
                self.sequencer.push(measurement)

    def set_health(self, table: HealthTable) -> None:
        """Judge by other limits from now on; the poses do not change with them."""
        self._monitor.set_table(table)

    def advance(self, now_ns: int) -> Iterator[Tick]:
        """Give every tick that is due at `now_ns`."""
        while self.next_tick_ns <= now_ns:
            yield self._tick(self.next_tick_ns)
            self._ticks += 1
            self.next_tick_ns = self._tick_ns(self._ticks)

    def _tick(self, stamp_ns: int) -> Tick:
        outcomes: list[Outcome] = []
        for measurement in self.sequencer.release(stamp_ns):
            for outcome in self._pipeline.step(measurement):
                self._monitor.observe(outcome.measurement, outcome.reports[self._primary])
                outcomes.append(outcome)
        poses = self._pipeline.poses_at(stamp_ns)
        health = self._monitor.judge(poses[self._primary], stamp_ns)
        if not self._watched:
            return Tick(stamp_ns, outcomes, poses, health)
        held = self._pipeline.sketches(), self._pipeline.landmarks()
        return Tick(stamp_ns, outcomes, poses, health, *held)


def make_sensors(config: Config) -> dict[str, Sensor]:
    """A driver for every sensor of the site, by its name."""
    return {name: make_sensor(table.driver, table.settings) for name, table in config.sensor.items()}


def make_autopilot_input(config: Config) -> dict[str, Decoder]:
    """Decoder of what the autopilot measures, by the name of its link; none when nothing of it is used."""
    inputs, key = config.mavlink.inputs, config.mavlink.signing_key
    if not any((inputs.attitude, inputs.imu, inputs.height, inputs.odometry, inputs.wheels)):
        return {}
    return {MAVLINK: Autopilot(inputs, config.mavlink.autopilot_id, read_key(Path(key)) if key else None)}


def make_monitor(config: Config, sensors: Mapping[str, Sensor]) -> HealthMonitor:
    """What judges the poses of a run with the site's sensors."""
    measured = {kind for sensor in sensors.values() for kind in sensor.MEASURES}
    inputs = config.mavlink.inputs
    return HealthMonitor(
        config.health,
        RangeFrame in measured,
        Scan in measured or bool(inputs.odometry or inputs.wheels),
        config.anchors,
        config.mavlink.heading,
    )


def make_parts(
    config: Config, names: list[str], close_loops: bool = False
) -> tuple[FrontEnd, dict[str, Estimator], LookBack | None]:
    """Front end and the named estimators with the site's settings, and what finds loop closures.

    Args:
        config: of the site.
        names: of the estimators.
        close_loops: look for closures although none of the estimators has a use for them.
    """
    setup = config.setup()
    estimators = {
        name: make_estimator(name, config.estimator_config(name), setup, config.relocation) for name in names
    }
    front_end, look_back = make_front_end(config, names, close_loops)
    return front_end, estimators, look_back


def make_front_end(
    config: Config, names: Iterable[str], close_loops: bool = False
) -> tuple[FrontEnd, LookBack | None]:
    """What turns scans, and odometry from outside, into increments; and what finds loop closures.

    Args:
        config: of the site.
        names: of the estimators.
        close_loops: look for closures although none of the estimators has a use for them.
    """
    inputs = config.mavlink.inputs
    scans = make_scan_odometry(config)
    # EKF-SLAM holds scans against its own map and has no keyframes to look back from.
    if not isinstance(scans, ScanMatcher):
        return scans, None
    look_back = make_look_back(config, scans, names, close_loops)
    return FusedOdometry(scans) if inputs.odometry or inputs.wheels else scans, look_back


def make_scan_odometry(config: Config) -> ScanFrontEnd:
    """What turns the site's scans into increments."""
    name, mounting = config.pipeline.front_end, config.lidar_mounting()
    return make_scan_front_end(name, config.front_end_config(), mounting, config.scan_preparation)


def make_pipeline(config: Config, names: list[str]) -> Pipeline:
    """Pipeline of these parts."""
    return Pipeline(*make_parts(config, names))
