"""Angles, sums and small matrices, for use inside kernels."""

from math import floor, pi, sqrt, tau

import numpy as np

from estimators.kernels.compilation import inlined
from estimators.messages import FloatArray


@inlined
def wrapped(angle: float) -> float:
    """Angle [rad] brought into [-pi, pi)."""
    return angle - tau * floor((angle + pi) / tau)


@inlined
def weighted_product(a: FloatArray, b: FloatArray, weights: FloatArray) -> float:
    """Sum of a (N,) times b (N,) with weights (N,)."""
    total = 0.0
    for i in range(len(weights)):
        total += weights[i] * a[i] * b[i]
    return total


@inlined
def cholesky(matrix: FloatArray) -> FloatArray:
    """Lower triangular root of a matrix that is positive definite, but for rounding."""
    root = np.zeros_like(matrix)
    for i in range(len(matrix)):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= root[i, k] * root[j, k]
            if i == j:
                root[i, i] = sqrt(max(rest, 1e-14 * matrix[i, i]))
            else:
                root[i, j] = rest / root[j, j]
    return root


@inlined
def solve_lower(root: FloatArray, right: FloatArray) -> FloatArray:
    """Solution x of ``root x = right`` for a lower triangular root."""
    x = np.empty_like(right)
    for i in range(len(right)):
        rest = right[i]
        for j in range(i):
            rest -= root[i, j] * x[j]
        x[i] = rest / root[i, i]
    return x


@inlined
def solve_upper(root: FloatArray, right: FloatArray) -> FloatArray:
    """Solution x of ``root.T x = right`` for a lower triangular root."""
    x = np.empty_like(right)
    for i in range(len(right) - 1, -1, -1):
        rest = right[i]
        for j in range(i + 1, len(right)):
            rest -= root[j, i] * x[j]
        x[i] = rest / root[i, i]
    return x
