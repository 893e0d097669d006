"""Whether the numbers of a pose can be meant at all."""

from math import sqrt

import numpy as np

from estimators.kernels.compilation import MATRIX, compiled
from estimators.messages import FloatArray

SOUND, NOT_FINITE, NOT_DEFINITE = range(3)


@compiled(f"int64({MATRIX}, {MATRIX}, int64)")
def soundness(transform: FloatArray, cov: FloatArray, used: int) -> int:
    """What is wrong with a pose: `SOUND`, `NOT_FINITE` or `NOT_DEFINITE`.

    Args:
        transform: (4, 4).
        cov: (N, N), symmetric.
        used: so many of its rows and columns, the first, are looked at.
    """
    if not (np.isfinite(transform).all() and np.isfinite(cov[:used, :used]).all()):
        return NOT_FINITE
    # Positive definite, if the pivots of its Cholesky factor are positive.
    root = np.empty((used, used))
    for i in range(used):
        for j in range(i + 1):
            rest = cov[i, j]
            for k in range(j):
                rest -= root[i, k] * root[j, k]
            if i > j:
                root[i, j] = rest / root[j, j]
            elif rest > 0.0:
                root[i, i] = sqrt(rest)
            else:
                return NOT_DEFINITE
    return SOUND
