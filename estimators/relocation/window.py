"""The last seconds of odometry, as one rigid piece of way, with the ranges that were measured along it."""

from collections import deque
from dataclasses import dataclass, replace
from math import cos, sin

import numpy as np

from estimators.base import Setup, Verdict
from estimators.geometry import compose, inverse, transform, wrap_angle
from estimators.immutable import immutable
from estimators.lidar.keyframes import is_covariance
from estimators.messages import FloatArray, IntArray, PoseIncrement, RangeFrame
from estimators.range_gate import HorizontalRanges

LONGEST_STEP_NS = 500_000_000
"""Ranges between two poses further apart than this have no place on the way."""
MOST_RANGES = 250
"""More ranges than this say little more, and cost time."""
_NO_POSE = np.zeros(3)


@immutable
class PlacedRanges:
    """Ranges along a piece of way. Its frame is the body's at the newest keyframe.

    Attributes:
        tags: (N, 2) where the tag was [m], frame of the way; in stamp order.
        anchors: (N, 2) [m], map frame.
        anchor_ids: (N,) int64.
        ranges: (N,) horizontal [m].
        sigmas: (N,) standard deviation of each, what the odometry drifts until the keyframe included [m].
        steps: (N,) int64, how many of the odometry's steps lie between a range and the newest keyframe.
        step_poses: (K, 3) where each such step began, frame of the way, newest first.
        step_ends: (K, 2) where it ended [m].
        step_covs: (K, 3, 3) covariance of each as the odometry gave it.
    """

    tags: FloatArray
    anchors: FloatArray
    anchor_ids: IntArray
    ranges: FloatArray
    sigmas: FloatArray
    steps: IntArray
    step_poses: FloatArray
    step_ends: FloatArray
    step_covs: FloatArray

    def some(self, index: IntArray) -> "PlacedRanges":
        """Only the ranges at these indices."""
        return replace(
            self,
            tags=self.tags[index],
            anchors=self.anchors[index],
            anchor_ids=self.anchor_ids[index],
            ranges=self.ranges[index],
            sigmas=self.sigmas[index],
            steps=self.steps[index],
        )


@dataclass(slots=True, eq=False)
class _Frame:
    """Ranges of one frame; `tag`, `step` and `until` are known once it is placed."""

    stamp_ns: int
    arm: FloatArray
    rows: FloatArray  # (N, 4) as `Candidates` has them
    anchor_ids: IntArray
    tag: tuple[float, float] = (0.0, 0.0)
    step: int = 0
    until: int = 0  # ranges on the way up to the last of these


@immutable
class _Step:
    begin: FloatArray
    end: FloatArray
    cov: FloatArray


class Window:
    """Chains increments through their keyframes and puts ranges where they were measured.

    Args:
        length: how far back ranges are kept [s].
        horizontal: reduces ranges to the horizontal.
        setup: geometry of the site; tells where tags sit.
    """

    def __init__(self, length: float, horizontal: HorizontalRanges, setup: Setup) -> None:
        self._length_ns = round(length * 1e9)
        self._horizontal = horizontal
        self._setup = setup
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._newest_ns: int | None = None
        self._waiting: deque[_Frame] = deque()
        self._break_off()

    def _break_off(self) -> None:
        """What lies behind hangs together with nothing to come."""
        self.keyframe_ns: int | None = None
        self.since_keyframe: list[PoseIncrement] = []
        """Increments from the newest keyframe on."""
        self._keyframe = self._last = np.zeros(3)
        self._last_ns: int | None = None
        self._placed: deque[_Frame] = deque()
        self._steps: deque[_Step] = deque()
        self._steps_made = 0

    @property
    def newest_pose(self) -> FloatArray:
        """(3,) where the body is at the newest increment, seen from the newest keyframe."""
        return self.since_keyframe[-1].increment if self.since_keyframe else np.zeros(3)

    def add_ranges(self, frame: RangeFrame) -> list[Verdict]:
        """Take a frame; what can be used gets `Verdict.WAITING`."""
        if self._is_late(frame.stamp_ns):
            return [Verdict.LATE] * len(frame.ranges)
        candidates = self._horizontal.of(frame, _NO_POSE, np.inf)
        verdicts, rows, ids = candidates.verdicts, candidates.rows, frame.anchor_ids
        if Verdict.WAITING in verdicts:
            if verdicts.count(Verdict.WAITING) < len(verdicts):
                usable = candidates.anchors >= 0
                rows, ids = rows[usable], ids[usable]
            self._waiting.append(_Frame(frame.stamp_ns, self._setup.arm(frame.tag_id), rows, ids))
            while self._waiting[0].stamp_ns < frame.stamp_ns - self._length_ns:
                self._waiting.popleft()
        return verdicts

    def add_increment(self, measured: PoseIncrement) -> Verdict:
        """Take an increment; one that does not hang together with those before begins a new way."""
        if self._is_late(measured.stamp_ns):
            return Verdict.LATE
        founds = measured.from_stamp_ns == measured.stamp_ns
        possible = founds or (bool(np.isfinite(measured.increment).all()) and is_covariance(measured.cov))
        if founds or not possible or measured.from_stamp_ns != self.keyframe_ns:
            self._break_off()
            self._waiting.clear()
            if measured.is_keyframe:
                self.keyframe_ns = self._last_ns = measured.stamp_ns
            return Verdict.WAITING if possible else Verdict.IMPOSSIBLE
        pose = compose(self._keyframe, measured.increment)
        self._place_waiting(measured.stamp_ns, pose)
        self._last, self._last_ns = pose, measured.stamp_ns
        if measured.is_keyframe:
            self._steps.append(_Step(self._keyframe, pose, measured.cov))
            self._steps_made += 1
            self._keyframe, self.keyframe_ns, self.since_keyframe = pose, measured.stamp_ns, []
        else:
            self.since_keyframe.append(measured)
        self._forget(measured.stamp_ns - self._length_ns)
        return Verdict.WAITING

    def ranges_since(self, age: float) -> PlacedRanges | None:
        """Ranges measured in the last so many seconds; None without any."""
        if self._last_ns is None:
            return None
        since_ns = self._last_ns - round(age * 1e9)
        placed = [frame for frame in self._placed if frame.stamp_ns >= since_ns]
        if not placed:
            return None
        count = placed[-1].until - placed[0].until + len(placed[0].rows)
        placed = placed[:: -(-count // MOST_RANGES)]
        T_keyframe_way = inverse(self._keyframe)
        rows = np.concatenate([frame.rows for frame in placed])
        ids = np.concatenate([frame.anchor_ids for frame in placed])
        each = [len(frame.rows) for frame in placed]
        tags = transform(T_keyframe_way, np.array([frame.tag for frame in placed])).repeat(each, axis=0)
        steps = self._steps_made - np.array([frame.step for frame in placed], dtype=np.int64).repeat(each)
        begun = list(self._steps)[::-1][: int(steps[0])]
        begins = np.array([compose(T_keyframe_way, step.begin) for step in begun]).reshape(-1, 3)
        ends = transform(T_keyframe_way, np.array([step.end[:2] for step in begun]).reshape(-1, 2))
        covs = np.array([step.cov for step in begun]).reshape(-1, 3, 3)
        sigmas = np.sqrt(rows[:, 3] ** 2 + _drift(tags, steps, ends, covs))
        return PlacedRanges(tags, rows[:, :2], ids, rows[:, 2], sigmas, steps, begins, ends, covs)

    def _is_late(self, stamp_ns: int) -> bool:
        if self._newest_ns is not None and stamp_ns < self._newest_ns:
            return True
        self._newest_ns = stamp_ns
        return False

    def _place_waiting(self, stamp_ns: int, pose: FloatArray) -> None:
        """Put ranges that wait for this pose on the way from the pose before."""
        assert self._last_ns is not None
        span = stamp_ns - self._last_ns
        frames = [frame for frame in self._waiting if self._last_ns <= frame.stamp_ns <= stamp_ns]
        self._waiting.clear()
        if not 0 < span <= LONGEST_STEP_NS:
            return
        # In plain floats: arrays of a few numbers take longer than all of the arithmetic.
        (x, y, yaw), (to_x, to_y, to_yaw) = self._last.tolist(), pose.tolist()
        turn = wrap_angle(to_yaw - yaw)
        for frame in frames:
            share = (frame.stamp_ns - self._last_ns) / span
            c, s = cos(yaw + share * turn), sin(yaw + share * turn)
            arm_x, arm_y, _ = frame.arm.tolist()
            frame.tag = (
                x + share * (to_x - x) + c * arm_x - s * arm_y,
                y + share * (to_y - y) + s * arm_x + c * arm_y,
            )
            frame.step = self._steps_made
            frame.until = len(frame.rows) + (self._placed[-1].until if self._placed else 0)
            self._placed.append(frame)

    def _forget(self, before_ns: int) -> None:
        while self._placed and self._placed[0].stamp_ns < before_ns:
            self._placed.popleft()
        oldest = self._placed[0].step if self._placed else self._steps_made
        while len(self._steps) > self._steps_made - oldest:
            self._steps.popleft()


def _drift(tags: FloatArray, steps: IntArray, ends: FloatArray, covs: FloatArray) -> FloatArray:
    """Variance (N,) along one axis of each tag's place, as far as steps since then have added to it [m^2]."""
    # The turn of a step moves a tag by its distance from the step's end; its square is written out.
    turned, (x, y) = 0.5 * covs[:, 2, 2], ends.T
    shifted = 0.5 * (covs[:, 0, 0] + covs[:, 1, 1])
    sums = np.zeros((len(covs) + 1, 4))
    np.cumsum(
        np.column_stack([shifted + turned * (x * x + y * y), turned, turned * x, turned * y]), 0, out=sums[1:]
    )
    (constant, square, by_x, by_y), (x, y) = sums[steps].T, tags.T
    total: FloatArray = constant + square * (x * x + y * y) - 2.0 * (by_x * x + by_y * y)
    return total
