"""Inner loop of the search for a pose in a map: branch and bound over cells and headings."""

import numpy as np
from numpy.typing import NDArray

from estimators.kernels.compilation import MATRIX, compiled
from estimators.messages import FloatArray

PYRAMID = "float32[:, :, ::1]"
CELLS = "int64[:, :, ::1]"


@compiled(f"float64({PYRAMID}, {CELLS}, int64, int64, int64, int64)")
def bound(
    pyramid: NDArray[np.float32], cells: NDArray[np.int64], level: int, turn: int, row: int, column: int
) -> float:
    """Sum over the points of the greatest value that any shift of a block of shifts gives them.

    Args:
        pyramid: (levels, rows, columns); level h has the maximum over 2^h x 2^h cells from each cell on.
        cells: (turns, N, 2) row and column of every point at every heading, for a shift of zero.
        level: of the block, which has 2^level x 2^level shifts.
        turn: which heading.
        row: least shift along y [cells].
        column: least shift along x [cells].
    """
    rows, columns = pyramid.shape[1], pyramid.shape[2]
    total = 0.0
    for i in range(cells.shape[1]):
        y, x = cells[turn, i, 0] + row, cells[turn, i, 1] + column
        # A block that begins before the map may still reach into it.
        if y < 0:
            y = 0 if y > -(1 << level) else -1
        if x < 0:
            x = 0 if x > -(1 << level) else -1
        if 0 <= y < rows and 0 <= x < columns:
            total += pyramid[level, y, x]
    return total


@compiled(f"Tuple((float64, int64, int64, int64))({PYRAMID}, {CELLS}, {MATRIX}, int64[:, ::1], float64)")
def search(
    pyramid: NDArray[np.float32],
    cells: NDArray[np.int64],
    blocks: FloatArray,
    taken: NDArray[np.int64],
    least: float,
) -> tuple[float, int, int, int]:
    """Best pose, away from those that are taken.

    Args:
        pyramid: as for `bound`.
        cells: as for `bound`.
        blocks: (B, 4) bound, turn, row, column of the blocks of the highest level, best bound first.
        taken: (K, 5) turn, row, column of poses, and turns and cells all round them that do not count.
        least: sum that a pose must exceed.

    Returns:
        Its sum, turn, row and column; the turn is -1 when there is none.

    Source: Hess, Kohler, Rapp and Andor, "Real-time loop closure in 2D LIDAR SLAM", ICRA 2016, algorithm 3.
    """
    turns = len(cells)
    best, best_turn, best_row, best_column = least, -1, 0, 0
    top = len(pyramid) - 1
    stack = np.empty((4 * (top + 1) + 1, 4), dtype=np.int64)
    bounds = np.empty(4 * (top + 1) + 1)
    for b in range(len(blocks)):
        if blocks[b, 0] <= best:
            break
        stack[0, 0] = top
        stack[0, 1:] = blocks[b, 1:].astype(np.int64)
        bounds[0] = blocks[b, 0]
        waiting = 1
        while waiting > 0:
            waiting -= 1
            if bounds[waiting] <= best:
                continue
            level, turn, row, column = stack[waiting]
            size = 1 << level
            inside = False
            for k in range(len(taken)):
                apart = abs(turn - taken[k, 0])
                inside |= (
                    min(apart, turns - apart) <= taken[k, 3]
                    and abs(row - taken[k, 1]) <= taken[k, 4]
                    and abs(row + size - 1 - taken[k, 1]) <= taken[k, 4]
                    and abs(column - taken[k, 2]) <= taken[k, 4]
                    and abs(column + size - 1 - taken[k, 2]) <= taken[k, 4]
                )
            if inside:
                continue
            if level == 0:
                best, best_turn, best_row, best_column = bounds[waiting], turn, row, column
                continue
            half = size >> 1
            first = waiting
            for part in range(4):
                r, c = row + half * (part >> 1), column + half * (part & 1)
                value = bound(pyramid, cells, level - 1, turn, r, c)
                if value <= best:
                    continue
                # The most promising part is looked at first: it lies on top.
                at = waiting
                while at > first and bounds[at - 1] > value:
                    bounds[at] = bounds[at - 1]
                    stack[at] = stack[at - 1]
                    at -= 1
                bounds[at] = value
                stack[at, 0], stack[at, 1], stack[at, 2], stack[at, 3] = level - 1, turn, r, c
                waiting += 1
    return best, best_turn, best_row, best_column


@compiled(f"{MATRIX}({PYRAMID}, {CELLS}, int64, int64, int64, int64)")
def top_blocks(
    pyramid: NDArray[np.float32],
    cells: NDArray[np.int64],
    first_row: int,
    last_row: int,
    first_column: int,
    last_column: int,
) -> FloatArray:
    """Blocks (B, 4) of the highest level that cover all headings and these shifts, as for `search`, unsorted.

    Args:
        pyramid: as for `bound`.
        cells: as for `bound`.
        first_row: least shift along y [cells].
        last_row: greatest shift along y [cells].
        first_column: least shift along x [cells].
        last_column: greatest shift along x [cells].
    """
    top = len(pyramid) - 1
    size = 1 << top
    down = (last_row - first_row) // size + 1
    across = (last_column - first_column) // size + 1
    blocks = np.empty((len(cells) * down * across, 4))
    b = 0
    for turn in range(len(cells)):
        for i in range(down):
            for j in range(across):
                row, column = first_row + i * size, first_column + j * size
                blocks[b, 0] = bound(pyramid, cells, top, turn, row, column)
                blocks[b, 1], blocks[b, 2], blocks[b, 3] = turn, row, column
                b += 1
    return blocks
