"""The graph of a whole recording: a pose and a velocity for every instant at which something was measured."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimators.base import Setup
from estimators.graph import factors
from estimators.graph.errors import GraphError
from estimators.graph.factors import DensePrior, Graph
from estimators.graph.losses import GAUSSIAN, Loss, LossKind
from estimators.lidar.keyframes import START_SPEED_SIGMA, is_covariance
from estimators.messages import (
    FloatArray,
    IntArray,
    LandmarkFrame,
    LoopClosure,
    Measurement,
    PoseIncrement,
    RangeFrame,
)

SAME_NS = 1_000_000
"""Measurements within this time share a pose, as in `estimators.graph.smoother`."""
PLACE_SIGMA = 1.0
"""How well a site file is thought to know an anchor that is to be found [m]."""
COMMON_BIAS_SIGMA, OWN_BIAS_SIGMA = 0.5, 0.1
"""Bias of a range: what the tag and the air add for all anchors, and what an anchor adds by itself [m]."""
_RANGE_LOSS = Loss(LossKind.ONE_SIDED, 2.0)
_INCREMENT_LOSS = Loss(LossKind.HUBER, 4.0)


@dataclass(frozen=True, slots=True)
class Noise:
    """What measurements and motion are taken to err by.

    Attributes:
        range_sigma: standard deviation of a range [m].
        accel: density of white acceleration [m/s^2/sqrt(Hz)].
        yaw_accel: density of white angular acceleration [rad/s^2/sqrt(Hz)].
    """

    range_sigma: float
    accel: float
    yaw_accel: float


class Recording:
    """Measurements in the form of factors.

    Measurements that are impossible, or of unknown anchors and landmarks, are left out.

    Attributes:
        stamps_ns: (K,) instants of the poses.
        anchor_ids: of the first variables, in their order.
        ranges: (M, 9) rows of `factors.ranges`.
        range_stamps_ns: (M,) their instants.
        closures: (D,) which rows of the graph's increments are loop closures.
        heading_known: False when nothing measured turns with the robot.

    Args:
        measurements: in any order.
        setup: geometry of the site.
        noise: of measurements and motion.

    Raises:
        GraphError: there is nothing to smooth.
    """

    def __init__(self, measurements: Sequence[Measurement], setup: Setup, noise: Noise) -> None:
        self._setup, self._noise = setup, noise
        self.anchor_ids = list(setup.anchors)
        self._anchors = {anchor_id: i for i, anchor_id in enumerate(self.anchor_ids)}
        self._landmarks = {i: len(setup.anchors) + k for k, i in enumerate(setup.landmarks)}
        self._known = len(setup.anchors) + len(setup.landmarks)
        steps = [m for m in measurements if isinstance(m, PoseIncrement) and _is_step(m)]
        closures = [m for m in measurements if isinstance(m, LoopClosure) and _is_step(m)]
        frames = [m for m in measurements if isinstance(m, RangeFrame)]
        looks = [m for m in measurements if isinstance(m, LandmarkFrame)]
        ends = [(m.from_stamp_ns, m.stamp_ns) for m in steps]
        ends += [(m.from_stamp_ns, m.stamp_ns) for m in closures]
        instants = [stamp_ns for pair in ends for stamp_ns in pair]
        instants += [m.stamp_ns for m in frames] + [m.stamp_ns for m in looks]
        self.stamps_ns = _apart(np.unique(np.array(instants, dtype=np.int64)))
        if len(self.stamps_ns) < 2:
            raise GraphError(
                f"recording: ranges or increments at {len(self.stamps_ns)} instants, at least 2 are needed"
            )
        rows = [self._range_rows(frame) for frame in frames]
        self.ranges = np.concatenate([np.empty((0, factors.RANGE)), *rows])
        self.range_stamps_ns = np.repeat([frame.stamp_ns for frame in frames], [len(row) for row in rows])
        self._sightings = np.concatenate(
            [np.empty((0, factors.SIGHTING)), *(self._sighting_rows(look) for look in looks)]
        )
        odometry = self._increment_rows(steps, _INCREMENT_LOSS)
        self._increments = np.concatenate([odometry, self._increment_rows(closures, GAUSSIAN)])
        self.closures = np.arange(len(odometry), len(self._increments))
        turning = len(self._increments) + len(self._sightings) + np.abs(self.ranges[:, 4:6]).sum()
        self.heading_known = bool(turning > 0.0)

    def graph(self, poses: FloatArray, find_anchors: bool, find_biases: bool) -> Graph:
        """The graph.

        Args:
            poses: (K, 3) where the search begins.
            find_anchors: x and y of the anchors are free, held by the site file's to `PLACE_SIGMA`.
            find_biases: biases of the anchors are free, held to what biases are.
        """
        count, first = len(self.stamps_ns), self._known
        places = [*(p[:2] for p in self._setup.anchors.values()), *self._setup.landmarks.values()]
        values, free = np.zeros((first + 2 * count, 3)), np.ones((first + 2 * count, 3))
        values[:first, :2], free[:first] = np.array(places).reshape(-1, 2), factors.FIXED
        anchors = np.arange(len(self.anchor_ids))
        free[anchors, :2], free[anchors, 2] = find_anchors, find_biases
        times = (self.stamps_ns - self.stamps_ns[0]) * 1e-9
        values[first::2] = poses
        values[first::2, 2] = np.unwrap(poses[:, 2])
        values[first + 1 :: 2] = np.gradient(values[first::2], times, axis=0)
        if not self.heading_known:
            free[first:, 2] = 0.0
            values[first + 1 :: 2, 2] = 0.0
        of_poses = self._variable(self.stamps_ns)
        noise, start = self._noise, self._setup.start
        motions = factors.motions(of_poses[:-1], of_poses[1:], np.diff(times), noise.accel, noise.yaw_accel)
        start_priors = [
            factors.priors(first, start.pose, np.diag(start.sigma**-2), is_pose=True),
            factors.priors(first + 1, np.zeros(3), np.eye(3) / START_SPEED_SIGMA**2, is_pose=False),
        ]
        return Graph(
            values,
            free,
            increments=self._increments,
            ranges=self.ranges,
            sightings=self._sightings,
            motions=motions,
            priors=np.concatenate(start_priors),
            dense=_anchor_prior(values[anchors]) if find_anchors or find_biases else factors.NOTHING_KNOWN,
            name=self._name,
        )

    def _name(self, variable: int) -> str:
        if variable < len(self.anchor_ids):
            return f"anchor {self.anchor_ids[variable]}"
        if variable < self._known:
            return f"landmark {list(self._landmarks)[variable - len(self.anchor_ids)]}"
        k, is_velocity = divmod(variable - self._known, 2)
        seconds = (self.stamps_ns[k] - self.stamps_ns[0]) * 1e-9
        return f"{'velocity' if is_velocity else 'pose'} at {seconds:.2f} s"

    def _variable(self, stamps_ns: IntArray) -> IntArray:
        """Pose variables (M,) of instants (M,)."""
        later = np.clip(np.searchsorted(self.stamps_ns, stamps_ns), 1, len(self.stamps_ns) - 1)
        is_earlier = stamps_ns - self.stamps_ns[later - 1] < self.stamps_ns[later] - stamps_ns
        return np.asarray(self._known + 2 * (later - is_earlier), dtype=np.int64)

    def _range_rows(self, frame: RangeFrame) -> FloatArray:
        known = [i for i, anchor_id in enumerate(frame.anchor_ids.tolist()) if anchor_id in self._anchors]
        ids, measured = frame.anchor_ids[known].tolist(), frame.ranges[known]
        arm = self._setup.arm(frame.tag_id)
        heights = np.array([self._setup.anchors[i][2] for i in ids]) - self._setup.height - arm[2]
        rows = factors.ranges(
            self._variable(np.array([frame.stamp_ns]))[0],
            [self._anchors[i] for i in ids],
            measured,
            self._noise.range_sigma,
            arm[:2],
            heights,
            _RANGE_LOSS,
        )
        return np.asarray(rows[np.isfinite(measured) & (measured > np.abs(heights))])

    def _sighting_rows(self, look: LandmarkFrame) -> FloatArray:
        known = [i for i, landmark in enumerate(look.landmark_ids.tolist()) if landmark in self._landmarks]
        rows = factors.sightings(
            self._variable(np.array([look.stamp_ns]))[0],
            [self._landmarks[i] for i in look.landmark_ids[known].tolist()],
            look.ranges[known],
            look.bearings[known],
            look.range_sigma,
            look.bearing_sigma,
        )
        whole = np.isfinite(rows).all(axis=1) & (rows[:, [2, 4, 5]] > 0.0).all(axis=1)
        return np.asarray(rows[whole])

    def _increment_rows(self, steps: Sequence[PoseIncrement | LoopClosure], loss: Loss) -> FloatArray:
        if not steps:
            return np.empty((0, factors.INCREMENT))
        ends = [self._variable(np.array([m.from_stamp_ns, m.stamp_ns])) for m in steps]
        first, second = np.array(ends).T
        measured, covs = np.array([m.increment for m in steps]), np.array([m.cov for m in steps])
        rows = factors.increments(first, second, measured, covs, loss)
        return np.asarray(rows[first != second])


def _is_step(measured: PoseIncrement | LoopClosure) -> bool:
    return (
        measured.from_stamp_ns < measured.stamp_ns
        and bool(np.isfinite(measured.increment).all())
        and is_covariance(measured.cov)
    )


def _apart(stamps_ns: IntArray) -> IntArray:
    """Ascending instants without those that follow another one too closely."""
    kept: list[int] = []
    for stamp_ns in stamps_ns.tolist():
        if not kept or stamp_ns - kept[-1] >= SAME_NS:
            kept.append(stamp_ns)
    return np.array(kept, dtype=np.int64)


def _anchor_prior(at: FloatArray) -> DensePrior:
    """What is known of anchors (A, 3) beforehand: their places, and how their biases hang together."""
    count = len(at)
    biases = COMMON_BIAS_SIGMA**2 * np.ones((count, count)) + OWN_BIAS_SIGMA**2 * np.eye(count)
    by_place = PLACE_SIGMA**-2
    information = np.diag(np.tile([by_place, by_place, 0.0], count))
    information[2::3, 2::3] = np.linalg.inv(biases)
    return DensePrior(np.arange(count), at, information, np.zeros(3 * count))
