"""A sliding window of nodes: its optimum, what leaves it, and the factors that go with that."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from estimators.kernels.algebra import solve_lower
from estimators.kernels.block_cholesky import BLOCKS
from estimators.kernels.compilation import INDICES, MATRIX, compiled
from estimators.kernels.factors import GRAPH, GraphArrays, last_use, system_of
from estimators.kernels.optimise import (
    CONVERGED,
    NOT_CONVERGED,
    NOT_FINITE,
    OUT_OF_REACH,
    gauss_newton,
    marginalise,
)
from estimators.messages import FloatArray, IntArray

BoolArray: TypeAlias = NDArray[np.bool_]
_FLAGS = "boolean[::1]"


@compiled(f"{MATRIX}({INDICES}, {INDICES}, {BLOCKS}, {BLOCKS}, int64)")
def _last_root(
    starts: IntArray, rows: IntArray, diagonal: FloatArray, below: FloatArray, blocks: int
) -> FloatArray:
    """The factor (3 K, 3 K) of the last K variables in elimination order."""
    first = len(starts) - 1 - blocks
    root = np.zeros((3 * blocks, 3 * blocks))
    for k in range(blocks):
        root[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = diagonal[first + k]
        for p in range(starts[first + k], starts[first + k + 1]):
            m = rows[p] - first
            root[3 * m : 3 * m + 3, 3 * k : 3 * k + 3] = below[p]
    return root


@compiled(f"Tuple((int64, {MATRIX}, {MATRIX}))({MATRIX}, {GRAPH}, {INDICES}, int64, int64, int64, float64)")
def solve_window(
    values: FloatArray,
    graph: GraphArrays,
    asked: IntArray,
    known: int,
    first: int,
    iterations: int,
    tolerance: float,
) -> tuple[int, FloatArray, FloatArray]:
    """Move the values of a window of nodes to their optimum, in place, and tell what is known of some.

    Args:
        values: (V, 3).
        graph: factors.
        asked: (K,) variables whose covariance is asked for.
        known: so many variables, the first, are known.
        first: of those before this one only the variables of the dense prior are solved for.
        iterations: as in `gauss_newton`.
        tolerance: likewise.

    Returns:
        As `gauss_newton` a status, which is `OUT_OF_REACH` where a factor is on a variable that is not solved
        for; covariance (3 K, 3 K) of the variables asked for; the lower root of its inverse.
    """
    nothing = np.empty((0, 0))
    dense = graph[6]
    last_needed = last_use(graph)
    # What is asked for goes last: its covariance is then read off the end of the factor.
    for k in range(len(asked)):
        last_needed[asked[k]] = len(values) + k
    solved_for = np.zeros(len(values), dtype=np.bool_)
    solved_for[first:] = True
    solved_for[dense] = True
    for i in range(known, first):
        if last_needed[i] >= 0 and not solved_for[i]:
            return OUT_OF_REACH, nothing, nothing
    variables = np.flatnonzero(solved_for)
    order = np.full(len(values), -1, dtype=np.int64)
    order[variables[np.argsort(last_needed[variables], kind="mergesort")]] = np.arange(len(variables))
    system = system_of(graph, order, len(variables))
    status, _, _, diagonal, below = gauss_newton(values, graph, system, iterations, tolerance)
    if status not in (CONVERGED, NOT_CONVERGED) or not np.isfinite(values).all():
        return (NOT_FINITE if status < 0 else status), nothing, nothing
    root = _last_root(system[1], system[2], diagonal, below, len(asked))
    inverse, eye, covariance = np.empty_like(root), np.eye(len(root)), np.empty_like(root)
    for j in range(len(root)):
        inverse[j] = solve_lower(root, eye[j])
        for k in range(j + 1):
            total = 0.0
            for i in range(j, len(root)):
                total += inverse[j, i] * inverse[k, i]
            covariance[j, k] = covariance[k, j] = total
    return status, covariance, root


@compiled(
    f"Tuple((int64, {MATRIX}))({MATRIX}, {GRAPH}, {INDICES}, int64, int64, int64, int64, float64, float64)"
)
def solve_newest(
    values: FloatArray,
    graph: GraphArrays,
    asked: IntArray,
    known: int,
    width: int,
    first: int,
    iterations: int,
    tolerance: float,
    farthest: float,
) -> tuple[int, FloatArray]:
    """As `solve_window`, but values stay as they are unless the dense prior is still good at the optimum.

    Args:
        values: (V, 3).
        graph: factors.
        asked: (K,) variables whose covariance is asked for.
        known: so many variables, the first, are known.
        width: variables of a node, the first of which is its pose.
        first: the first new one.
        iterations: as in `gauss_newton`.
        tolerance: likewise.
        farthest: `OUT_OF_REACH` is told where a pose would be farther than this from where the dense prior
            was linearised. Velocities may be: motion is linear in them.

    Returns:
        The status; covariance (3 K, 3 K) of the variables asked for.
    """
    moved, dense, dense_at = values.copy(), graph[6], graph[7]
    status, covariance, _ = solve_window(moved, graph, asked, known, first, iterations, tolerance)
    if status in (CONVERGED, NOT_CONVERGED):
        for k in range(len(dense)):
            is_pose = (dense[k] - known) % width == 0
            if is_pose and np.abs(moved[dense[k]] - dense_at[k]).max() > farthest:
                return OUT_OF_REACH, covariance
        values[:] = moved
    return status, covariance


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
def _divide(
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


@compiled(f"Tuple(({MATRIX}, {GRAPH}, {INDICES}))({MATRIX}, {GRAPH}, {_FLAGS}, int64, int64, boolean)")
def forget(
    values: FloatArray, graph: GraphArrays, leaving: BoolArray, known: int, width: int, everything: bool
) -> tuple[FloatArray, GraphArrays, IntArray]:
    """Marginalise nodes: the factors on them, linearised where they are, become a dense prior on the rest.

    Args:
        values: (V, 3).
        graph: factors.
        leaving: (N,) the nodes that leave.
        known: number of the first node's first variable.
        width: variables of a node.
        everything: all factors become part of the prior.

    Returns:
        Values of the variables that stay; the graph of those; (V,) their new numbers.
    """
    free, increments, ranges, sightings, motions, priors, dense, dense_at, dense_information, pull = graph
    gone = np.zeros(len(values), dtype=np.bool_)
    for node in range(len(leaving)):
        gone[known + width * node : known + width * (node + 1)] = leaving[node]
    numbers = np.cumsum(~gone) - 1
    touched = gone.copy()
    touched[dense] = True
    goes = np.ones_like(gone) if everything else gone
    old_increments, increments = _divide(increments, 2, goes, touched, numbers)
    old_ranges, ranges = _divide(ranges, 2, goes, touched, numbers)
    old_sightings, sightings = _divide(sightings, 2, goes, touched, numbers)
    old_motions, motions = _divide(motions, 4, goes, touched, numbers)
    old_priors, priors = _divide(priors, 1, goes, touched, numbers)
    old = (
        *(free, old_increments, old_ranges, old_sightings, old_motions, old_priors),
        *(dense, dense_at, dense_information, pull),
    )
    touched[:known] = False
    staying, eliminated = np.flatnonzero(touched & ~gone), gone.sum()
    order = np.full(len(values), -1, dtype=np.int64)
    order[gone] = np.arange(eliminated)
    order[staying] = eliminated + np.arange(len(staying))
    system = system_of(old, order, eliminated + len(staying))
    _, information, gradient = marginalise(values, old, system, eliminated)
    kept = (
        *(free[~gone], increments, ranges, sightings, motions, priors),
        *(numbers[staying], values[staying], information, gradient),
    )
    return values[~gone], kept, numbers
