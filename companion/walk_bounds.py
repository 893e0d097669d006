"""The least position error that a scenario's walk allows any estimator."""

from collections.abc import Sequence

import numpy as np

from companion.sim.measurements import MeasuredWalk
from companion.sim.scenario import Scenario
from companion.sim.simulate import START_NS
from estimators.base import Setup
from estimators.bounds import (
    landmark_information,
    position_information,
    posterior_bound,
    range_information,
    seen_from,
)
from estimators.geometry import transform_each
from estimators.messages import FloatArray, LandmarkFrame, RangeFrame

_EPOCHS = 300
"""The bound of single frames is taken at about so many poses of the walk."""
_WORST_CONDITION = 1e4
"""Of information that still tells a position."""


def walk_bound(scenario: Scenario, setup: Setup, walk: MeasuredWalk) -> float | None:
    """Root mean square over the walk of the least position error [m]; blocked ranges do not count.

    What is measured between two steps counts at the later one, as if the motion in between were known: that
    can only lower the bound. None where no increment tells the motion, without noise, and where the start is
    unknown or the robot is carried off.
    """
    sigma = scenario.file.uwb.sigma
    if scenario.file.kidnap or not setup.start.known or sigma == 0.0:
        return None
    information = np.zeros((len(walk.poses), 3, 3))

    def count(stamp_ns: int, pose: FloatArray, seen: FloatArray) -> None:
        k = int(np.searchsorted(walk.stamps_ns, stamp_ns))
        if k < len(walk.poses):
            information[k] += seen_from(walk.poses[k], pose, seen)

    at_frames = _true_poses(scenario, walk.range_frames)
    for frame, unblocked, pose in zip(walk.range_frames, walk.unblocked, at_frames, strict=True):
        count(frame.stamp_ns, pose, range_information(pose, setup, unblocked, sigma))
    for look, pose in zip(walk.landmark_frames, _true_poses(scenario, walk.landmark_frames), strict=True):
        ids = look.landmark_ids.tolist()
        seen = landmark_information(pose, setup, ids, look.range_sigma, look.bearing_sigma)
        count(look.stamp_ns, pose, seen)
    increment_covs = [increment.cov for increment in walk.increments[1:]]
    bounds = posterior_bound(np.diag(setup.start.sigma**2), walk.poses, increment_covs, information)
    return float(np.sqrt((bounds[:, 0, 0] + bounds[:, 1, 1]).mean()))


def _true_poses(scenario: Scenario, frames: Sequence[RangeFrame | LandmarkFrame]) -> FloatArray:
    """Poses (N, 3) at which something was measured."""
    times = np.array([(frame.stamp_ns - START_NS) * 1e-9 for frame in frames], dtype=np.float64)
    return scenario.trajectory.at(times).pose


def epoch_bound(scenario: Scenario, setup: Setup, poses: FloatArray) -> float | None:
    """Root mean square over the walk of the least error of one frame of ranges [m].

    Blocked ranges do not count. Poses from which ranges give no position are left out; None when there is
    no other, or without noise.
    """
    sigma = scenario.file.uwb.sigma
    if sigma == 0.0:
        return None
    some = poses[:: max(1, len(poses) // _EPOCHS)]
    horizontal = transform_each(some, setup.tag_in_body[None, :2])
    tags = np.column_stack([horizontal, np.full(len(some), setup.height + setup.tag_in_body[2])])
    anchors = np.array(list(setup.anchors.values()))
    clear = np.array([scenario.world.line_of_sight(tag, anchors) for tag in tags])
    information = position_information(tags, anchors, clear, sigma)
    told = np.linalg.cond(information) < _WORST_CONDITION
    if not told.any():
        return None
    return float(np.sqrt(np.linalg.inv(information[told]).trace(axis1=1, axis2=2).mean()))
