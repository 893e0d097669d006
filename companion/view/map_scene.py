"""The map of a scene: walls, anchors, ranges, scans, poses and tracks, all in map coordinates.

Rerun draws the y axis of a 2-D view downwards, so the entity `map` carries a mirroring transform and is
looked at from outside: on the screen x points right and y up, while the logged numbers stay true map
coordinates.
"""

from itertools import chain, cycle

import numpy as np
import rerun as rr

from companion.config import Config
from companion.view.anchor_marks import AnchorMarks
from companion.view.batch import Batch
from companion.view.closures import send_closures
from companion.view.entities import Entities
from companion.view.landmarks import send_landmarks
from companion.view.palette import (
    GREY,
    LIGHT,
    ORANGE,
    OTHER_ESTIMATORS,
    SKY,
    VERDICTS,
    WHITE,
    rgba,
    screen,
)
from estimators import chi2
from estimators.geometry import transform_each
from estimators.lidar.occupancy_grid import OccupancyGrid
from estimators.messages import FloatArray, IntArray

ARROW = 0.5
"""Length [m] of the arrow that shows the heading."""
TRACK_STEP = 0.01
"""Poses nearer to the one before than this [m] are left out of the whole track."""
_CIRCLE = np.array([(np.cos(a), np.sin(a)) for a in np.linspace(0.0, 2.0 * np.pi, 33)])


class MapScene:
    """Draws batches of ticks on the map.

    Args:
        entities: to write to.
        config: of the site.
        names: estimators, the primary first; of the others only poses and tracks are drawn.
        keeps_tracks: whether `close` will be called, which draws every whole track.
    """

    def __init__(self, entities: Entities, config: Config, names: list[str], keeps_tracks: bool) -> None:
        self._entities, self._config = entities, config
        self._primary = names[0]
        self.colours = dict(zip(names, chain((SKY,), cycle(OTHER_ESTIMATORS)), strict=False))
        self._tracks: dict[str, list[FloatArray]] | None = {} if keeps_tracks else None
        is_known = config.site.walls or config.site.map is not None
        self._grid = None if is_known or not keeps_tracks else OccupancyGrid(OccupancyGrid.Config())
        self._send_site()
        self._anchors = AnchorMarks(entities, config)

    def _send_site(self) -> None:
        put = self._entities.static
        put("map", rr.Transform3D(scale=[1.0, -1.0, 1.0]))
        if self._config.site.walls:
            walls = [np.array(wall) for wall in self._config.site.walls]
            put("map/walls", rr.LineStrips2D(walls, colors=GREY, radii=screen(1.5)))
        if self._config.site.map is not None:
            floor = self._config.site.map.floor_map()
            self._send_obstacles(floor.obstacle_points(floor.cell), floor.cell)

    def _send_obstacles(self, centres: FloatArray, cell: float) -> None:
        cells = rr.Points2D(centres, colors=GREY, radii=0.5 * cell, draw_order=5.0)
        self._entities.static("map/obstacles", cells)

    def send(self, batch: Batch) -> None:
        """Draw a batch."""
        for name in batch.names:
            layer = 40.0 if name == self._primary else 20.0
            self._send_pose(f"map/estimate/{name}", batch, name, self.colours[name], layer)
            self._send_sketches(f"map/estimate/{name}", batch, name)
        send_closures(self._entities, batch)
        self._send_covariance(batch)
        self._send_truth(batch)
        self._send_scans(batch)
        send_landmarks(self._entities, batch)
        if batch.frames:
            self._send_ranges(batch)
        self._anchors.send(batch)

    def send_autopilot(self, stamps_ns: IntArray, xy: FloatArray) -> None:
        """Draw where the autopilot thinks it is, (N, 2) [m] in the map."""
        self._entities.points("map/autopilot/position", stamps_ns, xy, ORANGE, 5.0, 44.0)
        self._keep("autopilot", xy)

    def close(self) -> None:
        """Draw whole tracks, and the grid of obstacles where the site has neither walls nor a map."""
        assert self._tracks is not None
        for name, pieces in self._tracks.items():
            path = f"map/estimate/{name}" if name in self.colours else f"map/{name}"
            colour = {"truth": WHITE, "autopilot": ORANGE, **self.colours}[name]
            whole = np.vstack(pieces)
            known = np.flatnonzero(np.isfinite(whole).all(axis=1))
            # Broken where there was no pose, rather than bridged by a straight line.
            runs = [
                _thinned(whole[rows])
                for rows in np.split(known, np.flatnonzero(np.diff(known) > 1) + 1)
                if len(rows)
            ]
            layer = {self._primary: 40.0, "truth": 30.0}.get(name, 20.0)
            style = rr.LineStrips2D(runs, colors=colour & ~0x90, radii=screen(0.7), draw_order=layer)
            self._entities.static(f"{path}/track", style)
        if self._grid is not None:
            rows, columns = np.nonzero(self._grid.obstacles)
            centres = self._grid.origin + (np.column_stack([columns, rows]) + 0.5) * self._grid.cell
            self._send_obstacles(centres, self._grid.cell)

    def _keep(self, name: str, xy: FloatArray) -> None:
        if self._tracks is not None:
            self._tracks.setdefault(name, []).append(xy)

    def _send_pose(self, path: str, batch: Batch, name: str, colour: int, layer: float) -> None:
        pose = batch.tracks[name].pose[batch.new]
        self._keep(name, pose[:, :2])
        self._entities.points(f"{path}/position", batch.stamps_ns, pose[:, :2], colour, 4.0, layer + 2.0)
        known = np.isfinite(pose).all(axis=1)
        x, y, yaw = pose[known].T
        arrow = rr.Arrows2D.from_fields(colors=colour, radii=screen(1.5), draw_order=layer + 2.0)
        self._entities.style(f"{path}/heading", arrow)
        vectors = ARROW * np.column_stack([np.cos(yaw), np.sin(yaw)])
        arrows = rr.Arrows2D.columns(vectors=vectors, origins=np.column_stack([x, y]))
        self._entities.columns(f"{path}/heading", batch.stamps_ns, arrows.partition(known))
        last = slice(max(batch.new.start - 1, 0), batch.new.stop)
        track = batch.tracks[name]
        width = 2.0 if layer == 40.0 else 1.0
        self._entities.strips(
            f"{path}/trail", track.stamps_ns[last], track.pose[last, :2], colour, width, layer + 1.0
        )

    def _send_sketches(self, path: str, batch: Batch, name: str) -> None:
        """Particles, the poses in a window, and its keyframes, of estimators that have any."""
        sketches = [(tick.stamp_ns, tick.sketches[name]) for tick in batch.ticks if name in tick.sketches]
        if not sketches:
            return
        stamps_ns = np.array([stamp_ns for stamp_ns, _ in sketches])
        colour = self.colours[name]
        for part, tone, size, layer in (
            ("particles", colour & ~0x80, 1.5, 17.0),
            ("window", colour & ~0x60, 1.5, 18.0),
            ("keyframes", WHITE, 3.0, 19.0),
        ):
            clouds = [getattr(sketch, part)[:, :2] for _, sketch in sketches]
            if any(len(cloud) for cloud in clouds):
                style = rr.Points2D.from_fields(colors=tone, radii=screen(size), draw_order=layer)
                self._entities.style(f"{path}/{part}", style)
                points = rr.Points2D.columns(positions=np.vstack(clouds))
                self._entities.columns(
                    f"{path}/{part}", stamps_ns, points.partition([len(cloud) for cloud in clouds])
                )

    def _send_covariance(self, batch: Batch) -> None:
        """The ellipse that holds the primary's position with 95 %."""
        track, path = batch.tracks[self._primary], f"map/estimate/{self._primary}/ellipse_95"
        xy, cov = track.pose[batch.new, :2], track.cov[batch.new, :2, :2]
        known = np.isfinite(cov).all(axis=(1, 2))
        variances, axes = np.linalg.eigh(cov[known])
        sigmas = np.sqrt(np.maximum(variances, 0.0))
        outline = np.sqrt(chi2.ppf(0.95, 2)) * np.einsum("nij,nj,kj->nki", axes, sigmas, _CIRCLE)
        style = rr.LineStrips2D.from_fields(colors=SKY, radii=screen(1.0), draw_order=42.0)
        self._entities.style(path, style)
        ellipses = rr.LineStrips2D.columns(strips=outline + xy[known, None])
        self._entities.columns(path, batch.stamps_ns, ellipses.partition(known))

    def _send_truth(self, batch: Batch) -> None:
        begin_ns = batch.before[-1].stamp_ns if batch.before else 0
        new = [truth for truth in batch.truths if begin_ns < truth.stamp_ns <= batch.stamps_ns[-1]]
        if not new:
            return
        stamps_ns = np.array([truth.stamp_ns for truth in new])
        pose = np.array([truth.pose for truth in new])
        self._keep("truth", pose[:, :2])
        self._entities.points("map/truth/position", stamps_ns, pose[:, :2], WHITE, 4.0, 32.0)

    def _send_scans(self, batch: Batch) -> None:
        """Each beam's end, seen from the pose at the time of that beam."""
        if not batch.scans or not self._config.view.scan_points:
            return
        most = self._config.view.scan_points
        kept = [(scan, slice(None, None, -(-len(scan.ranges) // most))) for scan in batch.scans]
        ranges = np.concatenate([scan.ranges[beams] for scan, beams in kept])
        begins_ns = np.array([scan.stamp_ns for scan in batch.scans])
        row = np.repeat(np.arange(len(kept)), [len(scan.ranges[beams]) for scan, beams in kept])
        after = np.concatenate([scan.beam_times[beams] for scan, beams in kept])
        beam_ns = begins_ns[row] + np.round(after * 1e9).astype(np.int64)
        lidar_x, lidar_y, lidar_yaw = self._config.lidar_mounting()
        angles = np.concatenate([scan.angles[beams] for scan, beams in kept]) + lidar_yaw
        p_body = np.column_stack([lidar_x + ranges * np.cos(angles), lidar_y + ranges * np.sin(angles)])
        poses = batch.tracks[self._primary].at(beam_ns)
        p_map = transform_each(poses, p_body)
        drawn = (ranges > 0.0) & np.isfinite(p_map[:, 0]) & np.isfinite(p_map[:, 1])
        style = rr.Points2D.from_fields(colors=LIGHT, radii=screen(1.5), draw_order=15.0)
        self._entities.style("map/scan", style)
        columns = rr.Points2D.columns(positions=p_map[drawn])
        lengths = np.bincount(row[drawn], minlength=len(kept))
        stamps_ns = np.array([scan.end_stamp_ns for scan in batch.scans])
        self._entities.columns("map/scan", stamps_ns, columns.partition(lengths))
        if self._grid is not None:
            self._add_to_grid(row[drawn], poses[drawn], p_body[drawn])

    def _add_to_grid(self, row: IntArray, poses: FloatArray, p_body: FloatArray) -> None:
        """Add scans to the grid of obstacles, each seen from one pose: that at its last beam."""
        assert self._grid is not None
        for scan in np.unique(row):
            beams = row == scan
            self._grid.insert(poses[beams][-1], p_body[beams])

    def _send_ranges(self, batch: Batch) -> None:
        """Lines from tag to anchor in the colour of the verdict, with the reason why one is not used."""
        counts = [len(frame.ranges) for frame, _ in batch.frames]
        row = np.repeat(np.arange(len(counts)), counts)
        stamps_ns = np.array([frame.stamp_ns for frame, _ in batch.frames])
        unknown = (np.nan, np.nan, np.nan)
        ids = [int(i) for frame, _ in batch.frames for i in frame.anchor_ids]
        anchors = np.array([self._config.anchors.get(i, unknown) for i in ids]).reshape(-1, 3)
        # An estimator without use for ranges gives one verdict for the whole frame.
        verdicts = [v for (_, r), n in zip(batch.frames, counts, strict=True) for v in (r.verdicts * n)[:n]]
        pose = batch.tracks[self._primary].at(stamps_ns)[row]
        tag = transform_each(pose, np.array([self._config.body.tag[:2]]))
        # Where the heading is not known, the lever arm of the tag is left out.
        tag = np.where(np.isfinite(tag), tag, pose[:, :2])
        lines = np.stack([tag, anchors[:, :2]], axis=1)
        drawn = np.isfinite(lines).all(axis=(1, 2))
        colours = rgba(VERDICTS.get(verdict, GREY) for verdict in verdicts)
        reasons = np.array(["" if verdict.is_used else str(verdict) for verdict in verdicts])
        self._entities.style("map/ranges", rr.LineStrips2D.from_fields(radii=screen(1.0), draw_order=10.0))
        columns = rr.LineStrips2D.columns(strips=lines[drawn], colors=colours[drawn], labels=reasons[drawn])
        lengths = np.bincount(row[drawn], minlength=len(counts))
        self._entities.columns("map/ranges", stamps_ns, columns.partition(lengths))


def _thinned(xy: FloatArray) -> FloatArray:
    """A way (N, 2) without the poses of a robot that stands."""
    kept, last = [0], xy[0]
    for i, place in enumerate(xy):
        if abs(place[0] - last[0]) + abs(place[1] - last[1]) > TRACK_STEP:
            kept.append(i)
            last = place
    return xy[kept]
