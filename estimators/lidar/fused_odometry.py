"""One chain of increments from scans and from an odometry that is not ours.

What an estimator gets of the odometry from outside it gets once. A scan's increment has none of it: the
matcher takes out again what it expected. Where a scan is the next keyframe, the odometry from keyframe to
keyframe is put on top, as a second measurement of the same motion; so a direction that no wall holds is held
by it. Where scans fail, the odometry alone goes on, step by step, and the next scan founds a keyframe.
"""

from dataclasses import replace

import numpy as np

from estimators.geometry import wrap_angle
from estimators.lidar.scan_matching import ScanMatcher
from estimators.messages import FloatArray, Measurement, PoseIncrement, Scan
from estimators.models.motion import chained

SILENT_NS = 500_000_000
"""Scans are waited for at least so long; else as long as two of them take."""


class FusedOdometry:
    """A scan matcher and an odometry from outside.

    Args:
        matcher: of the scans; gets everything, the odometry, too.
    """

    def __init__(self, matcher: ScanMatcher) -> None:
        self.matcher = matcher
        self._reference_ns: int | None = None
        self._since: tuple[FloatArray, FloatArray] | None = None
        self._since_ns = 0
        self._scan_ns: int | None = None
        self._period_ns = 0

    def update(self, measurement: Measurement) -> PoseIncrement | None:
        """Take a measurement; gives the increment from the newest reference to it, if it gives one."""
        if isinstance(measurement, PoseIncrement):
            self.matcher.update(measurement)
            return self._bridge(measurement.stamp_ns) if self._scans_fail(measurement.stamp_ns) else None
        matched = self.matcher.update(measurement)
        if not isinstance(measurement, Scan) or matched is None:
            return None
        if self._scan_ns is not None:
            self._period_ns = matched.stamp_ns - self._scan_ns
        self._scan_ns = matched.stamp_ns
        if matched.from_stamp_ns == matched.stamp_ns:
            return self._bridge(matched.stamp_ns)
        self._follow(matched.stamp_ns)
        if not matched.is_keyframe:
            return matched
        known, stamp_ns = self._since, matched.stamp_ns
        self._refer_to(stamp_ns)
        return matched if known is None else _both(matched, *known)

    def _scans_fail(self, now_ns: int) -> bool:
        return self._scan_ns is None or now_ns - self._scan_ns > max(SILENT_NS, 2 * self._period_ns)

    def _bridge(self, stamp_ns: int) -> PoseIncrement:
        """Increment by the odometry alone, or a new beginning where it does not reach back."""
        if self._scan_ns is not None and self._scan_ns != stamp_ns:
            self.matcher.forget()
        self._follow(stamp_ns)
        reference_ns, known = self._reference_ns, self._since
        self._refer_to(stamp_ns)
        if reference_ns is None or reference_ns == stamp_ns or known is None:
            return PoseIncrement(stamp_ns, stamp_ns, np.zeros(3), np.zeros((3, 3)), is_keyframe=True)
        return PoseIncrement(reference_ns, stamp_ns, *known, is_keyframe=True)

    def _refer_to(self, stamp_ns: int) -> None:
        self._reference_ns = self._since_ns = stamp_ns
        self._since = np.zeros(3), np.zeros((3, 3))

    def _follow(self, stamp_ns: int) -> None:
        """Chain the odometry on from the reference, piece by piece: it is not kept for ever."""
        piece = self.matcher.odometry.motion(self._since_ns, stamp_ns)
        if self._since is not None:
            self._since = None if piece is None else chained(*self._since, *piece)
        self._since_ns = stamp_ns


def _both(matched: PoseIncrement, known: FloatArray, known_cov: FloatArray) -> PoseIncrement:
    """Two independent measurements of a motion as one."""
    difference = known - matched.increment
    difference[2] = wrap_angle(difference[2])
    gain = np.linalg.solve(matched.cov + known_cov, matched.cov).T
    cov = matched.cov - gain @ matched.cov
    increment = matched.increment + gain @ difference
    increment[2] = wrap_angle(increment[2])
    return replace(matched, increment=increment, cov=0.5 * (cov + cov.T))
