"""Factors that come one measurement at a time, as rows of `estimators.graph.factors`.

Of the variable of the instant at which they were measured the number is not known yet: it is -1.
"""

import numpy as np

from estimators.graph.factors import INCREMENT, RANGE
from estimators.graph.losses import GAUSSIAN
from estimators.kernels.compilation import INDICES, MATRIX, VECTOR, compiled
from estimators.messages import FloatArray, IntArray

_KIND, _SCALE = float(GAUSSIAN.kind), GAUSSIAN.scale


@compiled(f"{MATRIX}({INDICES}, {MATRIX}, {INDICES}, int64, float64, float64)")
def ranges(
    anchors: IntArray, reduced: FloatArray, codes: IntArray, least: int, arm_x: float, arm_y: float
) -> FloatArray:
    """Rows (M, 9) of those of N ranges in the plane that passed their gate.

    Args:
        anchors: (N,) variables.
        reduced: (N, 4) of `range_gate.reduce_heights`, with the sigmas of `range_gate.judge_together`.
        codes: (N,) verdicts of `range_gate`; those that pass are the first.
        least: the last that does.
        arm_x: tag antenna in the body frame [m].
        arm_y: likewise.
    """
    rows, count = np.zeros((len(codes), RANGE)), 0
    for k in range(len(codes)):
        if 0 <= codes[k] <= least:
            row = rows[count]
            row[0], row[1], row[2], row[3] = -1.0, anchors[k], reduced[k, 2], reduced[k, 3]
            row[4], row[5], row[7], row[8] = arm_x, arm_y, _KIND, _SCALE
            count += 1
    return rows[:count]


@compiled(f"{MATRIX}(int64, {VECTOR}, {MATRIX})")
def increment(first: int, measured: FloatArray, cov: FloatArray) -> FloatArray:
    """Row (1, 17) of the motion since a pose.

    Args:
        first: variable of that pose.
        measured: (3,) x [m], y [m], yaw [rad] in the body frame there.
        cov: (3, 3) of the same.
    """
    row = np.empty((1, INCREMENT))
    row[0, 0], row[0, 1], row[0, 2:5] = first, -1.0, measured
    row[0, 5:14] = np.linalg.inv(cov).ravel()
    row[0, 14], row[0, 15], row[0, 16] = _KIND, _SCALE, 1.0
    return row
