"""Rays through a grid of square cells, see `estimators.lidar.occupancy_grid`.

Coordinates are those of the grid: in units of cells from its corner, x along the columns and y along the
rows, so that cell ``[row, column]`` covers x from `column` to `column + 1` and y from `row` to `row + 1`.
"""

from math import cos, floor, inf, sin
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from estimators.kernels.compilation import MATRIX, VECTOR, compiled, inlined
from estimators.messages import FloatArray

CellArray: TypeAlias = NDArray[np.float32]
CountArray: TypeAlias = NDArray[np.int32]

CELLS = "float32[:, ::1]"


@inlined
def crossing(position: float, direction: float) -> tuple[int, float, float]:
    """Along one axis: the step to the next cell, ray length to its border, ray length between borders."""
    if direction > 0.0:
        return 1, (floor(position) + 1.0 - position) / direction, 1.0 / direction
    if direction < 0.0:
        return -1, (floor(position) - position) / direction, -1.0 / direction
    return 0, inf, inf


@inlined
def within(position: float, direction: float, cells: int) -> tuple[float, float]:
    """Shares of a line's length between which it is inside the grid, along one axis."""
    if direction == 0.0:
        return (0.0, 1.0) if 0.0 <= position < cells else (1.0, 0.0)
    low, high = -position / direction, (cells - position) / direction
    return max(min(low, high), 0.0), min(max(low, high), 1.0)


@compiled(f"Tuple(({MATRIX}, {VECTOR}, {VECTOR}))({VECTOR}, {MATRIX}, float64)")
def in_cells(
    T_map_lidar: FloatArray, points: FloatArray, cell: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Ends of beams in units of cells from the map's origin.

    Args:
        T_map_lidar: (3,) x [m], y [m], yaw [rad] of the LiDAR in the map.
        points: (N, 2) [m], lidar frame.
        cell: side of a cell [m].

    Returns:
        (N, 2); the least and the greatest (2,) of them and the LiDAR's own, NaN when any is not finite.
    """
    ends, least, greatest = np.empty_like(points), T_map_lidar[:2] / cell, T_map_lidar[:2] / cell
    c, s = cos(T_map_lidar[2]), sin(T_map_lidar[2])
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        ends[i, 0] = (c * x - s * y + T_map_lidar[0]) / cell
        ends[i, 1] = (s * x + c * y + T_map_lidar[1]) / cell
        for k in range(2):
            least[k], greatest[k] = min(least[k], ends[i, k]), max(greatest[k], ends[i, k])
            if not np.isfinite(ends[i, k]):
                return ends, np.full(2, np.nan), greatest
    return ends, least, greatest


@compiled(f"void({CELLS}, int32[:, ::1], int32, float64, float64, {MATRIX}, float32, float32, float32)")
def trace_scan(
    log_odds: CellArray,
    seen: CountArray,
    scan: int,
    x: float,
    y: float,
    ends: FloatArray,
    hit: float,
    miss: float,
    limit: float,
) -> None:
    """Add one scan to a grid, in place: every cell changes once at most, and what was hit is not passed.

    Args:
        log_odds: (rows, columns) float32, of the cells being occupied.
        seen: (rows, columns) int32, number of the newest scan that changed each cell.
        scan: number of this scan, greater than any before.
        x: where the rays begin; inside the grid, as all ends are.
        y: likewise.
        ends: (N, 2) where the rays were stopped.
        hit: is added to a cell with an end in it.
        miss: is subtracted from a cell that a ray passes.
        limit: greatest absolute value of a cell.

    Source: Amanatides and Woo, A fast voxel traversal algorithm for ray tracing, Eurographics 1987; hits
    before misses: Hornung et al., OctoMap, Autonomous Robots 34, 2013, 5.1.
    """
    for i in range(len(ends)):
        column, row = floor(ends[i, 0]), floor(ends[i, 1])
        if seen[row, column] != scan:
            seen[row, column] = scan
            log_odds[row, column] = min(log_odds[row, column] + hit, limit)
    flat_odds, flat_seen, columns = log_odds.ravel(), seen.ravel(), seen.shape[1]
    for i in range(len(ends)):
        step_x, next_x, gap_x = crossing(x, ends[i, 0] - x)
        step_y, next_y, gap_y = crossing(y, ends[i, 1] - y)
        # The number of steps is known: rounding of the lengths cannot lead past the end, out of the grid.
        left_x, left_y = abs(floor(ends[i, 0]) - floor(x)), abs(floor(ends[i, 1]) - floor(y))
        at, step_y = floor(y) * columns + floor(x), step_y * columns
        for _ in range(left_x + left_y):
            if flat_seen[at] != scan:
                flat_seen[at] = scan
                flat_odds[at] = max(flat_odds[at] - miss, -limit)
            if left_x > 0 and (next_x < next_y or left_y == 0):
                left_x -= 1
                at += step_x
                next_x += gap_x
            else:
                left_y -= 1
                at += step_y
                next_y += gap_y


@compiled(f"boolean({CELLS}, float64, float64, float64, float64, float32)")
def is_blocked(log_odds: CellArray, x: float, y: float, end_x: float, end_y: float, threshold: float) -> bool:
    """Whether a straight line passes a cell whose log-odds are above a threshold; outside there are none.

    Args:
        log_odds: (rows, columns) float32.
        x: where the line begins.
        y: likewise.
        end_x: where it ends.
        end_y: likewise.
        threshold: see above.

    Source: Amanatides and Woo, A fast voxel traversal algorithm for ray tracing, Eurographics 1987.
    """
    rows, columns = log_odds.shape
    first_x, last_x = within(x, end_x - x, columns)
    first_y, last_y = within(y, end_y - y, rows)
    first, last = max(first_x, first_y), min(last_x, last_y)
    if not first <= last:
        return False
    dx, dy = end_x - x, end_y - y
    end_x, end_y = x + last * dx, y + last * dy
    x, y = x + first * dx, y + first * dy
    column, row = floor(x), floor(y)
    end_column, end_row = floor(end_x), floor(end_y)
    step_x, next_x, gap_x = crossing(x, end_x - x)
    step_y, next_y, gap_y = crossing(y, end_y - y)
    for _ in range(abs(end_column - column) + abs(end_row - row) + 1):
        if 0 <= row < rows and 0 <= column < columns and log_odds[row, column] > threshold:
            return True
        if column != end_column and (next_x < next_y or row == end_row):
            column += step_x
            next_x += gap_x
        else:
            row += step_y
            next_y += gap_y
    return False
