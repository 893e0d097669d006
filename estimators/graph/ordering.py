"""In which order variables are eliminated: any gives the same solution, not in the same time."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from estimators.kernels.block_cholesky import pattern
from estimators.kernels.factors import GraphArrays, connected_pairs, last_use
from estimators.messages import IntArray

_SLIM = 30.0
"""Products of blocks a column below which no other order is looked for; a chain with velocities has 16."""


def elimination_order(graph: GraphArrays) -> tuple[IntArray, int]:
    """Place of every variable in the order of elimination.

    At first each variable goes when the last factor on it has come, as in a filter: for chains, with
    landmarks that pass by, nothing is better. Where that leaves many open ends (loop closures), it is
    compared with the order of minimum degree.

    Args:
        graph: as the kernels take it.

    Returns:
        (V,) places, -1 for a variable without anything free; number of the others.

    Source: minimum degree: Liu, ACM Trans. Mathematical Software 11(2), 1985, in SuperLU.
    """
    solved = np.flatnonzero(graph[0].any(axis=1))
    by_time = solved[np.argsort(last_use(graph)[solved], kind="stable")]
    order = _places(by_time, len(graph[0]))
    count = len(solved)
    pairs = connected_pairs(graph, order)
    effort = _effort(count, pairs)
    if effort > _SLIM * count:
        by_degree = _places(by_time[np.argsort(_minimum_degree(count, pairs))], len(graph[0]))
        if _effort(count, connected_pairs(graph, by_degree)) < effort:
            return by_degree, count
    return order, count


def _places(sequence: IntArray, count: int) -> IntArray:
    order = np.full(count, -1, dtype=np.int64)
    order[sequence] = np.arange(len(sequence))
    return order


def _effort(count: int, pairs: IntArray) -> float:
    """Products of blocks that a factorisation takes."""
    starts, _ = pattern(count, pairs)
    sizes = np.diff(starts).astype(np.float64)
    return float((sizes * (sizes + 1.0)).sum())


def _minimum_degree(count: int, pairs: IntArray) -> IntArray:
    pairs = pairs[pairs[:, 0] >= 0]
    ones = np.full(len(pairs), -1.0)
    edges = coo_array((ones, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    degree = np.bincount(pairs.ravel(), minlength=count) + 1.0
    dominant = coo_array((degree, (np.arange(count), np.arange(count))), shape=(count, count))
    factor = splu(
        (edges + edges.T + dominant).tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    return np.asarray(factor.perm_c, dtype=np.int64)
