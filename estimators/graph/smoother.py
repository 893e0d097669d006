"""The pose of now from a graph over the last seconds: increments, ranges, landmarks and smooth motion.

Every measurement that is believed gets a node at its instant, or joins the one that is there. Nodes hang
together by constant velocity and by increments from keyframes. Whether a measurement is believed is
decided by its NIS against the state predicted to its instant. What comes late goes where it belongs.
"""

import numpy as np
from pydantic import Field

from estimators.base import Report, Setup, Sketch, Verdict
from estimators.graph import factors
from estimators.graph.errors import GraphError
from estimators.graph.jumps import is_jump
from estimators.landmark_gate import LandmarkGate
from estimators.lidar.keyframes import START_SPEED_SIGMA, KeyframeTracker, is_covariance
from estimators.lidar.odometry import MAX_HEADING_SIGMA
from estimators.messages import (
    FloatArray,
    LandmarkFrame,
    LoopClosure,
    Measurement,
    PoseEstimate,
    PoseIncrement,
    RangeFrame,
    Scan,
)
from estimators.range_gate import RangeGate

SAME_NS = 1_000_000
"""Measurements within this time share a node: it saves a motion of no length, and costs 1 mm at 1 m/s."""
POSE, VELOCITY, REFERENCE, STATE = slice(0, 3), slice(3, 6), slice(6, 9), slice(0, 6)
_WIDEST = np.array([100.0, 100.0, np.pi, 10.0, 10.0, 10.0])
"""Standard deviations [m, rad, m/s, rad/s] beyond which a window that begins anew knows nothing at all."""

_OF_NODE = {"increments": 1, "ranges": 0, "sightings": 0}
"""Column of each table for the node of the instant at which a factor was measured."""

_TAKES: frozenset[type[Measurement]] = frozenset(
    {RangeFrame, LandmarkFrame, PoseIncrement, LoopClosure, Scan}
)


class GraphSmoother(KeyframeTracker):
    """Fixed-lag smoother on ranges, increments and landmarks, begun by dead reckoning from the start.

    What it tells of now is a mean and covariance of pose, velocity and the keyframe's pose, (9,), as `ekf`
    has them, but after all of the window has been solved anew.

    Source: huang2024 Eq. (29)-(38).
    """

    class Config(LandmarkGate.Config, RangeGate.Config, KeyframeTracker.Config):
        """Settings of `graph`."""

        lag: float = Field(3.0, gt=0, le=60, description="the window reaches back so far [s]")
        places: int = Field(
            10,
            ge=0,
            le=200,
            description="poses of so many places, the newest, stay in it for loop closures; the time of an "
            "update grows with their square",
        )

    def __init__(self, config: Config, setup: Setup) -> None:
        # Numba loads slowly: only who makes a smoother waits for it.
        from estimators.graph import fixed_lag, judging
        from estimators.kernels import factor_rows, motion

        super().__init__(config, setup)
        self._fixed_lag, self._judging, self._motion, self._rows = fixed_lag, judging, motion, factor_rows
        self._lag_ns = round(config.lag * 1e9)
        self._most_places = config.places
        self._gate = RangeGate(config, setup)
        self._landmark_gate = LandmarkGate(config, setup)
        self._landmark_numbers = {
            (float(x), float(y)): len(setup.anchors) + k for k, (x, y) in enumerate(setup.landmarks.values())
        }
        places = [*(p[:2] for p in setup.anchors.values()), *setup.landmarks.values()]
        self._known = np.array([[*place, 0.0] for place in places]).reshape(-1, 3)
        self.reset()

    @property
    def takes(self) -> frozenset[type[Measurement]]:
        """Scans are among them, for what they show of obstacles."""
        return _TAKES

    @property
    def state(self) -> tuple[FloatArray, FloatArray]:
        """State (9,) and covariance (9, 9) at the newest node, for tests."""
        return self._mean.copy(), self._cov.copy()

    def update(self, measurement: Measurement) -> Report:
        """Take one measurement; late ones too, within the window. Scans only show what blocks ranges."""
        if isinstance(measurement, RangeFrame | LandmarkFrame | PoseIncrement):
            if self._is_late(measurement.stamp_ns):
                return self._update_late(measurement)
            if not isinstance(measurement, PoseIncrement):
                self._predict_to(measurement.stamp_ns)
                return self._judge_newest(measurement)
        if isinstance(measurement, LoopClosure):
            return self._update_closure(measurement)
        report = super().update(measurement)
        self._gate.see(measurement, self.pose_at)
        return report

    def pose_at(self, stamp_ns: int) -> PoseEstimate | None:
        """Newest pose predicted with constant velocity; None before the first measurement.

        The variance of yaw is infinite once the heading was lost, until reset, as in `ekf`.
        """
        if self._stamp_ns is None or not self._reaches(stamp_ns):
            return None
        mean, cov = self._predicted(stamp_ns)
        return self._estimate(stamp_ns, mean[STATE], cov[STATE, STATE], self._heading_known)

    def _doubt(self, stamp_ns: int) -> float:
        return self._gate.doubt(stamp_ns)

    def sketch(self) -> Sketch:
        """The poses of the window, and which of them are keyframes."""
        window = self._window
        poses = np.array([window.graph.values[window.variable(i)] for i in range(len(window.stamps_ns))])
        poses = poses.reshape(-1, 3)
        return Sketch(
            window=poses, keyframes=poses[np.isin(window.stamps_ns, list(self._keyframes.values()))]
        )

    def _place(self, pose: FloatArray, cov: FloatArray) -> None:
        self._gate.reset()
        self._mean = np.concatenate([pose, np.zeros(3), pose])
        self._cov = np.zeros((9, 9))
        for rows in (POSE, REFERENCE):
            for columns in (POSE, REFERENCE):
                self._cov[rows, columns] = cov
        self._cov[VELOCITY, VELOCITY] = np.eye(3) * START_SPEED_SIGMA**2
        self._heading_known = True
        stamp_ns = self._stamp_ns
        self._begin_window(0 if stamp_ns is None else stamp_ns)
        self._keyframes: dict[int, int] = {} if stamp_ns is None else {stamp_ns: stamp_ns}
        self._places: dict[int, int] = {}

    def _set_speed_free(self) -> None:
        """Its speed always is; while it stands, nothing is predicted with it."""

    def _move(self, dt: float) -> None:
        """Nodes come with measurements that are believed."""

    def _begin_anew(self) -> None:
        assert self._stamp_ns is not None
        _, cov = self._predicted(self._stamp_ns)
        self._heading_known &= bool(cov[2, 2] < MAX_HEADING_SIGMA**2)

    def _predict_to(self, stamp_ns: int) -> None:
        super()._predict_to(stamp_ns)
        if self._stands:
            self._window.stamps_ns[-1] = stamp_ns
            self._keyframes = dict.fromkeys(self._keyframes, stamp_ns)
            self._places = dict.fromkeys(self._places, stamp_ns)

    def _follow(self, measured: PoseIncrement) -> Report:
        mean, cov = self._predicted(measured.stamp_ns)
        nis = self._nis(measured, mean[REFERENCE], mean[POSE], cov)
        passes = nis <= self._increment_gate and self._take_increment(measured)
        return Report((Verdict.ACCEPTED if passes else Verdict.GATED,), np.full(1, np.nan), np.array([nis]))

    def _take_reference(self) -> None:
        assert self._stamp_ns is not None
        self._keep_keyframe(self._stamp_ns)
        for block in (self._mean, self._cov, self._cov.T):
            block[REFERENCE] = block[POSE]

    def _judge_newest(self, frame: RangeFrame | LandmarkFrame) -> Report:
        """Take what is believed of a frame that is newer than all before."""
        return self._judge(frame, *self._predicted(frame.stamp_ns))

    def _judge(self, frame: RangeFrame | LandmarkFrame, mean: FloatArray, cov: FloatArray) -> Report:
        """Take what is believed of a frame, against the state at its instant."""
        belief = self._judging.Belief(mean[STATE], cov[STATE, STATE])
        if isinstance(frame, RangeFrame):
            report, rows = self._judging.judge_ranges(
                self._gate, frame, belief, self._setup.arm(frame.tag_id)
            )
            table = "ranges"
        else:
            verdict, rows = self._judging.judge_landmarks(
                self._landmark_gate, frame, belief, self._landmark_numbers
            )
            report, table = Report((verdict,)), "sightings"
        return self._taken(frame.stamp_ns, table, rows, report)

    def _taken(self, stamp_ns: int, table: str, rows: FloatArray, report: Report) -> Report:
        """Take factors; the report, unless the graph cannot be solved with them."""
        if len(rows) == 0 or self._take(stamp_ns, table, rows):
            return report
        gated = (Verdict.GATED if v.is_used else v for v in report.verdicts)
        return Report(tuple(gated), report.residuals, report.nis)

    def _update_late(self, measurement: RangeFrame | LandmarkFrame | PoseIncrement) -> Report:
        """Take a measurement at an instant that was passed, if the window reaches back to it."""
        count = len(measurement.ranges) if isinstance(measurement, RangeFrame) else 1
        too_late = Report((Verdict.LATE,) * count)
        node = None if self._stands else self._node_of(measurement.stamp_ns)
        if node is None:
            return too_late
        try:
            if isinstance(measurement, PoseIncrement):
                return Report((self._update_late_increment(measurement, node),))
            return self._judge(measurement, *self._window.state_of(node))
        except GraphError:
            return too_late

    def _update_late_increment(self, measured: PoseIncrement, node: int) -> Verdict:
        verdict, reference = Verdict.ACCEPTED, self._node_of_keyframe(measured.from_stamp_ns)
        if measured.from_stamp_ns != measured.stamp_ns:
            if not (np.isfinite(measured.increment).all() and is_covariance(measured.cov)):
                verdict = Verdict.IMPOSSIBLE
            elif reference is None:
                verdict = Verdict.NO_REFERENCE
            else:
                # The two poses are taken for independent, which makes the gate wider than need be.
                (earlier, cov_earlier), (later, cov_later) = map(self._window.state_of, (reference, node))
                cov = np.zeros((9, 9))
                cov[POSE, POSE] = cov_later[POSE, POSE]
                cov[REFERENCE, REFERENCE] = cov_earlier[POSE, POSE]
                nis = self._nis(measured, earlier[POSE], later[POSE], cov)
                if not (nis <= self._increment_gate and self._take_increment(measured)):
                    verdict = Verdict.GATED
        if measured.is_keyframe:
            self._keep_keyframe(measured.stamp_ns)
        return verdict

    def _update_closure(self, measured: LoopClosure) -> Report:
        """Take a closure at the newest keyframe, if its place is still in the window.

        The place stayed there as a node, so what its pose and that of now have in common is known, and
        nothing is counted twice.
        """
        node_ns = self._keyframes.get(measured.stamp_ns)
        if node_ns is None or node_ns != self._window.stamps_ns[-1]:
            return Report((Verdict.NO_REFERENCE,))
        if measured.from_stamp_ns == measured.stamp_ns:
            self._places[measured.stamp_ns] = node_ns
            while len(self._places) > self._most_places:
                del self._places[next(iter(self._places))]
            return Report((Verdict.ACCEPTED,))
        if not (np.isfinite(measured.increment).all() and is_covariance(measured.cov)):
            return Report((Verdict.IMPOSSIBLE,))
        place = self._window.node_at(self._places.get(measured.from_stamp_ns, -1))
        if place is None or place == len(self._window.stamps_ns) - 1:
            return Report((Verdict.NO_REFERENCE,))
        try:
            cov = self._window.update(place)
        except GraphError:
            return Report((Verdict.GATED,))
        variable = self._window.variable(place)
        at, now = self._window.graph.values[variable], self._window.newest[0]
        nis = self._nis(measured, at, now, cov)
        rows = self._rows.increment(variable, measured.increment, measured.cov)
        passes = nis <= self._increment_gate and self._take(measured.stamp_ns, "increments", rows)
        return Report((Verdict.ACCEPTED if passes else Verdict.GATED,), np.full(1, np.nan), np.array([nis]))

    def _nis(
        self, measured: PoseIncrement | LoopClosure, reference: FloatArray, pose: FloatArray, cov: FloatArray
    ) -> float:
        """NIS of a motion between two poses; covariance (9, 9) of the second, its velocity and the first."""
        return self._motion.increment_nis(reference, pose, cov, measured.increment, measured.cov)

    def _take_increment(self, measured: PoseIncrement) -> bool:
        node = self._node_of(measured.stamp_ns)
        reference = self._node_of_keyframe(measured.from_stamp_ns)
        if node is None or reference is None or node == reference:
            return False
        rows = self._rows.increment(self._window.variable(reference), measured.increment, measured.cov)
        return self._take(measured.stamp_ns, "increments", rows)

    def _take(self, stamp_ns: int, table: str, rows: FloatArray) -> bool:
        """Add factors on the node of an instant, whose number is not in them yet, and solve."""
        node = self._node_of(stamp_ns)
        assert node is not None
        rows[:, _OF_NODE[table]] = self._window.variable(node)
        self._window.add(**{table: rows})
        return self._solve()

    def _solve(self) -> bool:
        """Bring the window to its optimum; or begin it anew without the newest factors, if it has none."""
        window = self._window
        reference = self._node_of_keyframe(self._reference_stamp_ns)
        if reference == len(window.stamps_ns) - 1:
            reference = None
        try:
            cov = window.update(reference)
        except GraphError:
            self._begin_window(int(window.stamps_ns[-1]))
            self._keyframes, self._places = {}, {}
            self._reference_stamp_ns = None
            return False
        mean = window.newest.ravel()
        if reference is None:
            pick = np.r_[STATE, POSE]
            mean, cov = mean[pick], cov[np.ix_(pick, pick)]
        else:
            mean = np.concatenate([mean, window.graph.values[window.variable(reference)]])
        self._reset_counter += is_jump(self._mean[POSE], self._cov[POSE, POSE], mean[POSE])
        self._mean, self._cov = mean, cov
        if self._stands:
            window.absorb()
            return True
        kept = [*self._places.values()]
        if self._reference_stamp_ns is not None:
            kept.append(self._keyframes.get(self._reference_stamp_ns, 0))
        if window.drop_before(int(window.stamps_ns[-1]) - self._lag_ns, kept):
            nodes_ns = set(window.stamps_ns.tolist())
            self._keyframes = {k: node_ns for k, node_ns in self._keyframes.items() if node_ns in nodes_ns}
        return True

    def _begin_window(self, stamp_ns: int) -> None:
        """Begin a window with what is known of the state at an instant, and nothing else."""
        sigma = np.sqrt(np.diag(self._cov)[STATE])
        scale = np.minimum(1.0, _WIDEST / sigma)
        self._window = self._fixed_lag.FixedLag(self._known, width=2)
        self._window.begin(
            stamp_ns, self._mean[STATE].reshape(2, 3), self._cov[STATE, STATE] * np.outer(scale, scale)
        )

    def _predicted(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """State (9,) and covariance (9, 9) at an instant near the newest node."""
        dt = 0.0 if self._stands else (stamp_ns - int(self._window.stamps_ns[-1])) * 1e-9
        return self._motion.predicted(self._mean, self._cov, dt, *self._accel_noise)

    def _node_of(self, stamp_ns: int) -> int | None:
        """The node of an instant, made if there is none yet; None when the window does not reach back."""
        window = self._window
        newest_ns = int(window.stamps_ns[-1])
        if stamp_ns < newest_ns + SAME_NS:
            if stamp_ns < window.stamps_ns[0]:
                return None
            nearest = window.nearest(stamp_ns)
            is_there = abs(int(window.stamps_ns[nearest]) - stamp_ns) < SAME_NS
            return nearest if is_there else window.interpolate(stamp_ns)
        self._mean, self._cov = self._predicted(stamp_ns)
        node = window.insert(stamp_ns, self._guess(stamp_ns))
        ends = window.variable(node - 1), window.variable(node)
        window.add(motions=factors.motion(*ends, (stamp_ns - newest_ns) * 1e-9, *self._accel_noise))
        return node

    def _guess(self, stamp_ns: int) -> FloatArray:  # noqa: ARG002
        """State (2, 3) that the search for a new node begins at."""
        return self._mean[STATE].reshape(2, 3).copy()

    def _keep_keyframe(self, stamp_ns: int) -> None:
        node = self._node_of(stamp_ns)
        if node is not None:
            self._keyframes[stamp_ns] = int(self._window.stamps_ns[node])

    def _node_of_keyframe(self, stamp_ns: int | None) -> int | None:
        node_ns = None if stamp_ns is None else self._keyframes.get(stamp_ns)
        return None if node_ns is None else self._window.node_at(node_ns)
