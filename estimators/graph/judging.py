"""Which ranges and landmarks are believed, and the factors that they become.

Each is held against the state predicted to its instant, corrected by those of the same frame that were
believed before it, as an extended Kalman filter does.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

import numpy as np

from estimators.base import Report, Verdict
from estimators.geometry import wrap_angle
from estimators.graph import factors
from estimators.messages import FloatArray, LandmarkFrame, RangeFrame
from estimators.models.landmark import range_and_bearing
from estimators.models.range import horizontal_range
from estimators.range_gate import RangeGate


@dataclass(slots=True, eq=False)
class Belief:
    """A state and its covariance, corrected in place.

    Attributes:
        mean: (N,) beginning with x [m], y [m], yaw [rad].
        cov: (N, N).
    """

    mean: FloatArray
    cov: FloatArray

    def nis(self, residual: FloatArray, by_pose: FloatArray, noise: FloatArray) -> float:
        """Normalised innovation squared of a measurement (M,) with Jacobian (M, 3) and noise (M, M)."""
        S = by_pose @ self.cov[:3, :3] @ by_pose.T + noise
        return float(residual @ np.linalg.solve(S, residual))

    def correct(self, residual: FloatArray, by_pose: FloatArray, noise: FloatArray) -> None:
        """Take the measurement."""
        PH = self.cov[:, :3] @ by_pose.T
        S = by_pose @ PH[:3] + noise
        gain = np.linalg.solve(S, PH.T).T
        self.mean = self.mean + gain @ residual
        self.cov = self.cov - gain @ PH.T


def judge_ranges(
    gate: RangeGate, frame: RangeFrame, belief: Belief, arm: FloatArray, numbers: Mapping[int, int]
) -> tuple[Report, FloatArray]:
    """Verdicts on the ranges of a frame, and those that are believed as factors.

    Args:
        gate: decides; remembers which anchors it doubts.
        frame: the ranges.
        belief: state at the frame's instant; it is corrected.
        arm: (3,) tag antenna in the body frame [m].
        numbers: anchor id -> variable in the graph.

    Returns:
        The report; rows of `factors.ranges`, -1 for the pose.
    """
    count = len(frame.ranges)
    verdicts = [Verdict.ACCEPTED] * count
    residuals, nis = np.full(count, np.nan), np.full(count, np.nan)
    for i, item in enumerate(gate.horizontal(frame)):
        if isinstance(item, Verdict):
            verdicts[i] = item
            continue
        anchor, measured, sigma = item
        predicted, by_pose = horizontal_range(belief.mean, anchor, arm)
        residual, H, R = np.array([measured - predicted]), by_pose[None], np.array([[sigma**2]])
        residuals[i], nis[i] = residual[0], belief.nis(residual, H, R)
        verdicts[i] = gate.judge(int(frame.anchor_ids[i]), frame.stamp_ns, float(nis[i]))
        if verdicts[i] is Verdict.ACCEPTED:
            belief.correct(residual, H, R)
    report = Report(tuple(verdicts), residuals, nis)
    return report, believed_ranges(gate, frame, report.verdicts, arm, numbers)


def believed_ranges(
    gate: RangeGate,
    frame: RangeFrame,
    verdicts: Sequence[Verdict],
    arm: FloatArray,
    numbers: Mapping[int, int],
) -> FloatArray:
    """Ranges with the verdict `ACCEPTED` as rows of `factors.ranges`, -1 for the pose.

    They are horizontal, as the gate has them: those of the filters.
    """
    believed = [
        (numbers[anchor_id], *item[1:])
        for anchor_id, verdict, item in zip(
            frame.anchor_ids.tolist(), verdicts, gate.horizontal(frame), strict=True
        )
        if verdict is Verdict.ACCEPTED and not isinstance(item, Verdict)
    ]
    if not believed:
        return np.empty((0, factors.RANGE))
    anchors, measured, sigmas = np.array(believed).T
    return factors.ranges(-1, anchors, measured, sigmas, arm[:2])


def judge_landmarks(
    limit: float,
    frame: LandmarkFrame,
    belief: Belief,
    positions: Mapping[int, FloatArray],
    numbers: Mapping[int, int],
) -> tuple[Verdict, FloatArray]:
    """Verdict on a look at landmarks, and those that are believed as factors.

    Args:
        limit: greatest NIS of a range and bearing that passes.
        frame: what was seen.
        belief: state at the frame's instant; it is corrected.
        positions: landmark id -> (2,) in the map [m].
        numbers: landmark id -> variable in the graph.

    Returns:
        The verdict; rows of `factors.sightings`, the pose still to be filled in.
    """
    known = [i for i, landmark_id in enumerate(frame.landmark_ids.tolist()) if landmark_id in positions]
    if not known:
        return Verdict.NOT_USED, np.empty((0, factors.SIGHTING))
    sigmas = frame.range_sigma, frame.bearing_sigma
    possible = [i for i in known if _is_possible(float(frame.ranges[i]), float(frame.bearings[i]), *sigmas)]
    rows = []
    for i in possible:
        landmark_id = int(frame.landmark_ids[i])
        predicted, by_pose = range_and_bearing(belief.mean, positions[landmark_id])
        residual = np.array([frame.ranges[i], frame.bearings[i]]) - predicted
        residual[1] = wrap_angle(residual[1])
        noise = np.diag(np.square(sigmas))
        if belief.nis(residual, by_pose, noise) <= limit:
            belief.correct(residual, by_pose, noise)
            rows.append((-1, numbers[landmark_id], frame.ranges[i], frame.bearings[i], *sigmas, 0.0, 1.0))
    verdict = Verdict.ACCEPTED if rows else Verdict.GATED if possible else Verdict.IMPOSSIBLE
    return verdict, np.array(rows, dtype=np.float64).reshape(-1, factors.SIGHTING)


def _is_possible(distance: float, bearing: float, range_sigma: float, bearing_sigma: float) -> bool:
    """Whether a landmark's numbers are numbers, and positive where they must be."""
    return (
        0.0 < distance < np.inf
        and isfinite(bearing)
        and 1e-6 < range_sigma < np.inf
        and 1e-6 < bearing_sigma < np.inf
    )
