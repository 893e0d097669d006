"""What ties a tracked pose to the map, taken in stamp order: UWB ranges and known landmarks."""

from abc import abstractmethod

from estimators.base import Report, Setup, Verdict
from estimators.landmark_gate import LandmarkGate
from estimators.lidar.keyframes import KeyframeTracker
from estimators.messages import LandmarkFrame, Measurement, PoseIncrement, RangeFrame, Scan
from estimators.range_gate import RangeGate

_TAKES: frozenset[type[Measurement]] = frozenset({RangeFrame, LandmarkFrame, PoseIncrement, Scan})


class FixTaker(KeyframeTracker):
    """Follows increments and takes ranges and landmarks; how they correct the pose is the subclass's."""

    class Config(LandmarkGate.Config, RangeGate.Config, KeyframeTracker.Config):
        """Settings of every filter on ranges and increments."""

    def __init__(self, config: Config, setup: Setup) -> None:
        self._gate = RangeGate(config, setup)
        self._landmark_gate = LandmarkGate(config, setup)
        super().__init__(config, setup)

    @property
    def takes(self) -> frozenset[type[Measurement]]:
        """Scans are among them, for what they show of obstacles."""
        return _TAKES

    def update(self, measurement: Measurement) -> Report:
        """Predict to the measurement's time and take it; scans only show what blocks ranges."""
        if isinstance(measurement, RangeFrame | LandmarkFrame):
            if self._is_late(measurement.stamp_ns):
                count = len(measurement.ranges) if isinstance(measurement, RangeFrame) else 1
                return Report((Verdict.LATE,) * count)
            self._predict_to(measurement.stamp_ns)
            if isinstance(measurement, RangeFrame):
                return self._update_ranges(measurement)
            return Report((self._update_landmarks(measurement),))
        report = super().update(measurement)
        self._gate.see(measurement, self.pose_at)
        return report

    def _doubt(self, stamp_ns: int) -> float:
        return self._gate.doubt(stamp_ns)

    @abstractmethod
    def _update_ranges(self, frame: RangeFrame) -> Report:
        """Judge the ranges of this instant, and take those that are believed."""

    @abstractmethod
    def _update_landmarks(self, frame: LandmarkFrame) -> Verdict:
        """Judge the landmarks of this instant, and take those that are believed."""
