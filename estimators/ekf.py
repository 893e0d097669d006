"""The baseline: an extended Kalman filter on UWB ranges and planar odometry increments (filterpy)."""

import numpy as np

from estimators.base import Report, Verdict
from estimators.fix_taker import FixTaker
from estimators.geometry import wrap_angle
from estimators.lidar.odometry import POSE, LidarOdometry
from estimators.messages import FloatArray, LandmarkFrame, RangeFrame
from estimators.models.landmark import range_and_bearing


class Ekf(FixTaker, LidarOdometry):
    """LiDAR odometry held in place by tightly coupled UWB ranges.

    Every range corrects the state on its own, through the lever arm and after height reduction, when
    `RangeGate` lets it pass. The state is that of `LidarOdometry`.

    Where it follows chen2019, and where not. The paper measures ranges (3)-(4), and displacement and rotation
    since the scan before (7)-(8), and corrects a linear prediction (5) with all of them (15)-(20): so it is
    here. Its state (6) and Jacobians (12)-(14) are lost in the text; those here are ours and are tested
    against finite differences. Instead of the length of the displacement we take it as a vector in the body
    frame of a keyframe, because the direction is there for nothing; the keyframe's pose is part of the state,
    and the velocity too. A gate on every range is not in the paper. Its time bias r_D (1)-(2) is taken off
    before: `companion calibrate ranges`.

    Source: chen2019 Eq. (3)-(20).
    """

    class Config(FixTaker.Config, LidarOdometry.Config):
        """Settings of `ekf`."""

    def _place(self, pose: FloatArray, cov: FloatArray) -> None:
        super()._place(pose, cov)
        self._gate.reset()

    def _update_ranges(self, frame: RangeFrame) -> Report:
        pose, arm = self._filter.x[POSE], self._setup.arm(frame.tag_id)
        candidates = self._gate.horizontal.of(frame, pose, float(self._filter.P[2, 2]))
        report, residuals, by_pose = self._gate.judge_at(candidates, self._filter.P, arm)
        sigmas = candidates.rows[:, 3]
        used = np.isfinite(sigmas)
        if used.any():
            H = np.zeros((len(residuals), 9))
            H[:, POSE] = by_pose
            self._correct(residuals[used], H[used], np.diag(sigmas[used] ** 2))
        return report

    def _update_landmarks(self, frame: LandmarkFrame) -> Verdict:
        landmarks = self._landmark_gate.usable(frame)
        if isinstance(landmarks, Verdict):
            return landmarks
        verdict = Verdict.GATED
        for x, y, *measured in landmarks:
            predicted, by_pose = range_and_bearing(self._filter.x[POSE], np.array([x, y]))
            innovation = np.array(measured[:2]) - predicted
            innovation[1] = wrap_angle(innovation[1])
            H = np.zeros((2, 9))
            H[:, POSE] = by_pose
            R = np.diag(np.array(measured[2:]) ** 2)
            variances = np.diag(H @ self._filter.P @ H.T + R)
            if (innovation**2 <= self._landmark_gate.limit * variances).all():
                self._correct(innovation, H, R)
                verdict = Verdict.ACCEPTED
        return verdict
