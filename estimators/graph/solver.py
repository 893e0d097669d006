"""The optimum of a graph, and how sure it is."""

from typing import Literal

import numpy as np

from estimators.graph.checks import check, undetermined
from estimators.graph.errors import GraphError
from estimators.graph.factors import Graph
from estimators.graph.ordering import elimination_order
from estimators.immutable import immutable
from estimators.kernels import block_cholesky, optimise
from estimators.kernels.factors import GraphArrays, System, system_of
from estimators.messages import FloatArray

Method = Literal["gauss_newton", "levenberg_marquardt"]


@immutable
class Solution:
    """The optimum of a graph.

    Attributes:
        values: (V, 3) of the variables.
        cost: half the sum of squared residuals in units of their sigmas, or what robust losses make of it.
        iterations: steps that it took.
        system: structure of the equations.
        factor: Cholesky factor of the information matrix at the optimum, diagonal and below.
    """

    values: FloatArray
    cost: float
    iterations: int
    system: System
    factor: tuple[FloatArray, FloatArray]

    def covariances(self, free: FloatArray) -> FloatArray:
        """Marginal covariance (V, 3, 3) of every variable; zero where a number was known.

        Args:
            free: (V, 3) as in the graph.
        """
        order, starts, rows, _ = self.system
        on_diagonal, _ = block_cholesky.inverse_blocks(starts, rows, *self.factor)
        found = np.zeros((len(free), 3, 3))
        solved = order >= 0
        found[solved] = on_diagonal[order[solved]]
        return found * free[:, :, None] * free[:, None, :]


def arrays(graph: Graph) -> GraphArrays:
    """A graph as the kernels take it."""
    dense = graph.dense
    whole = np.ascontiguousarray
    return (
        whole(graph.free),
        whole(graph.increments),
        whole(graph.ranges),
        whole(graph.sightings),
        whole(graph.motions),
        whole(graph.priors),
        dense.variables,
        whole(dense.at),
        whole(dense.information),
        whole(dense.gradient),
    )


def solve(
    graph: Graph,
    method: Method = "levenberg_marquardt",
    iterations: int = 300,
    tolerance: float = 1e-7,
) -> Solution:
    """Find the most likely values of a graph's variables.

    Args:
        graph: its values are where the search begins; they stay as they are.
        method: Gauss-Newton is faster from a good start, Levenberg-Marquardt comes from farther away.
        iterations: at most.
        tolerance: it ends when no value moves by more [m, rad], or nothing is gained any more.

    Raises:
        GraphError: numbers that are not finite, variables that nothing determines, or no optimum within so
            many iterations.

    Source: huang2024 Eq. (34)-(38).
    """
    check(graph)
    taken = arrays(graph)
    order, count = elimination_order(taken)
    system = system_of(taken, order, count)
    values = graph.values.copy()
    status, done, cost, *factor = getattr(optimise, method)(values, taken, system, iterations, tolerance)
    if status >= 0:
        raise undetermined(graph, int(np.flatnonzero(order == status)[0]))
    if status == optimise.NOT_FINITE:
        raise GraphError(f"the search left the finite numbers after {done} steps: the start is too far off")
    if status == optimise.NOT_CONVERGED:
        raise GraphError(f"no optimum within {iterations} steps: the start is too far off")
    return Solution(values, cost, done, system, (factor[0], factor[1]))
