"""Planar rigid motions as (x, y, yaw) vectors, and their lift to 4x4 transforms.

`T_a_b` written as a vector takes coordinates of frame b to frame a: ``p_a = R(yaw) p_b + (x, y)``.
Conventions follow the README's frame table: right-handed, z up, angles counter-clockwise.
"""

from math import cos, pi, remainder, sin, tau

import numpy as np

from estimators.messages import FloatArray


def wrap_angle(angle: float) -> float:
    """Angle [rad] brought into [-pi, pi]."""
    return remainder(angle, tau)


def wrap_angles(angles: FloatArray) -> FloatArray:
    """Angles (N,) [rad] brought into [-pi, pi)."""
    return (angles + pi) % tau - pi


def rotation(yaw: float) -> FloatArray:
    """Rotation matrix `R_a_b`, (2, 2), of frame b turned by `yaw` [rad] against frame a."""
    c, s = cos(yaw), sin(yaw)
    return np.array([[c, -s], [s, c]])


def compose(T_a_b: FloatArray, T_b_c: FloatArray) -> FloatArray:
    """`T_a_c` of two planar motions, all (3,) of x [m], y [m], yaw [rad]."""
    c, s = cos(T_a_b[2]), sin(T_a_b[2])
    return np.array(
        [
            T_a_b[0] + c * T_b_c[0] - s * T_b_c[1],
            T_a_b[1] + s * T_b_c[0] + c * T_b_c[1],
            wrap_angle(T_a_b[2] + T_b_c[2]),
        ]
    )


def inverse(T_a_b: FloatArray) -> FloatArray:
    """`T_b_a`, (3,)."""
    c, s = cos(T_a_b[2]), sin(T_a_b[2])
    return np.array(
        [-c * T_a_b[0] - s * T_a_b[1], s * T_a_b[0] - c * T_a_b[1], wrap_angle(-T_a_b[2])],
    )


def between(T_w_a: FloatArray, T_w_b: FloatArray) -> FloatArray:
    """`T_a_b`: pose b seen from pose a, (3,)."""
    return compose(inverse(T_w_a), T_w_b)


def exponential(twist: FloatArray) -> FloatArray:
    """Motion of a body that keeps a velocity in its own frame for one second.

    Args:
        twist: (3,) forward, left [m/s], counter-clockwise [rad/s].

    Returns:
        (3,) pose at the end, seen from the beginning.

    Source: Sola et al., A micro Lie theory for state estimation in robotics, Eq. (156)-(158).
    """
    along, across = _arc(twist[2])
    return np.array(
        [
            along * twist[0] - across * twist[1],
            across * twist[0] + along * twist[1],
            wrap_angle(twist[2]),
        ]
    )


def logarithm(T_a_b: FloatArray) -> FloatArray:
    """Velocity that `exponential` turns into this motion, (3,), turning by less than half a turn."""
    along, across = _arc(T_a_b[2])
    scale = 1.0 / (along * along + across * across)
    return np.array(
        [
            scale * (along * T_a_b[0] + across * T_a_b[1]),
            scale * (along * T_a_b[1] - across * T_a_b[0]),
            T_a_b[2],
        ]
    )


def _arc(yaw: float) -> tuple[float, float]:
    """Chord of an arc of unit length, along and across its first direction."""
    if abs(yaw) < 1e-6:
        return 1.0, yaw / 2.0
    return sin(yaw) / yaw, (1.0 - cos(yaw)) / yaw


def transform(T_a_b: FloatArray, points_b: FloatArray) -> FloatArray:
    """Points (N, 2) of frame b in frame a."""
    return points_b @ rotation(T_a_b[2]).T + T_a_b[:2]


def transform_each(T_a_b: FloatArray, points_b: FloatArray) -> FloatArray:
    """Points in frame a, (N, 2), each by its own pose (N, 3); one point (1, 2) goes through all of them."""
    c, s = np.cos(T_a_b[:, 2]), np.sin(T_a_b[:, 2])
    x, y = points_b.T
    return np.column_stack([T_a_b[:, 0] + c * x - s * y, T_a_b[:, 1] + s * x + c * y])


def lift(planar: FloatArray, z: float) -> FloatArray:
    """4x4 transform of a level body at (x, y, yaw) and height `z` [m]."""
    x, y, yaw = planar.tolist()
    c, s = cos(yaw), sin(yaw)
    return np.array([[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]])
