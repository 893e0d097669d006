"""A map of the room from a log: every scan where the estimator says the robot was."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from companion.config import Config
from companion.errors import UserError
from companion.log import Log, RawChunk
from companion.pipeline import Chain, Pipeline, make_scan_odometry
from estimators import make_estimator
from estimators.base import Estimator, Report, Verdict
from estimators.geometry import compose, inverse, transform
from estimators.lidar.floor_map import FloorMap, floor_map_of
from estimators.lidar.front_ends import ScanFrontEnd
from estimators.lidar.occupancy_grid import OccupancyGrid
from estimators.messages import FloatArray, Measurement, PoseEstimate, PoseIncrement

MOST_SIGMA = 0.1
"""A scan whose position is less certain [m] would blur the map."""


@dataclass(slots=True)
class Survey:
    """A map, and from how many scans of how many it was made."""

    floor: FloorMap
    inserted: int
    scans: int


class _Surveyor:
    """An estimator that draws every matched scan into a grid."""

    def __init__(self, estimator: Estimator, front_end: ScanFrontEnd, T_body_lidar: FloatArray) -> None:
        self._estimator = estimator
        self._front_end = front_end
        self._T_body_lidar = T_body_lidar
        self.grid = OccupancyGrid(OccupancyGrid.Config())
        self.inserted = self.scans = 0

    def reset(self) -> None:
        self._estimator.reset()

    def update(self, measurement: Measurement) -> Report:
        report = self._estimator.update(measurement)
        if isinstance(measurement, PoseIncrement):
            self.scans += 1
            pose = self._estimator.pose_at(measurement.stamp_ns)
            if report.verdicts == (Verdict.ACCEPTED,) and pose is not None:
                self._draw(pose)
        return report

    def pose_at(self, stamp_ns: int) -> PoseEstimate | None:
        return self._estimator.pose_at(stamp_ns)

    def _draw(self, pose: PoseEstimate) -> None:
        if max(pose.planar_cov[0, 0], pose.planar_cov[1, 1]) > MOST_SIGMA**2:
            return
        T_map_lidar = compose(np.array([*pose.xy, pose.yaw]), self._T_body_lidar)
        in_lidar = transform(inverse(self._T_body_lidar), self._front_end.points)
        self.inserted += self.grid.insert(T_map_lidar, in_lidar)


def survey(log: Log, config: Config, estimator: str, on_progress: Callable[[float], None]) -> Survey:
    """Make a map of what the LiDAR saw in a log.

    Args:
        log: to read.
        config: usually the log's own.
        estimator: whose poses say where scans were taken.
        on_progress: called now and then with the share of the log that is done.

    Raises:
        UserError: no scan could be placed.
    """
    mounting = config.lidar_mounting()
    front_end = make_scan_odometry(config)
    inner = make_estimator(estimator, config.estimator_config(estimator), config.setup())
    surveyor = _Surveyor(inner, front_end, mounting)
    chain = Chain(config, log.start_ns, Pipeline(front_end, {estimator: surveyor}), estimator)
    for record in log:
        if isinstance(record, RawChunk):
            for _ in chain.feed(record):
                on_progress(log.share_read)
    if not surveyor.inserted:
        raise UserError(
            f"{log.path}: none of {surveyor.scans} matched scans had a position certain to {MOST_SIGMA} m, "
            "there is no map to write"
        )
    return Survey(floor_map_of(surveyor.grid), surveyor.inserted, surveyor.scans)
