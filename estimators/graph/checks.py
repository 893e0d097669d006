"""Whether a graph can have a solution, before it is solved."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from estimators.graph.errors import GraphError
from estimators.graph.factors import Graph
from estimators.messages import FloatArray, IntArray

BoolArray: TypeAlias = NDArray[np.bool_]

_VARIABLES = {"increments": 2, "ranges": 2, "sightings": 2, "motions": 4, "priors": 1}
"""Leading columns of each table that are variables."""
_EQUATIONS = {"increments": 3, "ranges": 1, "sightings": 2, "motions": 6, "priors": 3}


def check(graph: Graph) -> None:
    """Look for what no solver could mend.

    Raises:
        GraphError: a number that is not finite; a variable that no factor, too few factors, or nothing but
            variables which are themselves free to move together, determine.
    """
    _check_numbers(graph)
    free: BoolArray = np.asarray(graph.free.any(axis=1), dtype=np.bool_)
    equations = np.zeros(len(free), dtype=np.int64)
    for table, columns in _VARIABLES.items():
        np.add.at(equations, _variables(getattr(graph, table), columns), _EQUATIONS[table])
    equations[graph.dense.variables] += 3
    unknowns = graph.free.sum(axis=1)
    short = np.flatnonzero(equations < unknowns)
    if len(short):
        i = int(short[0])
        raise GraphError(
            f"{graph.name(i)}: {equations[i] or 'no'} measured numbers bear on it, at least "
            f"{unknowns[i]:.0f} are needed"
        )
    _check_anchoring(graph, free)


def undetermined(graph: Graph, variable: int) -> GraphError:
    """Error for a variable that the solver finds undetermined."""
    return GraphError(
        f"{graph.name(variable)}: the measurements do not determine it (a graph that may be moved or turned "
        "as a whole, or poses that see too little)"
    )


def _variables(table: FloatArray, columns: int) -> IntArray:
    return np.asarray(table[:, :columns], dtype=np.int64)


def _check_numbers(graph: Graph) -> None:
    bad = np.flatnonzero(~np.isfinite(graph.values).all(axis=1))
    if len(bad):
        raise GraphError(f"{graph.name(int(bad[0]))}: its start is not finite: {graph.values[bad[0]]}")
    count = len(graph.values)
    for name, columns in _VARIABLES.items():
        table = getattr(graph, name)
        bad = np.flatnonzero(~np.isfinite(table).all(axis=1))
        if len(bad):
            named = " and ".join(
                graph.name(int(i)) if 0 <= i < count else f"variable {i}" for i in table[bad[0], :columns]
            )
            raise GraphError(f"{named}: a number of their {name} is not finite, row {bad[0]}")
        indices = table[:, :columns]
        if len(indices) and (indices.min() < 0 or indices.max() >= count):
            raise GraphError(f"{name}: a variable that the graph does not have, there are {count}")


def _check_anchoring(graph: Graph, free: BoolArray) -> None:
    """Every connected part needs something that is known: a fixed anchor or landmark, or a prior."""
    count = len(free)
    edges = [
        _variables(getattr(graph, table), columns)[:, [a, b]]
        for table, columns in _VARIABLES.items()
        for a in range(columns)
        for b in range(a)
    ]
    edges += [np.column_stack([graph.dense.variables[:-1], graph.dense.variables[1:]])]
    pairs = np.concatenate(edges)
    # A known variable holds its neighbours, but does not connect them.
    both = pairs[free[pairs].all(axis=1)]
    shape = (count, count)
    _, part = connected_components(coo_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=shape))
    held = np.zeros(count, dtype=np.bool_)
    half = pairs[free[pairs].any(axis=1) & ~free[pairs].all(axis=1)]
    held[part[np.where(free[half[:, 0]], half[:, 0], half[:, 1])]] = True
    held[part[_variables(graph.priors, 1)[:, 0]]] = True
    held[part[graph.dense.variables]] = True
    loose = np.flatnonzero(free & ~held[part])
    if len(loose):
        i = int(loose[0])
        others = int((part == part[i]).sum()) - 1
        raise GraphError(
            f"{graph.name(i)}: nothing holds it{f' and {others} others' * (others > 0)} in place, no prior "
            "and nothing known"
        )
