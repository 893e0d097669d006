"""Derivatives by central differences: the reference for hand-written Jacobians."""

from collections.abc import Callable

import numpy as np

from estimators.messages import FloatArray

STEP = 1e-6


def numerical_jacobian(
    function: Callable[[FloatArray], FloatArray], at: FloatArray, angle_rows: tuple[int, ...] = ()
) -> FloatArray:
    """Derivative (M, N) of a function R^N -> R^M; differences of `angle_rows` are taken as angles."""
    columns = []
    for i in range(len(at)):
        step = np.zeros(len(at))
        step[i] = STEP
        difference = function(at + step) - function(at - step)
        for row in angle_rows:
            difference[row] = np.angle(np.exp(1j * difference[row]))
        columns.append(difference / (2 * STEP))
    return np.column_stack(columns)
