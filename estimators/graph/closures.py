"""Loop closures of which some are wrong: graduated non-convexity.

A wrong closure is not noise: it must not count at all. The loss wanted is quadratic up to a limit and flat
beyond (truncated least squares), which no Newton method gets to from afar. So a convex relative of it is
solved first, and made more like it in rounds, until every closure counts in full or not at all.
"""

from dataclasses import replace

import numpy as np

from estimators import chi2
from estimators.geometry import wrap_angles
from estimators.graph.factors import Graph
from estimators.graph.solver import Solution, solve
from estimators.messages import FloatArray, IntArray

_SHARPER = 1.4
"""Factor of the control parameter from round to round."""
_ROUNDS = 100
_WEIGHT = 16


def solve_with_doubtful(
    graph: Graph, doubtful: IntArray, confidence: float = 0.999
) -> tuple[Solution, FloatArray]:
    """Find the optimum of a graph and which of its doubtful increments belong to it.

    Args:
        graph: with values near what the increments that are not doubtful say.
        doubtful: (D,) rows of its increments.
        confidence: share of right increments whose squared Mahalanobis distance is within the limit.

    Returns:
        The optimum; weights (D,), 1 for those that belong and 0 for those that do not.

    Raises:
        GraphError: as `solve`.

    Source: Yang, Antonante, Tzoumas and Carlone, IEEE RA-L 5(2), 2020, GNC-TLS, Eq. (14)-(15), remark 5; that
        each refused increment is tried once more is ours.
    """
    limit = float(chi2.ppf(confidence, 3))
    solution, weights = solve(graph), np.ones(len(doubtful))
    squares = increment_squares(solution.values, graph.increments[doubtful])
    worst = float(squares.max(initial=0.0))
    if worst <= limit:
        return solution, weights
    control = limit / (2.0 * worst - limit)
    for _ in range(_ROUNDS):
        between = np.sqrt(limit * control * (control + 1.0) / np.maximum(squares, 1e-12)) - control
        weights = np.clip(between, 0.0, 1.0)
        increments = graph.increments.copy()
        increments[doubtful, _WEIGHT] = weights
        solution = solve(replace(graph, values=solution.values, increments=increments))
        if ((weights == 0.0) | (weights == 1.0)).all():
            break
        squares = increment_squares(solution.values, graph.increments[doubtful])
        control *= _SHARPER
    return _with_those_wronged(graph, doubtful, limit, solution, weights)


def _with_those_wronged(
    graph: Graph, doubtful: IntArray, limit: float, solution: Solution, weights: FloatArray
) -> tuple[Solution, FloatArray]:
    """Take back what was refused while wrong increments still bent the graph, and costs less than refusing.

    In truncated least squares what is refused costs half the limit.
    """
    for k in np.flatnonzero(weights == 0.0):
        tried = weights.copy()
        tried[k] = 1.0
        increments = graph.increments.copy()
        increments[doubtful, _WEIGHT] = tried
        with_it = solve(replace(graph, values=solution.values, increments=increments))
        if with_it.cost - solution.cost < 0.5 * limit:
            solution, weights = with_it, tried
    return solution, weights


def increment_squares(values: FloatArray, rows: FloatArray) -> FloatArray:
    """Squared Mahalanobis distances (M,) of rows (M, 17) of `factors.increments`."""
    first, second = values[rows[:, 0].astype(np.int64)], values[rows[:, 1].astype(np.int64)]
    c, s = np.cos(first[:, 2]), np.sin(first[:, 2])
    dx, dy = (second - first)[:, :2].T
    predicted = np.column_stack([c * dx + s * dy, c * dy - s * dx, second[:, 2] - first[:, 2]])
    residuals = rows[:, 2:5] - predicted
    residuals[:, 2] = wrap_angles(residuals[:, 2])
    return np.asarray(np.einsum("ni,nij,nj->n", residuals, rows[:, 5:14].reshape(-1, 3, 3), residuals))
