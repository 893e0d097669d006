"""A pose in the map as the autopilot wants it: north, east, down; forward, right, down."""

import numpy as np
from scipy.spatial.transform import Rotation

from estimators.geometry import wrap_angle
from estimators.immutable import immutable
from estimators.messages import FloatArray, PoseEstimate

METRES_PER_DEGREE = 111_319.5
"""Length of a degree of latitude, and of one of longitude at the equator."""


@immutable
class NedPose:
    """Pose of the body (forward, right, down) in north, east, down.

    Attributes:
        position: (3,) [m].
        roll_pitch_yaw: (3,) [rad], ZYX sequence.
        cov: (6, 6), of position and the three angles.
        velocity: (3,) [m/s], or None.
        velocity_cov: (3, 3), or None.
    """

    position: FloatArray
    roll_pitch_yaw: FloatArray
    cov: FloatArray
    velocity: FloatArray | None = None
    velocity_cov: FloatArray | None = None

    @property
    def rotation(self) -> FloatArray:
        """Rotation (3, 3) of the body, forward-right-down, in north-east-down."""
        return Rotation.from_euler("ZYX", self.roll_pitch_yaw[::-1]).as_matrix()


def to_ned(estimate: PoseEstimate, map_heading: float) -> NedPose:
    """Convert a map/FLU pose to NED/FRD.

    With the map's x axis at compass heading h, north = x cos h + y sin h and east = x sin h - y cos h.
    ``R_ned_map = Rz(h) diag(1, -1, -1)`` and ``R_flu_frd = diag(1, -1, -1)``, so the angles of the ZYX
    sequence become exactly roll, -pitch, h - yaw.

    Args:
        estimate: pose in the map.
        map_heading: compass heading of the map's x axis [rad], clockwise from north.

    Source: README, frame table.
    """
    R_ned_map = ned_from_map(map_heading)
    R = estimate.T_map_body[:3, :3]
    roll = np.arctan2(R[2, 1], R[2, 2])
    pitch = np.arcsin(np.clip(-R[2, 0], -1.0, 1.0))
    yaw = wrap_angle(map_heading - estimate.yaw)
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = R_ned_map
    jacobian[3:, 3:] = np.diag([1.0, -1.0, -1.0])
    return NedPose(
        position=R_ned_map @ estimate.T_map_body[:3, 3],
        roll_pitch_yaw=np.array([roll, -pitch, yaw]),
        cov=jacobian @ estimate.cov @ jacobian.T,
        velocity=None if estimate.velocity is None else R_ned_map @ estimate.velocity,
        velocity_cov=(
            None if estimate.velocity_cov is None else R_ned_map @ estimate.velocity_cov @ R_ned_map.T
        ),
    )


def ned_from_map(map_heading: float) -> FloatArray:
    """`R_ned_map`, (3, 3), of a map whose x axis has this compass heading [rad]."""
    c, s = np.cos(map_heading), np.sin(map_heading)
    return np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])
