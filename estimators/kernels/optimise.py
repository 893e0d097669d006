"""Gauss-Newton, Levenberg-Marquardt and marginalisation on a graph of factors."""

import numpy as np

from estimators.kernels.block_cholesky import BLOCKS, factorise, solve_down, solve_up
from estimators.kernels.compilation import INDICES, MATRIX, VECTOR, compiled
from estimators.kernels.factors import GRAPH, SYSTEM, GraphArrays, System, linearise
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
