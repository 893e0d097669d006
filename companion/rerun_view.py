"""A replayed run as a Rerun recording: map, ranges with their verdicts, errors and health over time.

Everything spatial is logged in the map frame below the entity `map`. Rerun draws the y axis of a 2-D view
downwards, so `map` itself carries a mirroring transform and is looked at from outside: on the screen x
points right and y up, while the logged numbers stay true map coordinates.

Ticks are only collected while the log runs; `RerunView.close` turns them into columns, which costs a small
part of what one call a value would.
"""

from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from uuid import uuid4

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from companion.config import Config
from companion.errors import UserError
from companion.evaluate import Reference
from companion.health import State
from companion.log import Truth
from companion.pipeline import Tick
from companion.rerun_layout import TIMELINE, blueprint
from estimators import chi2
from estimators.base import Report, Verdict
from estimators.geometry import transform_each, wrap_angles
from estimators.messages import FloatArray, IntArray, RangeFrame, Scan

# RGBA after Okabe and Ito: told apart by colour-blind eyes too, and bright enough on a dark ground.
_SKY, _GREEN, _VERMILION, _PURPLE = 0x56B4E9FF, 0x009E73FF, 0xD55E00FF, 0xCC79A7FF
_YELLOW, _ORANGE, _BLUE = 0xF0E442FF, 0xE69F00FF, 0x4678DCFF
_WHITE, _LIGHT, _GREY = 0xF0F0F0FF, 0xBEB9AAFF, 0x787878FF
_OTHER_ESTIMATORS = (_PURPLE, _YELLOW, _BLUE, _ORANGE)
_ANCHORS = (_SKY, _ORANGE, _GREEN, _PURPLE, _YELLOW, _VERMILION, _BLUE)
_VERDICTS = {
    Verdict.ACCEPTED: _GREEN,
    Verdict.DOWNWEIGHTED: _YELLOW,
    Verdict.SUSPECT: _ORANGE,
    Verdict.TOO_LONG: _VERMILION,
    Verdict.WEAK_FIRST_PATH: _PURPLE,
    Verdict.OBSTRUCTED: _SKY,
    Verdict.GATED: _BLUE,
}
_STATES = {State.STARTING: _GREY, State.OK: _GREEN, State.DEGRADED: _ORANGE, State.LOST: _VERMILION}
_LEVELS = {State.DEGRADED: "WARN", State.LOST: "ERROR"}

_ARROW = 0.5
"""Length [m] of the arrow that shows the heading."""
_CIRCLE = np.array([(np.cos(a), np.sin(a)) for a in np.linspace(0.0, 2.0 * np.pi, 33)])


@dataclass(frozen=True, slots=True, eq=False)
class _Track:
    """Poses (N, 3) of x [m], y [m], yaw [rad] in the map, with their covariance (N, 3, 3).

    NaN where there is no pose; the yaw is unwrapped, and NaN where it is not known.
    """

    stamps_ns: IntArray
    pose: FloatArray
    cov: FloatArray

    def at(self, stamps_ns: IntArray) -> FloatArray:
        """Poses (M, 3) at other times; NaN where a neighbouring instant has none."""
        begin_ns = self.stamps_ns[0]
        times, known = stamps_ns - begin_ns, self.stamps_ns - begin_ns
        return np.column_stack([np.interp(times, known, c, np.nan, np.nan) for c in self.pose.T])


class RerunView:
    """Collects the ticks of a replay and writes them as an `.rrd` file that opens arranged.

    Args:
        config: of the site.
        primary: estimator whose pose, covariance and verdicts are shown; of the others, tracks and errors.
        path: file to write.

    Raises:
        UserError: the file cannot be written.
    """

    def __init__(self, config: Config, primary: str, path: Path) -> None:
        self._config, self._primary, self._path = config, primary, path
        self._ticks: list[Tick] = []
        self._truths: list[Truth] = []
        self._frames: list[tuple[RangeFrame, Report]] = []
        self._scans: list[Scan] = []
        self._plots: dict[str, float | None] = {}
        self._stream = rr.RecordingStream("companion", recording_id=uuid4())
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.open("wb").close()
            self._stream.save(path)
        except (OSError, RuntimeError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise UserError(f"cannot write the view {path}: {reason}") from error

    def tick(self, tick: Tick, truth: Truth | None) -> None:
        """Take one tick; fits `on_tick` of `companion.replay.replay`.

        Args:
            tick: as the pipeline gives it.
            truth: newest true pose before it, None without truth.
        """
        self._ticks.append(tick)
        if truth is not None and (not self._truths or truth is not self._truths[-1]):
            self._truths.append(truth)
        for outcome in tick.outcomes:
            if isinstance(outcome.measurement, RangeFrame):
                self._frames.append((outcome.measurement, outcome.reports[self._primary]))
            elif isinstance(outcome.measurement, Scan):
                self._scans.append(outcome.measurement)

    def close(self) -> None:
        """Write everything and finish the file.

        Raises:
            UserError: the file cannot be written, as on a full disk.
        """
        try:
            self._stream.send_recording_name(f"{self._config.site.name}, {self._primary}")
            self._send_site()
            if self._ticks:
                self._send_run()
            self._stream.send_blueprint(blueprint(self._config, self._primary, self._plots))
            self._stream.flush()
        except RuntimeError as error:
            raise UserError(f"cannot write the view {self._path}: {error}") from error
        finally:
            self._stream.disconnect()

    def _send_site(self) -> None:
        self._static("map", rr.Transform3D(scale=[1.0, -1.0, 1.0]))
        walls = [np.array(wall) for wall in self._config.site.walls]
        self._static("map/walls", rr.LineStrips2D(walls, colors=_GREY, radii=_screen(1.5)))
        positions = np.array(list(self._config.anchors.values()))[:, :2]
        names = [f"A{i}" for i in self._config.anchors]
        colours = [colour for colour, _ in zip(cycle(_ANCHORS), names, strict=False)]
        marks = rr.Points2D(positions, labels=names, colors=_rgba(colours), radii=_screen(6.0))
        self._static("map/anchors", marks)
        for name, colour in zip(names, colours, strict=True):
            style = rr.SeriesPoints(names=name, colors=colour, markers="circle", marker_sizes=1.5)
            self._static(f"ranges/residual/{name}", style)
            self._static(f"ranges/nis/{name}", style)

    def _send_run(self) -> None:
        reference = Reference(self._truths)
        others = [name for name in self._ticks[0].poses if name != self._primary]
        for name, colour in zip(others, cycle(_OTHER_ESTIMATORS), strict=False):
            self._send_estimate(name, _track(self._ticks, name), reference, colour, 20.0)
        track = _track(self._ticks, self._primary)
        distance, yaw = self._send_estimate(self._primary, track, reference, _SKY, 40.0)
        self._send_covariance(track, distance, yaw)
        self._send_scans(track)
        if self._frames:
            self._send_ranges(track)
            self._send_residuals()
            self._send_verdicts()
        self._send_health()
        if self._truths:
            truth_ns = np.array([truth.stamp_ns for truth in self._truths])
            pose = np.array([truth.pose for truth in self._truths])
            self._send_track("map/truth", _Track(truth_ns, pose, np.empty((0, 3, 3))), _WHITE, 30.0)

    def _send_estimate(
        self, name: str, track: _Track, reference: Reference, colour: int, layer: float
    ) -> tuple[FloatArray, FloatArray]:
        """Track and errors; gives those in position [m] and heading [deg], (N,), NaN where not known."""
        self._send_track(f"map/estimate/{name}", track, colour, layer)
        error = np.full(track.pose.shape, np.nan)
        covered = np.array([reference.covers(stamp_ns) for stamp_ns in track.stamps_ns.tolist()])
        if covered.any():
            error[covered] = track.pose[covered] - reference.at(track.stamps_ns[covered].tolist())
        distance = np.hypot(error[:, 0], error[:, 1])
        yaw = np.rad2deg(wrap_angles(error[:, 2]))
        self._series(f"error/position/{name}", name, colour, track.stamps_ns, distance)
        self._series(f"error/yaw/{name}", name, colour, track.stamps_ns, yaw)
        return distance, yaw

    def _send_track(self, path: str, track: _Track, colour: int, layer: float) -> None:
        """The whole track for the overview, and where and which way at each time."""
        known = np.isfinite(track.pose[:, :2]).all(axis=1)
        # Broken where there was no pose, rather than bridged by a straight line.
        rows = np.flatnonzero(known)
        pieces = np.split(track.pose[rows, :2], np.flatnonzero(np.diff(rows) > 1) + 1)
        faint = colour & ~0x90
        style = rr.LineStrips2D(pieces, colors=faint, radii=_screen(0.7), draw_order=layer)
        self._static(f"{path}/track", style)
        dot = rr.Points2D.from_fields(colors=colour, radii=_screen(4.0), draw_order=layer + 2.0)
        self._static(f"{path}/position", dot)
        points = rr.Points2D.columns(positions=track.pose[known, :2])
        self._columns(f"{path}/position", track.stamps_ns, points.partition(known))

        known = np.isfinite(track.pose).all(axis=1)
        x, y, yaw = track.pose[known].T
        arrow = rr.Arrows2D.from_fields(colors=colour, radii=_screen(1.5), draw_order=layer + 2.0)
        self._static(f"{path}/heading", arrow)
        vectors = _ARROW * np.column_stack([np.cos(yaw), np.sin(yaw)])
        arrows = rr.Arrows2D.columns(vectors=vectors, origins=np.column_stack([x, y]))
        self._columns(f"{path}/heading", track.stamps_ns, arrows.partition(known))

    def _send_covariance(self, track: _Track, distance: FloatArray, yaw: FloatArray) -> None:
        """Bright trail, 95 % ellipse and three sigma of the primary, whose errors set the scale."""
        path, xy = f"map/estimate/{self._primary}", track.pose[:, :2]
        steps = np.stack([xy[:-1], xy[1:]], axis=1).astype(np.float32)
        known = np.isfinite(steps).all(axis=(1, 2))
        style = rr.LineStrips2D.from_fields(colors=_SKY, radii=_screen(2.0), draw_order=41.0)
        self._static(f"{path}/trail", style)
        trail = rr.LineStrips2D.columns(strips=steps[known])
        self._columns(f"{path}/trail", track.stamps_ns[1:][known], trail)

        known = np.isfinite(track.cov[:, :2, :2]).all(axis=(1, 2))
        variances, axes = np.linalg.eigh(track.cov[known, :2, :2])
        sigmas = np.full(xy.shape, np.nan)
        sigmas[known] = np.sqrt(np.maximum(variances, 0.0))
        outline = np.sqrt(chi2.ppf(0.95, 2)) * np.einsum("nij,nj,kj->nki", axes, sigmas[known], _CIRCLE)
        style = rr.LineStrips2D.from_fields(colors=_SKY, radii=_screen(1.0), draw_order=42.0)
        self._static(f"{path}/ellipse_95", style)
        ellipses = rr.LineStrips2D.columns(strips=outline + xy[known, None])
        self._columns(f"{path}/ellipse_95", track.stamps_ns, ellipses.partition(known))

        major, yaw_sigma = 3.0 * sigmas[:, 1], 3.0 * np.rad2deg(np.sqrt(track.cov[:, 2, 2]))
        self._series("error/position/sigma", "3 sigma", _GREY, track.stamps_ns, major)
        self._series("error/yaw/sigma_above", "3 sigma", _GREY, track.stamps_ns, yaw_sigma)
        self._series("error/yaw/sigma_below", "-3 sigma", _GREY, track.stamps_ns, -yaw_sigma)
        self._scale("error/position", major, distance)
        self._scale("error/yaw", yaw_sigma, np.abs(yaw))

    def _scale(self, entity: str, sigmas: FloatArray, errors: FloatArray) -> None:
        """Fit a plot to the primary: a jump of another estimator would leave it a flat line."""
        sigmas, errors = sigmas[np.isfinite(sigmas)], errors[np.isfinite(errors)]
        usual = [np.percentile(v, share) for v, share in ((sigmas, 50), (errors, 95)) if len(v)]
        if usual:
            self._plots[entity] = 2.5 * float(max(usual))

    def _send_scans(self, track: _Track) -> None:
        """Each beam's end, seen from the pose at the time of that beam."""
        scans = [scan for scan in self._scans if len(scan.ranges)]
        if not scans:
            return
        row = np.repeat(np.arange(len(scans)), [len(scan.ranges) for scan in scans])
        beam_ns = np.concatenate([s.stamp_ns + np.round(s.beam_times * 1e9).astype(np.int64) for s in scans])
        ranges = np.concatenate([scan.ranges for scan in scans])
        lidar_x, lidar_y, lidar_yaw = self._config.lidar_mounting()
        angles = np.concatenate([scan.angles for scan in scans]) + lidar_yaw
        p_body = np.column_stack([lidar_x + ranges * np.cos(angles), lidar_y + ranges * np.sin(angles)])
        p_map = transform_each(track.at(beam_ns), p_body)
        drawn = (ranges > 0.0) & np.isfinite(p_map).all(axis=1)
        style = rr.Points2D.from_fields(colors=_LIGHT, radii=_screen(1.5), draw_order=15.0)
        self._static("map/scan", style)
        columns = rr.Points2D.columns(positions=p_map[drawn])
        lengths = np.bincount(row[drawn], minlength=len(scans))
        self._columns("map/scan", np.array([s.end_stamp_ns for s in scans]), columns.partition(lengths))

    def _send_ranges(self, track: _Track) -> None:
        """Lines from tag to anchor in the colour of the verdict."""
        counts = [len(frame.ranges) for frame, _ in self._frames]
        row = np.repeat(np.arange(len(counts)), counts)
        stamps_ns = np.array([frame.stamp_ns for frame, _ in self._frames])
        unknown = (np.nan, np.nan, np.nan)
        ids = [int(i) for frame, _ in self._frames for i in frame.anchor_ids]
        anchors = np.array([self._config.anchors.get(i, unknown) for i in ids]).reshape(-1, 3)
        # An estimator without use for ranges gives one verdict for the whole frame.
        verdicts = [v for (_, r), n in zip(self._frames, counts, strict=True) for v in (r.verdicts * n)[:n]]
        pose = track.at(stamps_ns)[row]
        tag = transform_each(pose, np.array([self._config.body.tag[:2]]))
        # Where the heading is not known, the lever arm of the tag is left out.
        tag = np.where(np.isfinite(tag), tag, pose[:, :2])
        lines = np.stack([tag, anchors[:, :2]], axis=1)
        drawn = np.isfinite(lines).all(axis=(1, 2))
        colours = _rgba([_VERDICTS.get(verdict, _GREY) for verdict in verdicts])
        reasons = np.array(["" if verdict.is_used else str(verdict) for verdict in verdicts])
        self._static("map/ranges", rr.LineStrips2D.from_fields(radii=_screen(1.0), draw_order=10.0))
        columns = rr.LineStrips2D.columns(strips=lines[drawn], colors=colours[drawn], labels=reasons[drawn])
        lengths = np.bincount(row[drawn], minlength=len(counts))
        self._columns("map/ranges", stamps_ns, columns.partition(lengths))

    def _send_verdicts(self) -> None:
        """A lane for each anchor: the verdict on its ranges, and with it the reason why one was rejected."""
        for i in self._config.anchors:
            given = [
                (frame.stamp_ns, verdict)
                for frame, report in self._frames
                for anchor_id, verdict in zip(frame.anchor_ids.tolist(), report.verdicts, strict=False)
                if anchor_id == i
            ]
            changes = [new for k, new in enumerate(given) if k == 0 or new[1] is not given[k - 1][1]]
            style = rr.StateConfiguration(
                values=list(Verdict),
                labels=list(Verdict),
                colors=_rgba([_VERDICTS.get(verdict, _GREY) for verdict in Verdict]),
            )
            self._static(f"ranges/verdict/A{i}", style)
            stamps_ns = np.array([stamp_ns for stamp_ns, _ in changes])
            states = rr.StateChange.columns(state=[verdict for _, verdict in changes])
            self._columns(f"ranges/verdict/A{i}", stamps_ns, states)

    def _send_residuals(self) -> None:
        """Residual and NIS of each anchor, as far as the primary reports them."""
        frames = [(f, r) for f, r in self._frames if len(r.residuals) == len(r.nis) == len(f.ranges)]
        if not frames:
            return
        ids = np.concatenate([frame.anchor_ids for frame, _ in frames])
        stamps_ns = np.repeat([f.stamp_ns for f, _ in frames], [len(f.ranges) for f, _ in frames])
        residuals = np.concatenate([report.residuals for _, report in frames])
        nis = np.concatenate([report.nis for _, report in frames])
        for i in self._config.anchors:
            self._scalars(f"ranges/residual/A{i}", stamps_ns[ids == i], residuals[ids == i])
            self._scalars(f"ranges/nis/A{i}", stamps_ns[ids == i], nis[ids == i])
        # Estimators that gate single ranges name the share that passes `range_gate`.
        share = getattr(self._config.estimator_config(self._primary), "range_gate", None)
        if share is not None:
            gate = float(chi2.ppf(share, 1))
            self._series("ranges/nis/gate", "gate", _WHITE, stamps_ns[[0, -1]], np.full(2, gate))
            # Blocked ranges reach hundreds; what matters is the side of the gate on which a range is.
            self._plots["ranges/nis"] = 4.0 * gate

    def _send_health(self) -> None:
        states = list(_STATES)
        style = rr.StateConfiguration(values=states, labels=states, colors=_rgba(list(_STATES.values())))
        self._static("health/state", style)
        changes = [
            tick
            for i, tick in enumerate(self._ticks)
            if i == 0 or tick.health.state is not self._ticks[i - 1].health.state
        ]
        stamps_ns = np.array([tick.stamp_ns for tick in changes])
        healths = [tick.health for tick in changes]
        self._columns("health/state", stamps_ns, rr.StateChange.columns(state=[h.state for h in healths]))
        texts = [f"{h.state}: {h.reason}" if h.reason else str(h.state) for h in healths]
        levels = [_LEVELS.get(h.state, "INFO") for h in healths]
        self._columns("health/log", stamps_ns, rr.TextLog.columns(text=texts, level=levels))

    def _series(self, path: str, name: str, colour: int, stamps_ns: IntArray, values: FloatArray) -> None:
        """A line, broken where a value is NaN; nothing at all where every value is."""
        if np.isfinite(values).any():
            # Peaks are what one looks for; an average over the pixels of a wide view would hide them.
            style = rr.SeriesLines(names=name, colors=colour, widths=1.0, aggregation_policy="MinMax")
            self._static(path, style)
            self._scalars(path, stamps_ns, values)

    def _scalars(self, path: str, stamps_ns: IntArray, values: FloatArray) -> None:
        if np.isfinite(values).any():
            self._plots.setdefault(path.rpartition("/")[0], None)
            self._columns(path, stamps_ns, rr.Scalars.columns(scalars=values))

    def _static(self, path: str, archetype: rr.AsComponents) -> None:
        self._stream.log(path, archetype, static=True)

    def _columns(self, path: str, stamps_ns: IntArray, columns: rr.ComponentColumnList) -> None:
        if len(stamps_ns):
            since_start = (stamps_ns - self._ticks[0].stamp_ns).astype("timedelta64[ns]")
            self._stream.send_columns(path, [rr.TimeColumn(TIMELINE, duration=since_start)], columns)


def _track(ticks: list[Tick], name: str) -> _Track:
    """One estimator's poses at all ticks; a pose that holds a NaN counts as none."""
    pose, cov = np.full((len(ticks), 3), np.nan), np.full((len(ticks), 3, 3), np.nan)
    for i, tick in enumerate(ticks):
        estimate = tick.poses[name]
        if estimate is not None and np.isfinite(estimate.T_map_body).all():
            pose[i], cov[i] = (*estimate.xy, estimate.yaw), estimate.planar_cov
    pose[~np.isfinite(cov[:, 2, 2]), 2] = np.nan
    known = np.isfinite(pose[:, 2])
    pose[known, 2] = np.unwrap(pose[known, 2])
    return _Track(np.array([tick.stamp_ns for tick in ticks]), pose, cov)


def _screen(points: float) -> float:
    """A radius that stays the same on the screen, whatever the zoom; Rerun takes a negative one so."""
    return -points


def _rgba(colours: list[int]) -> NDArray[np.uint32]:
    # Rerun takes a short list of plain integers for the channels of one colour.
    return np.array(colours, dtype=np.uint32)
