"""Ticks that are drawn together, in the form in which they are drawn: arrays over time."""

import numpy as np

from companion.evaluate import Reference
from companion.log import Truth
from companion.pipeline import Tick
from estimators.base import Report
from estimators.geometry import wrap_angles
from estimators.immutable import immutable
from estimators.messages import FloatArray, IntArray, LoopClosure, RangeFrame, Scan


@immutable
class Track:
    """Poses (N, 3) of x [m], y [m], yaw [rad] in the map, with their covariance (N, 3, 3).

    NaN where there is no pose; the yaw is unwrapped, and NaN where it is not known.
    """

    stamps_ns: IntArray
    pose: FloatArray
    cov: FloatArray

    def at(self, stamps_ns: IntArray) -> FloatArray:
        """Poses (M, 3) at other times; NaN where a neighbouring instant has none."""
        if not len(self.stamps_ns):
            return np.full((len(stamps_ns), 3), np.nan)
        begin_ns = self.stamps_ns[0]
        times, known = stamps_ns - begin_ns, self.stamps_ns - begin_ns
        return np.column_stack([np.interp(times, known, c, np.nan, np.nan) for c in self.pose.T])


class Batch:
    """Ticks with what came before them, so that scans and steps across the seam are whole.

    Args:
        names: estimators, the primary first, whose verdicts are shown.
        before: ticks that were drawn already, and are only asked for poses.
        ticks: to be drawn.
        truths: newest true poses, as far as they are known.
        after: the tick after the last one, only asked for poses; None when there is none.

    Attributes:
        ticks: to be drawn.
        stamps_ns: (N,) of these.
        names: estimators, the primary first.
        tracks: estimator -> its poses at all ticks: before, these, and after.
        new: which of all ticks are to be drawn.
        frames: ranges taken in these ticks with the primary's report.
        scans: of these ticks, those without a beam left out.
        closures: of these ticks with the reports on them; not those that only found a place.
    """

    def __init__(
        self, names: list[str], before: list[Tick], ticks: list[Tick], truths: list[Truth], after: Tick | None
    ) -> None:
        everything = before + ticks + ([after] if after is not None else [])
        self.ticks = ticks
        self.before = before
        self.new = slice(len(before), len(before) + len(ticks))
        self.stamps_ns = np.array([tick.stamp_ns for tick in ticks], dtype=np.int64)
        self.names = names
        self.tracks = {name: _track(everything, name) for name in self.names}
        self.truths = truths
        self.frames: list[tuple[RangeFrame, Report]] = []
        self.scans: list[Scan] = []
        self.closures: list[tuple[LoopClosure, dict[str, Report]]] = []
        for tick in ticks:
            for outcome in tick.outcomes:
                if isinstance(outcome.measurement, RangeFrame):
                    self.frames.append((outcome.measurement, outcome.reports[names[0]]))
                elif isinstance(outcome.measurement, Scan) and len(outcome.measurement.ranges):
                    self.scans.append(outcome.measurement)
                elif isinstance(outcome.measurement, LoopClosure) and (
                    outcome.measurement.from_stamp_ns < outcome.measurement.stamp_ns
                ):
                    self.closures.append((outcome.measurement, outcome.reports))

    def errors(self, name: str) -> FloatArray:
        """Pose minus truth (N, 3) at the ticks, yaw wrapped; NaN where either is not known."""
        error = np.full((len(self.ticks), 3), np.nan)
        reference = Reference(self.truths)
        covered = np.array([reference.covers(stamp_ns) for stamp_ns in self.stamps_ns.tolist()])
        if covered.any():
            pose = self.tracks[name].pose[self.new]
            error[covered] = pose[covered] - reference.at(self.stamps_ns[covered].tolist())
            error[:, 2] = wrap_angles(error[:, 2])
        return error


def _track(ticks: list[Tick], name: str) -> Track:
    """One estimator's poses at all ticks; a pose that holds a NaN counts as none."""
    pose, cov = np.full((len(ticks), 3), np.nan), np.full((len(ticks), 3, 3), np.nan)
    for i, tick in enumerate(ticks):
        estimate = tick.poses[name]
        if estimate is not None and np.isfinite(estimate.T_map_body).all():
            pose[i], cov[i] = (*estimate.xy, estimate.yaw), estimate.planar_cov
    pose[~np.isfinite(cov[:, 2, 2]), 2] = np.nan
    known = np.isfinite(pose[:, 2])
    pose[known, 2] = np.unwrap(pose[known, 2])
    return Track(np.array([tick.stamp_ns for tick in ticks], dtype=np.int64), pose, cov)
