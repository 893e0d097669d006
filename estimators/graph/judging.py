"""Which ranges and landmarks are believed, and the factors that they become.

Each is held against the state predicted to its instant, corrected by those of the same frame that were
believed before it, as an extended Kalman filter does.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from estimators.base import Report, Verdict
from estimators.geometry import wrap_angle
from estimators.graph import factors
from estimators.kernels import factor_rows
from estimators.kernels.range_gate import ACCEPTED, DOWNWEIGHTED
from estimators.landmark_gate import LandmarkGate
from estimators.messages import FloatArray, LandmarkFrame, RangeFrame
from estimators.models.landmark import range_and_bearing
from estimators.range_gate import Candidates, RangeGate


@dataclass(slots=True, eq=False)
class Belief:
    """A state and its covariance, corrected in place.

    Attributes:
        mean: (N,) beginning with x [m], y [m], yaw [rad].
        cov: (N, N).
    """

    mean: FloatArray
    cov: FloatArray

    def spread(self, by_pose: FloatArray, noise: FloatArray) -> FloatArray:
        """Covariance (M, M) of residuals of measurements with Jacobian (M, 3) and noise (M, M)."""
        return by_pose @ self.cov[:3, :3] @ by_pose.T + noise

    def correct(self, residual: FloatArray, by_pose: FloatArray, noise: FloatArray) -> None:
        """Take the measurement."""
        PH = self.cov[:, :3] @ by_pose.T
        S = by_pose @ PH[:3] + noise
        gain = np.linalg.solve(S, PH.T).T
        self.mean = self.mean + gain @ residual
        self.cov = self.cov - gain @ PH.T


def judge_ranges(
    gate: RangeGate, frame: RangeFrame, belief: Belief, arm: FloatArray
) -> tuple[Report, FloatArray]:
    """Verdicts on the ranges of a frame, and those that are believed as factors.

    A factor keeps what is taken off by the bearing now, though the window moves later.

    Args:
        gate: decides; remembers which anchors it doubts.
        frame: the ranges.
        belief: state at the frame's instant.
        arm: (3,) tag antenna in the body frame [m].

    Returns:
        The report; rows of `factors.ranges`, whose pose is not known yet.
    """
    candidates = gate.horizontal.of(frame, belief.mean[:3], belief.cov[2, 2])
    report, _, _ = gate.judge_at(candidates, belief.cov, arm)
    return report, believed_ranges(candidates, arm, weighed=True)


def believed_ranges(judged: Candidates, arm: FloatArray, *, weighed: bool) -> FloatArray:
    """Ranges that a gate lets pass as rows of `factors.ranges`, whose pose is not known yet.

    Args:
        judged: by the gate, together.
        arm: (3,) tag antenna in the body frame [m].
        weighed: those that count less are among them.
    """
    least = DOWNWEIGHTED if weighed else ACCEPTED
    return factor_rows.ranges(judged.anchors, judged.rows, judged.codes, least, *arm[:2].tolist())


def judge_landmarks(
    gate: LandmarkGate,
    frame: LandmarkFrame,
    belief: Belief,
    numbers: Mapping[tuple[float, float], int],
) -> tuple[Verdict, FloatArray]:
    """Verdict on a look at landmarks, and those that are believed as factors.

    Args:
        gate: decides.
        frame: what was seen.
        belief: state at the frame's instant; it is corrected.
        numbers: place of a landmark in the map [m] -> variable in the graph.

    Returns:
        The verdict; rows of `factors.sightings`, -1 for the pose.
    """
    landmarks, rows = gate.usable(frame), []
    if isinstance(landmarks, Verdict):
        return landmarks, np.empty((0, factors.SIGHTING))
    for x, y, *measured in landmarks.tolist():
        predicted, by_pose = range_and_bearing(belief.mean, np.array([x, y]))
        residual = np.array(measured[:2]) - predicted
        residual[1] = wrap_angle(residual[1])
        noise = np.diag(np.square(measured[2:]))
        if (residual**2 <= gate.limit * np.diag(belief.spread(by_pose, noise))).all():
            belief.correct(residual, by_pose, noise)
            rows.append((numbers[x, y], *measured))
    if not rows:
        return Verdict.GATED, np.empty((0, factors.SIGHTING))
    return Verdict.ACCEPTED, factors.sightings(-1, *np.array(rows).T)
