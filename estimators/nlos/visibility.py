"""What the LiDAR sees between tag and anchor."""

from collections.abc import Callable
from math import cos, hypot, log, sin, sqrt

import numpy as np

from estimators.base import Setup
from estimators.geometry import between, compose
from estimators.lidar.occupancy_grid import OccupancyGrid
from estimators.messages import FloatArray, Measurement, PoseEstimate, PoseIncrement, Scan

OBSTRUCTED = log(20.0)
"""How much an obstacle on the line says. An empty line says nothing: much is not seen by a planar LiDAR."""
PERIOD_NS = 250_000_000
"""A scan is added at most this often."""
MARGIN = 0.3
"""The robot itself and the wall at which an anchor hangs are within this distance of the line's ends [m]."""
MAX_SIGMA_XY, MAX_SIGMA_YAW = 0.2, 0.05
"""No scan is added from a pose that is less certain [m, rad]: it would blur the grid."""


class Visibility:
    """An occupancy grid of the LiDAR's scans, and rays through it.

    It begins with the obstacles of the site's map, if there is one; scans change them as they do any other.

    A planar LiDAR does not see how high an obstacle is. All are taken for equally high; only the part of the
    line below that height can be blocked.

    Args:
        obstacle_height: of everything that the LiDAR sees [m] above the map's floor.
        setup: geometry.

    Source: huang2024 has no such test; the project's own.
    """

    def __init__(self, obstacle_height: float, setup: Setup) -> None:
        # Numba loads slowly: only who looks waits for it.
        from estimators.kernels.scan_points import ends_of_beams

        self._ends_of_beams = ends_of_beams
        self._obstacle_height = obstacle_height
        self._arm = setup.tag_in_body.tolist()
        self._setup = setup
        self.reset()

    def reset(self) -> None:
        """Forget all scans."""
        self.grid = OccupancyGrid(OccupancyGrid.Config())
        if self._setup.floor_map is not None:
            # So near that no cell of the grid is missed, however the map's cells are turned.
            self.grid.occupy(self._setup.floor_map.obstacle_points(self.grid.cell / sqrt(2.0)))
        self._scan: Scan | None = None
        self._due_ns: int | None = None

    def see(self, measurement: Measurement, pose_at: Callable[[int], PoseEstimate | None]) -> None:
        """Take a scan, and add it to the grid once its increment has told where it was made.

        Args:
            measurement: any; scans and increments are used.
            pose_at: of the estimator, which has taken the measurement.
        """
        if isinstance(measurement, Scan):
            self._scan = measurement
        elif isinstance(measurement, PoseIncrement) and self._scan is not None:
            stamp_ns = measurement.stamp_ns
            is_due = self._due_ns is None or stamp_ns >= self._due_ns
            if is_due and stamp_ns == self._scan.end_stamp_ns:
                self._due_ns = stamp_ns + PERIOD_NS
                self._add(self._scan, pose_at(self._scan.stamp_ns), pose_at(stamp_ns))

    def log_ratio(self, pose: FloatArray, anchor: FloatArray) -> float:
        """How much the grid speaks for a blocked range.

        Args:
            pose: (3,) x [m], y [m], yaw [rad] of the body in the map.
            anchor: (3,) [m], map frame.
        """
        if not self.grid.log_odds.size:
            return 0.0
        # In plain floats: arrays of two numbers take longer than all of the arithmetic.
        (x, y, yaw), (to_x, to_y, height), (arm_x, arm_y, _) = pose.tolist(), anchor.tolist(), self._arm
        c, s = cos(yaw), sin(yaw)
        tag_x, tag_y = x + c * arm_x - s * arm_y, y + s * arm_x + c * arm_y
        length = hypot(to_x - tag_x, to_y - tag_y)
        begin, end = MARGIN, length - MARGIN
        climb = self._setup.height_to(anchor)
        room = self._obstacle_height - height + climb  # from the tag up to the obstacles' height
        if climb > 0.0:
            end = min(end, room / climb * length)
        elif room <= 0.0:
            begin = max(begin, room / climb * length if climb < 0.0 else length)
        if not begin < end:
            return 0.0
        along_x, along_y = (to_x - tag_x) / length, (to_y - tag_y) / length
        blocked = self.grid.blocked(
            (tag_x + begin * along_x, tag_y + begin * along_y), (tag_x + end * along_x, tag_y + end * along_y)
        )
        return OBSTRUCTED if blocked else 0.0

    def _add(self, scan: Scan, begin: PoseEstimate | None, end: PoseEstimate | None) -> None:
        if begin is None or end is None or scan.stamp_ns == scan.end_stamp_ns:
            return
        variances = np.diag(end.planar_cov)
        # Written so that a NaN is refused, too.
        if not (variances[:2].sum() < MAX_SIGMA_XY**2 and variances[2] < MAX_SIGMA_YAW**2):
            return
        mounting = self._setup.lidar_in_body
        T_map_first, T_map_last = (compose(np.array([*p.xy, p.yaw]), mounting) for p in (begin, end))
        ends = self._ends_of_beams(
            np.ascontiguousarray(scan.angles),
            np.ascontiguousarray(scan.ranges),
            np.ascontiguousarray(scan.beam_times),
            between(T_map_last, T_map_first),
        )
        self.grid.insert(T_map_last, ends)
