"""Loop closures of a run: keyframes of the scan matcher held against places that the robot passed before."""

from collections.abc import Iterable

import numpy as np

from companion.config import Config
from estimators import uses_closures
from estimators.lidar.loop_closure import LoopCloser
from estimators.lidar.scan_matching import ScanMatcher
from estimators.messages import LoopClosure, PoseEstimate, PoseIncrement


class LookBack:
    """Gives a closure, or founds a place, where an increment is a keyframe.

    Args:
        config: of the search.
        matcher: whose points are compared, just after it gave the increment.
    """

    def __init__(self, config: LoopCloser.Config, matcher: ScanMatcher) -> None:
        self._closer = LoopCloser(config)
        self._matcher = matcher

    def update(self, increment: PoseIncrement, pose: PoseEstimate | None) -> LoopClosure | None:
        """Look whether the robot is back at a place.

        Args:
            increment: the newest; a keyframe.
            pose: what an estimator, which has taken the increment, makes of its instant.
        """
        if pose is None or not np.isfinite(pose.planar_cov).all():
            return None
        matcher = self._matcher
        if matcher.keyframe_ns != increment.stamp_ns:
            return None
        at = np.array([*pose.xy, pose.yaw])
        return self._closer.add(increment.stamp_ns, at, matcher.points, matcher.points_cov)


def make_look_back(
    config: Config, matcher: ScanMatcher, names: Iterable[str], always: bool = False
) -> LookBack | None:
    """The search for loop closures, if one of the named estimators has a use for them, or always."""
    return LookBack(config.loop_closure, matcher) if always or any(map(uses_closures, names)) else None
