"""Sparse Cholesky factorisation of symmetric matrices that consist of blocks of three by three.

Rows and columns of blocks are in elimination order. Block column j of the factor L has its diagonal block in
``diagonal[j]`` and those below it in ``below[starts[j] : starts[j + 1]]``, whose rows are in ``rows`` at the
same places, ascending. The matrix to be factorised is put into the same places, its lower half, and becomes
its factor.
"""

from math import sqrt

import numpy as np

from estimators.kernels.compilation import INDICES, MATRIX, compiled, inlined
from estimators.messages import FloatArray, IntArray

BLOCKS = "float64[:, :, ::1]"
_LEAST_PIVOT = 1e-12
"""Share of a diagonal element that elimination must leave; less is rounding, and the matrix singular."""


@inlined
def _sort(numbers: IntArray, begin: int, end: int) -> None:
    """Sort a few numbers in place, where a call of a library would take longer than it works."""
    for k in range(begin + 1, end):
        number, place = numbers[k], k
        while place > begin and numbers[place - 1] > number:
            numbers[place] = numbers[place - 1]
            place -= 1
        numbers[place] = number


@compiled(f"Tuple(({INDICES}, {INDICES}))(int64, int64[:, ::1])")
def pattern(count: int, pairs: IntArray) -> tuple[IntArray, IntArray]:
    """Where the factor has blocks.

    Args:
        count: number of block columns.
        pairs: (P, 2) places (lower, higher) in elimination order of variables that a factor connects; a pair
            may occur more than once, those with a negative number do not count.

    Returns:
        starts (count + 1,) and rows, as the module describes them.

    Source: Davis, Direct Methods for Sparse Linear Systems, 2006, 4.1: the pattern of a column is that of the
    matrix and those of the columns whose first entry below the diagonal is in this column's row.
    """
    first_pair = np.zeros(count + 1, dtype=np.int64)
    for k in range(len(pairs)):
        if pairs[k, 0] >= 0:
            first_pair[pairs[k, 0] + 1] += 1
    for j in range(count):
        first_pair[j + 1] += first_pair[j]
    place = first_pair[:-1].copy()
    partners = np.empty(first_pair[count], dtype=np.int64)
    for k in range(len(pairs)):
        if pairs[k, 0] >= 0:
            partners[place[pairs[k, 0]]] = pairs[k, 1]
            place[pairs[k, 0]] += 1
    starts = np.zeros(count + 1, dtype=np.int64)
    rows = np.empty(max(4 * count, 16), dtype=np.int64)
    seen_in = np.full(count, -1, dtype=np.int64)
    first_child = np.full(count, -1, dtype=np.int64)
    next_sibling = np.full(count, -1, dtype=np.int64)
    for j in range(count):
        end = starts[j]
        if end + count > len(rows):
            longer = np.empty(2 * len(rows) + count, dtype=np.int64)
            longer[:end] = rows[:end]
            rows = longer
        seen_in[j] = j
        for k in range(first_pair[j], first_pair[j + 1]):
            if seen_in[partners[k]] != j:
                seen_in[partners[k]] = j
                rows[end] = partners[k]
                end += 1
        child = first_child[j]
        while child >= 0:
            for k in range(starts[child], starts[child + 1]):
                if seen_in[rows[k]] != j:
                    seen_in[rows[k]] = j
                    rows[end] = rows[k]
                    end += 1
            child = next_sibling[child]
        _sort(rows, starts[j], end)
        starts[j + 1] = end
        if end > starts[j]:
            parent = rows[starts[j]]
            next_sibling[j] = first_child[parent]
            first_child[parent] = j
    return starts, rows[: starts[count]].copy()


@compiled(f"int64({INDICES}, {INDICES}, int64, int64)")
def place_of(starts: IntArray, rows: IntArray, column: int, row: int) -> int:
    """Place in `rows` of a block that the factor has."""
    low, high = int(starts[column]), int(starts[column + 1]) - 1
    while low < high:
        middle = (low + high) // 2
        if rows[middle] < row:
            low = middle + 1
        else:
            high = middle
    return low


@inlined
def _subtract_product(C: FloatArray, c: int, A: FloatArray, a: int, B: tuple[float, ...]) -> None:
    """``C[c] -= A[a] B^T`` with the nine numbers of B, row by row."""
    for i in range(3):
        x, y, z = A[a, i, 0], A[a, i, 1], A[a, i, 2]
        C[c, i, 0] -= x * B[0] + y * B[1] + z * B[2]
        C[c, i, 1] -= x * B[3] + y * B[4] + z * B[5]
        C[c, i, 2] -= x * B[6] + y * B[7] + z * B[8]


@compiled(f"int64({INDICES}, {INDICES}, {BLOCKS}, {BLOCKS}, int64)")
def factorise(
    starts: IntArray, rows: IntArray, diagonal: FloatArray, below: FloatArray, eliminated: int
) -> int:
    """Turn the first columns of a matrix into those of its factor, in place.

    What is left of the other columns is the matrix of the variables that are not eliminated (Schur
    complement): their information when the others are marginalised.

    Args:
        starts: of the columns.
        rows: of the blocks.
        diagonal: (N, 3, 3).
        below: (M, 3, 3).
        eliminated: number of columns to be factorised.

    Returns:
        -1; or the place in elimination order of a variable that nothing determines.
    """
    original = np.empty((len(diagonal), 3))
    for j in range(len(diagonal)):
        for i in range(3):
            original[j, i] = diagonal[j, i, i]
    for j in range(eliminated):
        L = diagonal[j]
        for i in range(3):
            for k in range(i):
                rest = L[i, k]
                for m in range(k):
                    rest -= L[i, m] * L[k, m]
                L[i, k] = rest / L[k, k]
                L[k, i] = 0.0
            rest = L[i, i]
            for m in range(i):
                rest -= L[i, m] * L[i, m]
            if not rest > _LEAST_PIVOT * original[j, i]:
                return j
            L[i, i] = sqrt(rest)
        begin, end = starts[j], starts[j + 1]
        a, b, c = 1.0 / L[0, 0], 1.0 / L[1, 1], 1.0 / L[2, 2]
        l_10, l_20, l_21 = L[1, 0], L[2, 0], L[2, 1]
        for p in range(begin, end):
            for i in range(3):
                x = below[p, i, 0] * a
                y = (below[p, i, 1] - l_10 * x) * b
                below[p, i, 0], below[p, i, 1] = x, y
                below[p, i, 2] = (below[p, i, 2] - l_20 * x - l_21 * y) * c
        for p in range(begin, end):
            B = (
                *(below[p, 0, 0], below[p, 0, 1], below[p, 0, 2]),
                *(below[p, 1, 0], below[p, 1, 1], below[p, 1, 2]),
                *(below[p, 2, 0], below[p, 2, 1], below[p, 2, 2]),
            )
            _subtract_product(diagonal, rows[p], below, p, B)
            target = starts[rows[p]]
            for q in range(p + 1, end):
                while rows[target] < rows[q]:
                    target += 1
                _subtract_product(below, target, below, q, B)
    return -1


@compiled(f"void({INDICES}, {INDICES}, {BLOCKS}, {BLOCKS}, {MATRIX}, int64)")
def solve_down(
    starts: IntArray, rows: IntArray, diagonal: FloatArray, below: FloatArray, x: FloatArray, eliminated: int
) -> None:
    """Forward substitution with the first columns of the factor: ``x <- L^-1 x``, (N, 3), in place."""
    for j in range(eliminated):
        L = diagonal[j]
        x[j, 0] /= L[0, 0]
        x[j, 1] = (x[j, 1] - L[1, 0] * x[j, 0]) / L[1, 1]
        x[j, 2] = (x[j, 2] - L[2, 0] * x[j, 0] - L[2, 1] * x[j, 1]) / L[2, 2]
        for p in range(starts[j], starts[j + 1]):
            for i in range(3):
                x[rows[p], i] -= (
                    below[p, i, 0] * x[j, 0] + below[p, i, 1] * x[j, 1] + below[p, i, 2] * x[j, 2]
                )


@compiled(f"void({INDICES}, {INDICES}, {BLOCKS}, {BLOCKS}, {MATRIX})")
def solve_up(
    starts: IntArray, rows: IntArray, diagonal: FloatArray, below: FloatArray, x: FloatArray
) -> None:
    """Backward substitution: ``x <- L^-T x``, (N, 3), in place."""
    for j in range(len(diagonal) - 1, -1, -1):
        L = diagonal[j]
        for p in range(starts[j], starts[j + 1]):
            for i in range(3):
                for k in range(3):
                    x[j, k] -= below[p, i, k] * x[rows[p], i]
        x[j, 2] /= L[2, 2]
        x[j, 1] = (x[j, 1] - L[2, 1] * x[j, 2]) / L[1, 1]
        x[j, 0] = (x[j, 0] - L[1, 0] * x[j, 1] - L[2, 0] * x[j, 2]) / L[0, 0]


@compiled(f"Tuple(({BLOCKS}, {BLOCKS}))({INDICES}, {INDICES}, {BLOCKS}, {BLOCKS})")
def inverse_blocks(
    starts: IntArray, rows: IntArray, diagonal: FloatArray, below: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Blocks of the inverse of the factorised matrix, in those places alone where the factor has blocks.

    Returns:
        Diagonal blocks (N, 3, 3); the others (M, 3, 3), row by column as in the factor.

    Source: Takahashi, Fagan and Chen, 1973; Golub and Plemmons, 1980: Z_sj = -Z_ss L_sj L_jj^-1 and
    Z_jj = L_jj^-T L_jj^-1 - (L_sj L_jj^-1)^T Z_sj, column by column from the last.
    """
    on_diagonal, others = np.empty_like(diagonal), np.empty_like(below)
    eye = np.eye(3)
    for j in range(len(diagonal) - 1, -1, -1):
        begin, end = starts[j], starts[j + 1]
        inverse = np.zeros((3, 3))
        L = diagonal[j]
        for k in range(3):
            for i in range(k, 3):
                rest = eye[i, k]
                for m in range(k, i):
                    rest -= L[i, m] * inverse[m, k]
                inverse[i, k] = rest / L[i, i]
        scaled = np.zeros((end - begin, 3, 3))
        for p in range(begin, end):
            for i in range(3):
                for k in range(3):
                    for m in range(3):
                        scaled[p - begin, i, k] += below[p, i, m] * inverse[m, k]
        others[begin:end] = 0.0
        for p in range(begin, end):
            column = starts[rows[p]]
            for q in range(p, end):
                if q > p:
                    while rows[column] < rows[q]:
                        column += 1
                for i in range(3):
                    for k in range(3):
                        for m in range(3):
                            if q == p:
                                others[p, i, k] -= on_diagonal[rows[p], i, m] * scaled[p - begin, m, k]
                            else:
                                others[q, i, k] -= others[column, i, m] * scaled[p - begin, m, k]
                                others[p, i, k] -= others[column, m, i] * scaled[q - begin, m, k]
        for i in range(3):
            for k in range(i + 1):
                total = 0.0
                for m in range(3):
                    total += inverse[m, i] * inverse[m, k]
                    for p in range(begin, end):
                        total -= scaled[p - begin, m, i] * others[p, m, k]
                # Both halves at once: what they differ by would grow from column to column.
                on_diagonal[j, i, k] = on_diagonal[j, k, i] = total
    return on_diagonal, others
