"""When a correction is a jump that `PoseEstimate.reset_counter` counts, as it does poses set from outside."""

from math import radians

import numpy as np

from estimators import chi2
from estimators.geometry import wrap_angle
from estimators.messages import FloatArray

_LIMIT = float(chi2.ppf(1.0 - 1e-6, 3))
"""What a covariance explains of a correction, but for one in a million."""
_LEAST, _LEAST_TURN = 0.05, radians(2.0)
"""Corrections below these [m, rad] are no jump, however sure the estimate was."""


def is_jump(before: FloatArray, cov: FloatArray, after: FloatArray) -> bool:
    """Whether an estimate moved farther than it said that it could be off.

    An autopilot that fuses poses must be told of such a step, or takes it for motion.

    Args:
        before: (3,) x [m], y [m], yaw [rad] given out, or predicted, for an instant.
        cov: (3, 3) its covariance then.
        after: (3,) the same pose now that more is known.
    """
    dx, dy, turn = (after - before).tolist()
    turn = wrap_angle(turn)
    if abs(dx) <= _LEAST and abs(dy) <= _LEAST and abs(turn) <= _LEAST_TURN:
        return False
    step = np.array([dx, dy, turn])
    return bool(step @ np.linalg.solve(cov, step) > _LIMIT)
