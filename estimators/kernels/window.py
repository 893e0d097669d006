"""What leaves a sliding window of nodes, and the factors that go with it."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from estimators.kernels.compilation import INDICES, MATRIX, compiled
from estimators.messages import FloatArray, IntArray

BoolArray: TypeAlias = NDArray[np.bool_]
_FLAGS = "boolean[::1]"


@compiled(f"{_FLAGS}({INDICES}, int64, {MATRIX}, int64, int64)")
def leaving(
    stamps_ns: IntArray, horizon_ns: int, increments: FloatArray, known: int, width: int
) -> BoolArray:
    """Which nodes (N,) are older than the horizon and share no increment with a younger one.

    Args:
        stamps_ns: (N,) of the nodes, ascending.
        horizon_ns: older nodes leave.
        increments: (M, 17) as in `estimators.graph.factors`.
        known: number of the first node's first variable.
        width: variables of a node.
    """
    gone = stamps_ns < horizon_ns
    for k in range(len(increments)):
        i, j = (int(increments[k, 0]) - known) // width, (int(increments[k, 1]) - known) // width
        i_is_old, j_is_old = stamps_ns[i] < horizon_ns, stamps_ns[j] < horizon_ns
        if i_is_old != j_is_old:
            gone[i], gone[j] = False, False
    return gone


@compiled(f"UniTuple({MATRIX}, 2)({MATRIX}, int64, {_FLAGS}, {_FLAGS}, {INDICES})")
def divide(
    table: FloatArray, columns: int, gone: BoolArray, touched: BoolArray, numbers: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Divide factors into those on variables that leave and the others.

    Args:
        table: (M, K) of factors.
        columns: so many of its first columns are variables.
        gone: (V,) the variables that leave.
        touched: (V,) set for each variable of a factor that leaves.
        numbers: (V,) new numbers of the variables that stay, given to the factors that stay.

    Returns:
        The factors that leave; the factors that stay.
    """
    leaves = np.zeros(len(table), dtype=np.bool_)
    for k in range(len(table)):
        for c in range(columns):
            if gone[int(table[k, c])]:
                leaves[k] = True
    out = np.empty((leaves.sum(), table.shape[1]))
    rest = np.empty((len(table) - len(out), table.shape[1]))
    a, b = 0, 0
    for k in range(len(table)):
        if leaves[k]:
            out[a] = table[k]
            a += 1
            for c in range(columns):
                touched[int(table[k, c])] = True
        else:
            rest[b] = table[k]
            for c in range(columns):
                rest[b, c] = numbers[int(table[k, c])]
            b += 1
    return out, rest
