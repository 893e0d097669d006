"""An estimator under evaluation: how long it takes, what its innovations say, when its pose would be sent."""

import time
from math import isfinite

from companion.health import HealthMonitor
from estimators.base import Estimator, Report, Verdict
from estimators.messages import Measurement, PoseEstimate, RangeFrame


class WatchedEstimator:
    """An estimator that is judged as the primary of a live run would be, and whose updates are timed.

    Args:
        estimator: to watch.
        monitor: judges its poses; of its own.

    Attributes:
        seconds: time of each update that it had a use for.
        nis: NIS of every range that it accepted.
        iterations: steps of its solver for each frame, if it has one.
        healthy_ns: stamps of the poses that a live run would send.
    """

    def __init__(self, estimator: Estimator, monitor: HealthMonitor) -> None:
        self._estimator = estimator
        self._monitor = monitor
        self.seconds: list[float] = []
        self.nis: list[float] = []
        self.iterations: list[int] = []
        self.healthy_ns: list[int] = []

    def reset(self) -> None:
        """See `Estimator`; what was watched stays."""
        self._estimator.reset()

    def update(self, measurement: Measurement) -> Report:
        """See `Estimator`."""
        begin = time.perf_counter()
        report = self._estimator.update(measurement)
        took = time.perf_counter() - begin
        if Verdict.NOT_USED not in report.verdicts:
            self.seconds.append(took)
        if report.iterations is not None:
            self.iterations.append(report.iterations)
        self._monitor.observe(measurement, report)
        if isinstance(measurement, RangeFrame) and len(report.nis):
            judged = zip(report.verdicts, report.nis.tolist(), strict=True)
            self.nis += [nis for verdict, nis in judged if verdict is Verdict.ACCEPTED and isfinite(nis)]
        return report

    def pose_at(self, stamp_ns: int) -> PoseEstimate | None:
        """See `Estimator`."""
        pose = self._estimator.pose_at(stamp_ns)
        if self._monitor.judge(pose, stamp_ns).sends:
            self.healthy_ns.append(stamp_ns)
        return pose
