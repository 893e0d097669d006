"""Where a LiDAR saw something and where it saw through: log-odds of square cells in the map frame."""

from math import log
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from estimators.messages import FloatArray

BLOCK = 64
"""The grid grows by this many cells at a time."""
MAX_SIDE = 4096
"""A scan that would need more cells along a side is left out: only a lost robot takes such a scan."""
LIMIT = log(0.97 / 0.03)
"""No cell is surer than this, so that what moves away is forgotten."""

Point: TypeAlias = tuple[float, float] | FloatArray


class OccupancyGrid:
    """A grid that grows with what is seen; a cell that was never seen has log-odds 0.

    Source: Elfes, Using occupancy grids for mobile robot perception and navigation, Computer 22(6), 1989;
    log-odds form: Thrun, Burgard and Fox, Probabilistic Robotics, Table 9.1; limits: Hornung et al., OctoMap,
    Autonomous Robots 34, 2013, Eq. (4).
    """

    class Config(BaseModel):
        """Settings of an occupancy grid."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        cell: float = Field(0.05, ge=0.01, le=1, description="side of a cell [m]")
        hit: float = Field(
            0.7, gt=0.5, lt=1, description="probability that a cell is occupied in which a beam ended"
        )
        miss: float = Field(0.4, gt=0, lt=0.5, description="the same for a cell that a beam passed")
        occupied: float = Field(
            0.8, gt=0.5, lt=0.97, description="above this probability a cell counts as an obstacle"
        )

    def __init__(self, config: Config) -> None:
        # Numba loads slowly: only who makes a grid waits for it.
        from estimators.kernels import ray_casting

        self._kernels = ray_casting
        self._cell = config.cell
        self._hit, self._miss = log(config.hit / (1.0 - config.hit)), log((1.0 - config.miss) / config.miss)
        self._threshold = log(config.occupied / (1.0 - config.occupied))
        self._corner = np.zeros(2, dtype=np.int64)
        self._log_odds = np.zeros((0, 0), dtype=np.float32)
        self._seen = np.zeros((0, 0), dtype=np.int32)
        self._scans = 0

    @property
    def cell(self) -> float:
        """Side of a cell [m]."""
        return self._cell

    @property
    def origin(self) -> FloatArray:
        """Corner (2,) [m] of cell ``[0, 0]`` with the least x and y, map frame."""
        return self._corner.astype(np.float64) * self._cell

    @property
    def log_odds(self) -> NDArray[np.float32]:
        """Log-odds (rows, columns) of the cells being occupied; rows along y, columns along x. Not a copy."""
        return self._log_odds

    @property
    def obstacles(self) -> NDArray[np.bool_]:
        """Cells (rows, columns) that count as obstacles."""
        return self._log_odds > self._threshold

    def insert(self, T_map_lidar: FloatArray, points: FloatArray) -> bool:
        """Add what one scan saw.

        Args:
            T_map_lidar: (3,) x [m], y [m], yaw [rad] of the LiDAR in the map.
            points: (N, 2) ends of beams that something stopped [m], lidar frame.

        Returns:
            False when the scan was left out: a number that is not finite, or cells too far away.
        """
        ends, least, greatest = self._kernels.in_cells(T_map_lidar, np.ascontiguousarray(points), self._cell)
        if not (np.isfinite(least).all() and np.isfinite(T_map_lidar).all()):
            return False
        # One cell more all round: counted from the corner, a point on a border may round into the next cell.
        if not self._grow(np.floor(least) - 1.0, np.floor(greatest) + 1.0):
            return False
        self._scans += 1
        ends -= self._corner
        x, y = T_map_lidar[:2] / self._cell - self._corner
        self._kernels.trace_scan(
            self._log_odds,
            self._seen,
            self._scans,
            x,
            y,
            ends,
            self._hit,
            self._miss,
            LIMIT,
        )
        return True

    def occupy(self, points: FloatArray) -> bool:
        """Take the cells of points (N, 2) [m], map frame, for obstacles that were seen often.

        Returns:
            False when they were left out: none, or too far apart.
        """
        cells = np.floor(points / self._cell)
        if not len(cells) or not self._grow(cells.min(axis=0), cells.max(axis=0)):
            return False
        columns, rows = (cells.astype(np.int64) - self._corner).T
        self._log_odds[rows, columns] = LIMIT
        return True

    def blocked(self, start: Point, end: Point) -> bool:
        """Whether an obstacle lies on the straight line between two points (x, y) [m], map frame."""
        cell, (column, row) = self._cell, self._corner.tolist()
        blocked: bool = self._kernels.is_blocked(
            self._log_odds,
            start[0] / cell - column,
            start[1] / cell - row,
            end[0] / cell - column,
            end[1] / cell - row,
            self._threshold,
        )
        return blocked

    def _grow(self, least: FloatArray, greatest: FloatArray) -> bool:
        """Make room for cells from `least` to `greatest`, (2,) column and row from the map's origin."""
        if self._log_odds.size:
            far_corner = self._corner + np.array(self._log_odds.shape[::-1])
            least, greatest = np.minimum(least, self._corner), np.maximum(greatest, far_corner - 1)
        if (np.maximum(np.abs(least), np.abs(greatest)) > 2.0**40).any():
            return False
        corner = (least // BLOCK).astype(np.int64) * BLOCK
        columns, rows = (greatest // BLOCK).astype(np.int64) * BLOCK + BLOCK - corner
        if max(columns, rows) > MAX_SIDE:
            return False
        if (rows, columns) != self._log_odds.shape:
            dx, dy = self._corner - corner
            inside = np.s_[dy : dy + self._log_odds.shape[0], dx : dx + self._log_odds.shape[1]]
            log_odds, seen = np.zeros((rows, columns), np.float32), np.zeros((rows, columns), np.int32)
            if self._log_odds.size:
                log_odds[inside], seen[inside] = self._log_odds, self._seen
            self._log_odds, self._seen, self._corner = log_odds, seen, corner
        return True
