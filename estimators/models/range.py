"""UWB range from a planar robot to an anchor: time of flight, height reduction, value, Jacobian, sigma."""

from math import cos, hypot, isfinite, sin, sqrt

import numpy as np

from estimators.messages import FloatArray

SPEED_OF_LIGHT = 299_792_458.0
"""[m/s]."""
MIN_HORIZONTAL_RANGE = 0.05
"""Below this [m] the tag stands under the anchor: the horizontal range has no usable direction."""
NOWHERE = 1e-9
"""Least distance [m] that a direction is computed with."""


def two_way_range(
    sent: FloatArray, received: FloatArray, tag_delay: FloatArray, anchor_delay: FloatArray
) -> FloatArray:
    """Distances from the times of messages and their answers, all arrays of one shape.

    A LinkTrack module does this itself and reports distances; a delay that it has wrong by 1 ns is a bias of
    15 cm in every range of that anchor.

    Args:
        sent: when the tag sent, on its clock [s].
        received: when it received the answer, on the same clock [s].
        tag_delay: what it spends on sending and receiving [s].
        anchor_delay: what the anchor spends between receiving and answering [s].

    Returns:
        Slant ranges [m], with whatever blocked signals are late by.

    Source: huang2024 Eq. (1); the excess of a blocked signal, Eq. (2), remains in it.
    """
    distance: FloatArray = 0.5 * SPEED_OF_LIGHT * (received - sent - tag_delay - anchor_delay)
    return distance


def reduce_height(slant: float, sigma: float, height_difference: float) -> tuple[float, float] | None:
    """Horizontal distance from tag to anchor and its standard deviation.

    Args:
        slant: measured distance [m].
        sigma: its standard deviation [m].
        height_difference: anchor height minus tag height [m].

    Returns:
        Horizontal range [m] and sigma [m]; None when the slant range is shorter than the height
        difference (negative radicand), not finite, or too near the vertical to say anything.

    Source: huang2024 Eq. (3); sigma by first-order propagation, ``sigma_r = sigma_d d / r``.
    """
    square = slant * slant - height_difference * height_difference
    if not isfinite(square) or slant <= 0.0 or square < MIN_HORIZONTAL_RANGE**2:
        return None
    horizontal = sqrt(square)
    return horizontal, sigma * slant / horizontal


def horizontal_range(
    pose: FloatArray, anchor: FloatArray | tuple[float, float], lever_arm: FloatArray
) -> tuple[float, FloatArray]:
    """Predicted horizontal range and its Jacobian.

    Args:
        pose: (3,) x [m], y [m], yaw [rad] of the body in the map.
        anchor: (2,) or (3,) position in the map [m]; only x and y are used.
        lever_arm: (2,) or (3,) tag antenna in the body frame [m]; only x and y are used.

    Returns:
        Range [m] and its derivative by (x, y, yaw), (3,).

    Source: chen2019 Eq. (5)-(20), measurement model chosen here, with a lever arm.
    """
    c, s = cos(pose[2]), sin(pose[2])
    arm_x = c * lever_arm[0] - s * lever_arm[1]
    arm_y = s * lever_arm[0] + c * lever_arm[1]
    dx = pose[0] + arm_x - anchor[0]
    dy = pose[1] + arm_y - anchor[1]
    distance = max(hypot(dx, dy), NOWHERE)
    ux, uy = dx / distance, dy / distance
    return distance, np.array([ux, uy, uy * arm_x - ux * arm_y])


def slant_range(
    pose: FloatArray, anchor: FloatArray, lever_arm: FloatArray, height: float
) -> tuple[float, FloatArray, FloatArray]:
    """Predicted slant range and its Jacobians, for anchors whose place or bias is to be found.

    Args:
        pose: (3,) x [m], y [m], yaw [rad] of the body in the map.
        anchor: (3,) x [m], y [m] in the map and bias of its ranges [m].
        lever_arm: (2,) or (3,) tag antenna in the body frame [m]; only x and y are used.
        height: of the anchor above the tag [m].

    Returns:
        Range [m]; its derivatives by the pose, (3,), and by the anchor, (3,).

    Source: huang2024 Eq. (2)-(3), without reduction to the plane: a bias belongs to the slant range.
    """
    horizontal, by_pose = horizontal_range(pose, anchor, lever_arm)
    slant = hypot(horizontal, height)
    by_pose = by_pose * (horizontal / slant)
    return slant + float(anchor[2]), by_pose, np.array([-by_pose[0], -by_pose[1], 1.0])
