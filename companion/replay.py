"""A log through the same decoders and estimators as live, as fast as the processor allows."""

import json
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from itertools import starmap
from math import isinf
from pathlib import Path
from statistics import fmean

from scipy.spatial.transform import Rotation

from companion import __version__
from companion.config import Config, config_from_toml
from companion.errors import UserError
from companion.evaluate import Accuracy, Errors, Reference, compare
from companion.log import Log, RawChunk, Truth
from companion.pipeline import NO_LANDMARKS, Chain, FrontEnd, Landmarked, Pipeline, Tick, make_parts
from companion.range_log import HEADER, range_lines
from drivers.framing import DecodeStats
from estimators.base import Estimator, Report, Sketch, Sketched, Taken, Verdict, taken_by
from estimators.messages import FloatArray, Measurement, PoseEstimate, PoseIncrement, RangeFrame, Scan


@dataclass(slots=True)
class Stopwatch:
    """Time spent in something that is called often."""

    calls: int = 0
    seconds: float = 0.0

    @property
    def mean_ms(self) -> float:
        """Mean time of a call [ms]."""
        return 1e3 * self.seconds / self.calls if self.calls else 0.0

    def note(self, begin: float) -> None:
        """Count a call that began at `begin` of `time.perf_counter` and is over now."""
        self.seconds += time.perf_counter() - begin
        self.calls += 1


class _TimedEstimator:
    """An estimator whose updates are timed."""

    def __init__(self, estimator: Estimator, stopwatch: Stopwatch) -> None:
        self._estimator = estimator
        self._sketched = estimator if isinstance(estimator, Sketched) else None
        self._stopwatch = stopwatch

    def reset(self) -> None:
        self._estimator.reset()

    @property
    def takes(self) -> Taken:
        return taken_by(self._estimator)

    def update(self, measurement: Measurement) -> Report:
        begin = time.perf_counter()
        report = self._estimator.update(measurement)
        if Verdict.NOT_USED not in report.verdicts:
            self._stopwatch.note(begin)
        return report

    def pose_at(self, stamp_ns: int) -> PoseEstimate | None:
        return self._estimator.pose_at(stamp_ns)

    def sketch(self) -> Sketch | None:
        return None if self._sketched is None else self._sketched.sketch()


class _TimedFrontEnd:
    """A front end whose updates are timed."""

    def __init__(self, front_end: FrontEnd, stopwatch: Stopwatch) -> None:
        self._front_end = front_end
        self._landmarked = front_end if isinstance(front_end, Landmarked) else None
        self._stopwatch = stopwatch

    def update(self, measurement: Measurement) -> PoseIncrement | None:
        if not isinstance(measurement, Scan):
            return self._front_end.update(measurement)
        begin = time.perf_counter()
        increment = self._front_end.update(measurement)
        self._stopwatch.note(begin)
        return increment

    @property
    def landmarks(self) -> FloatArray:
        """Of the front end, if it has any."""
        return NO_LANDMARKS if self._landmarked is None else self._landmarked.landmarks


@dataclass(slots=True)
class Replay:
    """What came out of a log.

    Attributes:
        config: that was used.
        names: estimators, the primary first.
        poses: estimator -> its poses, one per tick at which it had one.
        errors: estimator -> errors against the log's truth; empty without truth.
        update_times: estimator (and `front_end`) -> time of its updates.
        verdicts: estimator -> how often each verdict was given to a range or increment.
        anchor_verdicts: estimator -> anchor -> the same of its ranges.
        ranges: frames of ranges, and what the primary made of them.
        iterations: estimator -> steps of its solver for each frame; empty without such a solver.
        health: state -> number of ticks.
        sensors: sensor -> what its decoder counted.
        late: measurements that came too late to be used.
        duration: of the log [s].
        complete: False when the log has a torn end.
    """

    config: Config
    names: list[str]
    poses: dict[str, list[PoseEstimate]]
    errors: dict[str, Errors] = field(default_factory=dict)
    update_times: dict[str, Stopwatch] = field(default_factory=dict)
    verdicts: dict[str, Counter[str]] = field(default_factory=dict)
    anchor_verdicts: dict[str, dict[int, Counter[str]]] = field(default_factory=dict)
    ranges: list[tuple[RangeFrame, Report]] = field(default_factory=list)
    iterations: dict[str, list[int]] = field(default_factory=dict)
    health: Counter[str] = field(default_factory=Counter)
    sensors: dict[str, DecodeStats] = field(default_factory=dict)
    late: int = 0
    duration: float = 0.0
    complete: bool = True

    def accuracy(self, name: str) -> Accuracy | None:
        """Figures of one estimator; None without truth or poses."""
        return self.errors[name].accuracy() if name in self.errors else None

    def without_height(self, name: str) -> int:
        """How many poses of one estimator have a height that its ranges could not show: it is the site's."""
        return sum(isinf(pose.cov[2, 2]) for pose in self.poses[name])


def config_of(log: Log, sets: list[str]) -> Config:
    """The configuration stored in a log, with `--set` assignments applied.

    Raises:
        UserError: an assignment is wrong, or the stored configuration does not fit this version.
    """
    origin = f"{log.path} (recorded by version {log.version}; --site FILE replaces its settings)"
    return config_from_toml(log.config_toml, origin, sets)


def replay(
    log: Log,
    config: Config,
    names: list[str],
    on_tick: Callable[[Tick, Truth | None], None] | None = None,
    on_progress: Callable[[float], None] | None = None,
    on_chunk: Callable[[RawChunk], None] | None = None,
    until_ns: int | None = None,
    close_loops: bool = False,
) -> Replay:
    """Run a log through the pipeline.

    Args:
        log: to read.
        config: usually `config_of(log)`.
        names: estimators to run side by side, the primary first.
        on_tick: called for every tick with the newest truth before it.
        on_progress: called now and then with the share of the log that is done.
        on_chunk: called for every chunk before it is decoded; ticks then hold the estimators' sketches.
        until_ns: end there.
        close_loops: look for loop closures although none of the estimators has a use for them.

    Raises:
        UserError: the log holds no bytes of any sensor of the site.
    """
    begin_ns = last_ns = log.start_ns
    result = Replay(config, names, {name: [] for name in names})
    result.update_times = {name: Stopwatch() for name in ["front_end", *names]}
    result.verdicts = {name: Counter() for name in names}
    result.anchor_verdicts = {name: defaultdict(Counter) for name in names}
    result.iterations = {name: [] for name in names}
    pipeline = _timed_pipeline(config, names, result.update_times, close_loops)
    chain = Chain(config, begin_ns, pipeline, names[0], watched=on_chunk is not None)
    truths: list[Truth] = []
    ticks_ns: list[int] = []

    def take(tick: Tick) -> None:
        ticks_ns.append(tick.stamp_ns)
        result.health[tick.health.state] += 1
        for outcome in tick.outcomes:
            if isinstance(outcome.measurement, PoseIncrement):
                for name, report in outcome.reports.items():
                    result.verdicts[name].update(report.verdicts)
            elif isinstance(outcome.measurement, RangeFrame):
                frame = outcome.measurement
                result.ranges.append((frame, outcome.reports[names[0]]))
                for name, report in outcome.reports.items():
                    result.verdicts[name].update(report.verdicts)
                    anchors = result.anchor_verdicts[name]
                    for anchor_id, verdict in zip(frame.anchor_ids.tolist(), report.verdicts, strict=True):
                        anchors[anchor_id][verdict] += 1
                    if report.iterations is not None:
                        result.iterations[name].append(report.iterations)
        for name, pose in tick.poses.items():
            if pose is not None:
                result.poses[name].append(pose)
        if on_tick is not None:
            on_tick(tick, truths[-1] if truths else None)
        if on_progress is not None:
            on_progress(log.share_read)

    fed = 0
    for record in log:
        if isinstance(record, Truth):
            truths.append(record)
            continue
        if until_ns is not None and record.stamp_ns > until_ns:
            break
        if on_chunk is not None:
            on_chunk(record)
        fed += record.source in chain.sensors
        for tick in chain.feed(record):
            take(tick)
        last_ns = max(last_ns, record.stamp_ns)
    if not fed:
        wanted = ", ".join(chain.sensors) or "none"
        raise UserError(f"{log.path}: no bytes of the site's sensors in it (sensors: {wanted})")

    result.duration = (last_ns - begin_ns) * 1e-9
    result.complete = log.complete
    result.late = chain.sequencer.late
    result.sensors = {name: sensor.stats for name, sensor in chain.sensors.items()}
    if truths:
        reference = Reference(truths)
        covered = sum(reference.covers(stamp_ns) for stamp_ns in ticks_ns)
        result.errors = {name: compare(result.poses[name], reference, covered) for name in names}
    return result


def write_outputs(result: Replay, folder: Path) -> None:
    """Write `poses.tum` (and `poses_NAME.tum` of further estimators) and what else is known of a replay.

    That is `ranges.csv` (the primary's verdict on every range), `summary.json` and `config.toml`.

    Raises:
        UserError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for i, name in enumerate(result.names):
            text = "".join(tum_line(pose) for pose in result.poses[name])
            (folder / (f"poses_{name}.tum" if i else "poses.tum")).write_text(text, encoding="utf-8")
        ranges = "".join(starmap(range_lines, result.ranges))
        (folder / "ranges.csv").write_text(HEADER + ranges, encoding="utf-8")
        (folder / "summary.json").write_text(json.dumps(summary(result), indent=2) + "\n", encoding="utf-8")
        (folder / "config.toml").write_text(result.config.to_toml(), encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot write to {folder}: {error.strerror}") from error


def tum_line(pose: PoseEstimate) -> str:
    """One line of a TUM trajectory: seconds, position [m], quaternion x y z w."""
    seconds, nanoseconds = divmod(pose.stamp_ns, 1_000_000_000)
    quat_xyzw = Rotation.from_matrix(pose.T_map_body[:3, :3]).as_quat(canonical=True)
    numbers = " ".join(f"{value:.9f}" for value in [*pose.T_map_body[:3, 3], *quat_xyzw])
    return f"{seconds}.{nanoseconds:09d} {numbers}\n"


def summary(result: Replay) -> dict[str, object]:
    """The figures of a replay as plain data."""
    estimators = {
        name: {
            "accuracy": asdict(accuracy) if (accuracy := result.accuracy(name)) else None,
            "poses": len(result.poses[name]),
            "poses_without_height": result.without_height(name),
            "update_ms": result.update_times[name].mean_ms,
            "verdicts": dict(result.verdicts[name]),
            "anchors": {str(i): dict(counts) for i, counts in sorted(result.anchor_verdicts[name].items())},
            "solver_iterations": fmean(taken) if (taken := result.iterations[name]) else None,
        }
        for name in result.names
    }
    return {
        "version": __version__,
        "site": result.config.site.name,
        "duration_s": result.duration,
        "complete": result.complete,
        "primary": result.names[0],
        "estimators": estimators,
        "front_end_ms": result.update_times["front_end"].mean_ms,
        "health_ticks": dict(result.health),
        "late_measurements": result.late,
        "sensors": {name: asdict(stats) for name, stats in result.sensors.items()},
    }


def _timed_pipeline(
    config: Config, names: list[str], update_times: dict[str, Stopwatch], close_loops: bool
) -> Pipeline:
    front_end, estimators, look_back = make_parts(config, names, close_loops)
    return Pipeline(
        _TimedFrontEnd(front_end, update_times["front_end"]),
        {name: _TimedEstimator(estimator, update_times[name]) for name, estimator in estimators.items()},
        look_back,
    )
