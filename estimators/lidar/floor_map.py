"""A floor plan as cells, as it is saved and loaded; what to find oneself in."""

from math import log

import numpy as np
from numpy.typing import NDArray

from estimators.geometry import transform
from estimators.immutable import immutable
from estimators.lidar.occupancy_grid import OccupancyGrid
from estimators.messages import FloatArray

FREE = log(0.25 / 0.75)
"""A cell with smaller log-odds was seen through often enough to be free."""


@immutable
class FloorMap:
    """Cells that are obstacles, free, or neither: never seen.

    Attributes:
        occupied: (rows, columns) True where there is an obstacle; rows along y, columns along x.
        free: likewise, True where there is none.
        cell: side of a cell [m].
        T_map_grid: (3,) x [m], y [m], yaw [rad] of the outer corner of cell ``[0, 0]`` in the map.
    """

    occupied: NDArray[np.bool_]
    free: NDArray[np.bool_]
    cell: float
    T_map_grid: FloatArray

    def likelihood(self, sigma: float) -> NDArray[np.float32]:
        """How likely a beam ends in a cell, 1 at an obstacle, falling off as a Gaussian, (rows, columns).

        Args:
            sigma: standard deviation of the distance between beam's end and obstacle [m].

        Source: Thrun, Burgard and Fox, Probabilistic Robotics, Table 6.3.
        """
        if not self.occupied.any():
            return np.zeros(self.occupied.shape, dtype=np.float32)
        # SciPy's images load slowly: only who has a map waits for them.
        from scipy.ndimage import distance_transform_edt

        distance = distance_transform_edt(~self.occupied) * self.cell
        return np.exp(-0.5 * (distance / sigma) ** 2).astype(np.float32)

    def obstacle_points(self, spacing: float) -> FloatArray:
        """Points (N, 2) [m], map frame, spread evenly in every obstacle's cell.

        Args:
            spacing: of neighbouring points at most [m]; a cell's side or more: the centres alone.
        """
        count = max(1, int(np.ceil(self.cell / spacing)))
        offsets = (np.arange(count) + 0.5) / count
        within = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
        rows, columns = np.nonzero(self.occupied)
        corners = np.column_stack([columns, rows])
        return transform(self.T_map_grid, self.cell * (corners[:, None] + within).reshape(-1, 2))


def floor_map_of(grid: OccupancyGrid) -> FloorMap:
    """The part of an occupancy grid that was seen."""
    seen = grid.log_odds != 0.0
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    if not len(rows):
        return FloorMap(np.zeros((1, 1), bool), np.zeros((1, 1), bool), grid.cell, np.zeros(3))
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    corner = grid.origin + grid.cell * np.array([columns[0], rows[0]])
    return FloorMap(
        grid.obstacles[window].copy(), grid.log_odds[window] < FREE, grid.cell, np.array([*corner, 0.0])
    )
