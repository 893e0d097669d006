"""The baseline: an extended Kalman filter on UWB ranges and planar odometry increments (filterpy)."""

import numpy as np
from pydantic import Field
from scipy.stats import chi2

from estimators.base import Report, Setup, Verdict
from estimators.lidar.odometry import POSE, LidarOdometry
from estimators.messages import Measurement, RangeFrame
from estimators.models.range import horizontal_range, reduce_height


class Ekf(LidarOdometry):
    """LiDAR odometry held in place by tightly coupled UWB ranges.

    Every range corrects the state on its own, through the lever arm and after height reduction, when it
    passes the NIS gate. The state is that of `LidarOdometry`.

    Source: chen2019 Eq. (5)-(20); the paper's state and Jacobians are lost, those here are ours and
    are tested against finite differences.
    """

    class Config(LidarOdometry.Config):
        """Settings of `ekf`."""

        range_sigma: float = Field(0.10, gt=0, le=10, description="standard deviation of a range [m]")
        range_gate: float = Field(
            0.997, gt=0.5, lt=1, description="share of good ranges that pass the NIS gate"
        )
        suspect_for: float = Field(
            0.5,
            ge=0,
            le=60,
            description="after a range that failed the gate, its anchor is not believed for so long [s]: "
            "what blocks a range does not go away at once",
        )

    def __init__(self, config: Config, setup: Setup) -> None:
        super().__init__(config, setup)
        self._range_sigma = config.range_sigma
        self._range_gate = float(chi2.ppf(config.range_gate, 1))
        self._suspect_ns = round(config.suspect_for * 1e9)

    def reset(self) -> None:
        """Stand at the start again and trust every anchor."""
        super().reset()
        self._gated_ns: dict[int, int] = {}

    def update(self, measurement: Measurement) -> Report:
        """Predict to the measurement's time and take it; only ranges and increments are used."""
        if not isinstance(measurement, RangeFrame):
            return super().update(measurement)
        if self._is_late(measurement.stamp_ns):
            return Report((Verdict.LATE,) * len(measurement.ranges))
        self._predict_to(measurement.stamp_ns)
        return self._update_ranges(measurement)

    def _update_ranges(self, frame: RangeFrame) -> Report:
        count = len(frame.ranges)
        verdicts = [Verdict.ACCEPTED] * count
        residuals, nis = np.full(count, np.nan), np.full(count, np.nan)
        lever_arm = self._setup.tag_in_body
        for i in range(count):
            anchor_id = int(frame.anchor_ids[i])
            anchor = self._setup.anchors.get(anchor_id)
            if anchor is None:
                verdicts[i] = Verdict.UNKNOWN_ANCHOR
                continue
            reduced = reduce_height(float(frame.ranges[i]), self._range_sigma, self._setup.height_to(anchor))
            if reduced is None:
                verdicts[i] = Verdict.IMPOSSIBLE
                continue
            measured, sigma = reduced
            predicted, by_pose = horizontal_range(self._filter.x[POSE], anchor, lever_arm)
            H = np.zeros((1, 9))
            H[0, POSE] = by_pose
            variance = float((H @ self._filter.P @ H.T).item()) + sigma**2
            residuals[i] = measured - predicted
            nis[i] = residuals[i] ** 2 / variance
            if nis[i] > self._range_gate:
                verdicts[i] = Verdict.GATED
                self._gated_ns[anchor_id] = frame.stamp_ns
                continue
            gated_ns = self._gated_ns.get(anchor_id)
            if gated_ns is not None and frame.stamp_ns - gated_ns < self._suspect_ns:
                verdicts[i] = Verdict.SUSPECT
                continue
            self._correct(np.array([measured]), H, np.array([predicted]), np.array([[sigma**2]]))
        return Report(tuple(verdicts), residuals, nis)
