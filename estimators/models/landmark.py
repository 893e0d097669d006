"""Range and bearing from a planar robot to a known landmark: value and Jacobian."""

from math import atan2, hypot

import numpy as np

from estimators.geometry import wrap_angle
from estimators.messages import FloatArray


def range_and_bearing(pose: FloatArray, landmark: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Predicted range and bearing and their Jacobian.

    Args:
        pose: (3,) x [m], y [m], yaw [rad] of the body in the map.
        landmark: (2,) position in the map [m].

    Returns:
        (2,) range [m] and bearing [rad] in the body frame, within [-pi, pi]; their derivative by
        (x, y, yaw), (2, 3).

    Source: Thrun, Burgard and Fox, Probabilistic Robotics, 6.6, range and bearing of a known feature.
    """
    dx, dy = landmark[0] - pose[0], landmark[1] - pose[1]
    distance = max(hypot(dx, dy), 1e-9)
    ux, uy = dx / distance, dy / distance
    value = np.array([distance, wrap_angle(atan2(dy, dx) - pose[2])])
    by_pose = np.array([[-ux, -uy, 0.0], [uy / distance, -ux / distance, -1.0]])
    return value, by_pose
