"""Inner loops of scan matching: local lines through a scan, and points held against them."""

from math import cos, floor, hypot, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from estimators.kernels.compilation import MATRIX, VECTOR, compiled
from estimators.messages import FloatArray

IntegerArray = NDArray[np.int64]
INTEGERS = "int64[::1]"

LEAST_NEIGHBOURS = 2
"""A line goes through at least so many beams to either side of its point."""
MOST_NEIGHBOURS = 20
"""... and at most through so many."""
LINE_FLATNESS = 0.25
"""A neighbourhood whose thickness exceeds this share of its length is a corner, not a line."""
GAP_RATIO = 4.0
"""Neighbours are of one surface when they lie no further apart than so many times the gap before."""


LEAST_COSINE = 0.8
"""Lines whose normals differ by more (37 deg) are of different surfaces."""


@compiled(f"Tuple(({MATRIX}, int64[:, ::1], {INTEGERS}))({MATRIX}, boolean[::1], float64, float64)")
def fit_lines(
    points: FloatArray, wanted: NDArray[np.bool_], reach: float, sigma: float
) -> tuple[FloatArray, IntegerArray, IntegerArray]:
    """Lines through the neighbourhoods of points that lie on a surface.

    Args:
        points: (N, 2) [m] in the order of the beams.
        wanted: (N,) whose lines are asked for; they go through all points.
        reach: half the length of a neighbourhood [m].
        sigma: standard deviation of a range [m].

    Returns:
        (M, 6): foot of the point on its line x, y [m], unit normal x, y, variance of the normal's direction
        [rad^2], widest gap between its points [m]; the first and last point of each line, (M, 2); and whose
        line it is, (M,).
    """
    count = len(points)
    gaps = np.full(count + 1, np.inf)
    for i in range(1, count):
        gaps[i] = hypot(points[i, 0] - points[i - 1, 0], points[i, 1] - points[i - 1, 1])
    lines, spans = np.empty((count, 6)), np.empty((count, 2), dtype=np.int64)
    own = np.empty(count, dtype=np.int64)
    found = 0
    for i in range(count):
        if not wanted[i]:
            continue
        x0, y0 = points[i, 0], points[i, 1]
        n, sx, sy, sxx, sxy, syy = 1, 0.0, 0.0, 0.0, 0.0, 0.0
        taken_least, gap_most = count, 0.0
        for side in (-1, 1):
            taken, last = 0, min(gaps[i], gaps[i + 1])
            j = i + side
            while 0 <= j < count and taken < MOST_NEIGHBOURS:
                x, y = points[j, 0], points[j, 1]
                gap = gaps[max(j, j - side)]
                x, y = x - x0, y - y0
                if taken >= LEAST_NEIGHBOURS and x * x + y * y > reach * reach:
                    break
                if gap > GAP_RATIO * max(last, sigma):
                    break
                sx, sy, n = sx + x, sy + y, n + 1
                sxx, sxy, syy = sxx + x * x, sxy + x * y, syy + y * y
                last = gap
                gap_most = max(gap_most, gap)
                taken += 1
                j += side
            spans[found, max(side, 0)] = i + side * taken
            taken_least = min(taken_least, taken)
        if taken_least < LEAST_NEIGHBOURS:
            continue
        mx, my = sx / n, sy / n
        xx, xy, yy = sxx / n - mx * mx, sxy / n - mx * my, syy / n - my * my
        half_trace, half_spread = 0.5 * (xx + yy), hypot(0.5 * (xx - yy), xy)
        length2, thickness2 = half_trace + half_spread, max(half_trace - half_spread, 0.0)
        if thickness2 > LINE_FLATNESS**2 * length2:
            continue
        # Direction of the larger eigenvector, from whichever of its two forms is not near zero.
        tx, ty = half_spread + 0.5 * (xx - yy), xy
        if xx < yy:
            tx, ty = xy, half_spread - 0.5 * (xx - yy)
        norm = hypot(tx, ty)
        if norm == 0.0:
            continue
        tx, ty = tx / norm, ty / norm
        along = -(mx * tx + my * ty)
        lines[found, 0] = x0 + mx + along * tx
        lines[found, 1] = y0 + my + along * ty
        lines[found, 2], lines[found, 3] = -ty, tx
        lines[found, 4] = max(sigma * sigma, thickness2) / (n * length2)
        lines[found, 5] = gap_most
        own[found] = i
        found += 1
    return lines[:found].copy(), spans[:found].copy(), own[:found].copy()


@compiled(f"Tuple(({MATRIX}, {INTEGERS}, {INTEGERS}))({MATRIX}, {VECTOR}, int64, int64)")
def sort_into_cells(
    lines: FloatArray, grid: FloatArray, columns: int, rows: int
) -> tuple[FloatArray, IntegerArray, IntegerArray]:
    """Lines ordered by the cell of a grid in which their foot lies.

    Args:
        lines: (M, 6).
        grid: least x, least y, side of a cell [m].
        columns: number of cells along x.
        rows: number of cells along y.

    Returns:
        The lines (M, 6) in new order, where they were before (M,), and where each cell begins
        (columns * rows + 1,).
    """
    per_cell = 1.0 / grid[2]
    begin = np.zeros(columns * rows + 1, dtype=np.int64)
    cells = np.empty(len(lines), dtype=np.int64)
    for i in range(len(lines)):
        column, row = int((lines[i, 0] - grid[0]) * per_cell), int((lines[i, 1] - grid[1]) * per_cell)
        cells[i] = row * columns + column
        begin[cells[i] + 1] += 1
    for k in range(columns * rows):
        begin[k + 1] += begin[k]
    place = begin.copy()
    ordered, origin = np.empty_like(lines), np.empty(len(lines), dtype=np.int64)
    for i in range(len(lines)):
        to = place[cells[i]]
        place[cells[i]] += 1
        ordered[to] = lines[i]
        origin[to] = i
    return ordered, origin, begin


@compiled(
    f"int64({MATRIX}, {MATRIX}, {MATRIX}, {VECTOR}, {MATRIX}, {INTEGERS}, {VECTOR}, int64, {MATRIX}, "
    f"{INTEGERS})"
)
def associate(
    points: FloatArray,
    normals: FloatArray,
    basis: FloatArray,
    state: FloatArray,
    lines: FloatArray,
    begin: IntegerArray,
    grid: FloatArray,
    columns: int,
    out: FloatArray,
    index: IntegerArray,
) -> int:
    """Nearest line of every point, and the point's distance from it.

    Args:
        points: (N, 2) [m] in the order of the beams, each in the body frame of its own instant.
        normals: (N, 2) unit normals of the surface there, likewise.
        basis: (N, 4) weights of the state's four vectors in the pose at that instant.
        state: (12,) pose and velocity at the end of the scan before, pose and velocity at the end of this
            one, in the frame of the lines.
        lines: (M, 6) in the order of the cells.
        begin: where each cell begins in `lines`.
        grid: (4,) least x, least y, side of a cell, how far a line may be [m].
        columns: number of cells along x.
        out: (N, 6) is filled: signed distance [m], its derivative by the pose at the instant (3), lever arm
            of the point in the axes of the lines (2).
        index: (N,) which line each point had with a state near by, -1 without one; is overwritten.

    Returns:
        How many points have a line.
    """
    x0, y0, per_cell, reach = grid[0], grid[1], 1.0 / grid[2], grid[3]
    rows = (len(begin) - 1) // columns
    matched, nearest = 0, -1
    for i in range(len(points)):
        b0, b1, b2, b3 = basis[i, 0], basis[i, 1], basis[i, 2], basis[i, 3]
        yaw = b0 * state[2] + b1 * state[5] + b2 * state[8] + b3 * state[11]
        c, s = cos(yaw), sin(yaw)
        arm_x = c * points[i, 0] - s * points[i, 1]
        arm_y = s * points[i, 0] + c * points[i, 1]
        x = arm_x + b0 * state[0] + b1 * state[3] + b2 * state[6] + b3 * state[9]
        y = arm_y + b0 * state[1] + b1 * state[4] + b2 * state[7] + b3 * state[10]
        normal_x, normal_y = c * normals[i, 0] - s * normals[i, 1], s * normals[i, 0] + c * normals[i, 1]
        best = reach * reach
        # The line that it had, or that of the point before, is near: few cells can hold a nearer one.
        k = index[i] if index[i] >= 0 else nearest
        nearest = -1
        if k >= 0:
            dx, dy = x - lines[k, 0], y - lines[k, 1]
            distance = dx * dx + dy * dy
            if distance < best and abs(normal_x * lines[k, 2] + normal_y * lines[k, 3]) > LEAST_COSINE:
                nearest, best = k, distance
        around = sqrt(best)
        first = max(floor((x - around - x0) * per_cell), 0)
        last = min(floor((x + around - x0) * per_cell), columns - 1)
        low = max(floor((y - around - y0) * per_cell), 0)
        high = min(floor((y + around - y0) * per_cell), rows - 1)
        if first <= last:
            for r in range(low, high + 1):
                for k in range(begin[r * columns + first], begin[r * columns + last + 1]):
                    dx, dy = x - lines[k, 0], y - lines[k, 1]
                    distance = dx * dx + dy * dy
                    if (
                        distance < best
                        and abs(normal_x * lines[k, 2] + normal_y * lines[k, 3]) > LEAST_COSINE
                    ):
                        nearest, best = k, distance
        index[i] = -1
        if nearest < 0:
            continue
        nx, ny = lines[nearest, 2], lines[nearest, 3]
        dx, dy = x - lines[nearest, 0], y - lines[nearest, 1]
        across = nx * dx + ny * dy
        # Past the end of a surface there is no line to be measured against.
        along = sqrt(max(best - across * across, 0.0))
        if along > lines[nearest, 5] + 0.5 * abs(across):
            continue
        out[i, 0] = across
        out[i, 1], out[i, 2] = nx, ny
        out[i, 3] = ny * arm_x - nx * arm_y
        out[i, 4], out[i, 5] = arm_x, arm_y
        index[i] = nearest
        matched += 1
    return matched
