"""How a track is moved onto the truth before its trajectory error is taken.

Source: Zhang and Scaramuzza, "A Tutorial on Quantitative Trajectory Evaluation for Visual(-Inertial)
Odometry", IROS 2018.
"""

from enum import StrEnum


class Alignment(StrEnum):
    """How a track is moved onto the truth before its trajectory error is taken."""

    NONE = "none"
    """Not at all: the track claims to be in the map's frame."""
    FIRST_POSE = "yaw+translation"
    """Yaw and translation of the first pose: what odometry without a known start deserves."""
    SE2 = "se2"
    """Yaw and translation that fit all positions best (on a floor also the 4-DOF alignment of VIO)."""
