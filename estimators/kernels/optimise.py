"""Gauss-Newton, Levenberg-Marquardt and marginalisation on a graph of factors."""

import numpy as np

from estimators.kernels.block_cholesky import BLOCKS, factorise, solve_down, solve_up
from estimators.kernels.compilation import INDICES, MATRIX, VECTOR, compiled
from estimators.kernels.factors import (
    GRAPH,
    SYSTEM,
    GraphArrays,
    System,
    last_use,
    linearise,
    system_of,
)
from estimators.messages import FloatArray, IntArray

_DECREMENT = 1e-7
"""A step whose promised gain in cost is less ends the search: it is 3e-4 standard deviations long."""
CONVERGED, NOT_CONVERGED, NOT_FINITE, OUT_OF_REACH = -1, -2, -3, -4
"""What the optimisers say when no variable is to blame."""


@compiled(f"void({MATRIX}, {INDICES}, {MATRIX}, {MATRIX})")
def _step(values: FloatArray, order: IntArray, dx: FloatArray, moved: FloatArray) -> None:
    for i in range(len(values)):
        for a in range(3):
            moved[i, a] = values[i, a] + (dx[order[i], a] if order[i] >= 0 else 0.0)


@compiled(f"Tuple((int64, int64, float64, {BLOCKS}, {BLOCKS}))({MATRIX}, {GRAPH}, {SYSTEM}, int64, float64)")
def gauss_newton(
    values: FloatArray, graph: GraphArrays, system: System, iterations: int, tolerance: float
) -> tuple[int, int, float, FloatArray, FloatArray]:
    """Move values to the optimum, in place.

    Args:
        values: (V, 3).
        graph: factors.
        system: where they go.
        iterations: at most.
        tolerance: the iteration ends when no value moved by more, or nothing is gained any more.

    Returns:
        `CONVERGED`, `NOT_CONVERGED`, `NOT_FINITE`, or the place in elimination order of a variable that
        nothing determines; iterations done; cost before the last; the last factor, diagonal and below.

    Source: huang2024 Eq. (34)-(38).
    """
    order, starts, rows, _ = system
    count = len(starts) - 1
    gradient = np.empty((count, 3))
    diagonal, below = np.empty((count, 3, 3)), np.empty((len(rows), 3, 3))
    cost = 0.0
    for iteration in range(iterations):
        cost = linearise(values, graph, system, gradient, diagonal, below, True)
        if not np.isfinite(cost):
            return NOT_FINITE, iteration, cost, diagonal, below
        undetermined = factorise(starts, rows, diagonal, below, count)
        if undetermined >= 0:
            return undetermined, iteration, cost, diagonal, below
        solve_down(starts, rows, diagonal, below, gradient, count)
        decrement = (gradient * gradient).sum()
        solve_up(starts, rows, diagonal, below, gradient)
        _step(values, order, gradient, values)
        if np.abs(gradient).max() <= tolerance or decrement <= _DECREMENT:
            return CONVERGED, iteration + 1, cost, diagonal, below
    return NOT_CONVERGED, iterations, cost, diagonal, below


@compiled(f"Tuple((int64, int64, float64, {BLOCKS}, {BLOCKS}))({MATRIX}, {GRAPH}, {SYSTEM}, int64, float64)")
def levenberg_marquardt(
    values: FloatArray, graph: GraphArrays, system: System, iterations: int, tolerance: float
) -> tuple[int, int, float, FloatArray, FloatArray]:
    """As `gauss_newton`, but every step is damped until it leads downhill.

    The diagonal of H is lengthened by a share, which falls tenfold with every step that succeeds and grows
    tenfold with every one that does not. The factor returned is that without damping.

    Source: Marquardt, 1963; huang2024 Eq. (34)-(38).
    """
    order, starts, rows, _ = system
    count = len(starts) - 1
    gradient = np.empty((count, 3))
    diagonal, below = np.empty((count, 3, 3)), np.empty((len(rows), 3, 3))
    trial = np.empty_like(values)
    status, done, damping = NOT_CONVERGED, 0, 1e-5
    cost = linearise(values, graph, system, gradient, diagonal, below, True)
    if not np.isfinite(cost):
        return NOT_FINITE, 0, cost, diagonal, below
    while done < iterations and status == NOT_CONVERGED:
        done += 1
        damped, lower, dx = diagonal.copy(), below.copy(), gradient.copy()
        for j in range(count):
            for a in range(3):
                damped[j, a, a] *= 1.0 + damping
        if factorise(starts, rows, damped, lower, count) >= 0:
            damping *= 10.0
            continue
        solve_down(starts, rows, damped, lower, dx, count)
        decrement = (dx * dx).sum()
        solve_up(starts, rows, damped, lower, dx)
        _step(values, order, dx, trial)
        new_cost = linearise(trial, graph, system, gradient, diagonal, below, False)
        if new_cost <= cost:
            values[:] = trial
            if np.abs(dx).max() <= tolerance or decrement <= _DECREMENT:
                status = CONVERGED
            cost = linearise(values, graph, system, gradient, diagonal, below, True)
            damping = max(0.1 * damping, 1e-12)
        elif np.abs(dx).max() <= tolerance or decrement <= _DECREMENT:
            status = CONVERGED
        else:
            damping *= 10.0
    undetermined = factorise(starts, rows, diagonal, below, count)
    return (undetermined if undetermined >= 0 else status), done, cost, diagonal, below


@compiled(f"Tuple((int64, {MATRIX}, {VECTOR}))({MATRIX}, {GRAPH}, {SYSTEM}, int64)")
def marginalise(
    values: FloatArray, graph: GraphArrays, system: System, eliminated: int
) -> tuple[int, FloatArray, FloatArray]:
    """What factors say of some variables when the others are no longer asked for.

    Args:
        values: (V, 3) where the factors are linearised.
        graph: the factors, nothing else.
        system: where they go.
        eliminated: so many variables, the first in elimination order, are marginalised.

    Returns:
        -1 or the place of a variable that nothing determines; information (3 K, 3 K) and downhill gradient
        (3 K,) of the K others, in elimination order.
    """
    _, starts, rows, _ = system
    count = len(starts) - 1
    gradient = np.empty((count, 3))
    diagonal, below = np.empty((count, 3, 3)), np.empty((len(rows), 3, 3))
    linearise(values, graph, system, gradient, diagonal, below, True)
    undetermined = factorise(starts, rows, diagonal, below, eliminated)
    solve_down(starts, rows, diagonal, below, gradient, eliminated)
    size = 3 * (count - eliminated)
    information, pull = np.zeros((size, size)), np.empty(size)
    for j in range(eliminated, count):
        at = 3 * (j - eliminated)
        pull[at : at + 3] = gradient[j]
        for a in range(3):
            for b in range(3):
                information[at + a, at + b] = 0.5 * (diagonal[j, a, b] + diagonal[j, b, a])
        for p in range(starts[j], starts[j + 1]):
            to = 3 * (rows[p] - eliminated)
            for a in range(3):
                for b in range(3):
                    information[to + a, at + b] = information[at + b, to + a] = below[p, a, b]
    return undetermined, information, pull


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
        for; covariance (3 K, 3 K) of the variables asked for; its inverse.
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
    inverse = np.linalg.inv(root)
    return status, inverse.T @ inverse, root @ root.T


@compiled(
    f"Tuple((int64, {MATRIX}))"
    f"({MATRIX}, {GRAPH}, {INDICES}, int64, int64, int64, int64, float64, float64)"
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
        farthest: `OUT_OF_REACH` is told where a pose would be farther than this from where the dense prior was
            linearised. Velocities may be: motion is linear in them.

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
