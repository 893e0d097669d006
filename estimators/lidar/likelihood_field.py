"""How near the end of a beam lies to an obstacle: the map that scans are weighed by."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from estimators.lidar.floor_map import FloorMap
from estimators.messages import FloatArray, Scan

_CELL = 0.03
"""Resolution of a grid made from walls [m]."""
_MARGIN = 1.0
"""How far a grid reaches beyond its obstacles [m]."""
_BEAMS = 60
"""A scan is weighed by this many of its beams, spread evenly."""


class LikelihoodField:
    """Distance to the nearest obstacle on a grid, wherever the grid comes from.

    Args:
        occupied: (rows, columns) bool, rows along y, columns along x; at least 2 of each.
        resolution: side of a cell [m].
        origin: (2,) centre of the cell [0, 0], map frame [m].

    Attributes:
        distances: (rows, columns) float64 [m], from the centre of each cell to that of the nearest occupied.
        resolution: as above.
        origin: as above.

    Raises:
        ValueError: no cell is occupied.

    Source: Thrun, Burgard and Fox, Probabilistic Robotics, 6.4.
    """

    def __init__(self, occupied: NDArray[np.bool_], resolution: float, origin: FloatArray) -> None:
        if not occupied.any():
            raise ValueError("a likelihood field needs an obstacle")
        self.distances: FloatArray = np.ascontiguousarray(
            resolution * distance_transform_edt(~occupied), dtype=np.float64
        )
        self.resolution = resolution
        self.origin = origin

    @classmethod
    def from_walls(cls, walls: Sequence[FloatArray]) -> "LikelihoodField":
        """Field of walls.

        Args:
            walls: polylines (N, 2) of at least two corners [m], map frame.
        """
        along = [
            np.linspace(begin, end, int(np.ceil(2.0 * np.linalg.norm(end - begin) / _CELL)) + 1)
            for wall in walls
            for begin, end in pairwise(wall)
        ]
        return cls._from_points(np.concatenate(along), _CELL)

    @classmethod
    def from_floor(cls, floor: FloorMap) -> "LikelihoodField":
        """Field of a map, with cells as large as the map's but along the axes of the map frame.

        Args:
            floor: with at least one obstacle.
        """
        return cls._from_points(floor.obstacle_points(floor.cell), floor.cell)

    @classmethod
    def _from_points(cls, points: FloatArray, resolution: float) -> "LikelihoodField":
        # Whole cells, so that points which lie on a grid of this resolution stay where they are.
        margin = resolution * np.ceil(_MARGIN / resolution)
        origin = points.min(axis=0) - margin
        columns, rows = np.ceil((points.max(axis=0) + margin - origin) / resolution).astype(int) + 1
        occupied = np.zeros((rows, columns), dtype=np.bool_)
        column, row = np.rint((points - origin) / resolution).astype(int).T
        occupied[row, column] = True
        return cls(occupied, resolution, origin)


def beams_of(scan: Scan) -> FloatArray:
    """Some beams of a scan that came back, as `estimators.kernels.scan` takes them.

    Returns:
        (B, 3) direction [rad], lidar frame; range [m]; time before the last beam [s]. None came back: B = 0.
    """
    came_back = np.isfinite(scan.ranges) & (scan.ranges > 0.0) & np.isfinite(scan.angles)
    some = np.flatnonzero(came_back)
    some = some[:: max(1, -(-len(some) // _BEAMS))]
    ages = (scan.beam_times[-1:] - scan.beam_times)[some]
    return np.column_stack([scan.angles[some], scan.ranges[some], ages])
