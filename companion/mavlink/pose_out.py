"""A pose in the map as the autopilot wants it: NED, FRD, VISION_POSITION_ESTIMATE with covariance."""

from dataclasses import dataclass

import numpy as np
from pymavlink.dialects.v20 import common as mavlink2

from estimators.geometry import wrap_angle
from estimators.messages import FloatArray, PoseEstimate

_UPPER = np.triu_indices(6)


@dataclass(frozen=True, slots=True, eq=False)
class NedPose:
    """Pose of the body (forward, right, down) in north, east, down.

    Attributes:
        position: (3,) [m].
        roll_pitch_yaw: (3,) [rad], ZYX sequence.
        cov: (6, 6), of position and the three angles.
    """

    position: FloatArray
    roll_pitch_yaw: FloatArray
    cov: FloatArray


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
    c, s = np.cos(map_heading), np.sin(map_heading)
    R_ned_map = np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])
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
    )


def vision_position_estimate(
    estimate: PoseEstimate, map_heading: float
) -> mavlink2.MAVLink_vision_position_estimate_message | None:
    """The message, or None for a pose that holds anything not finite: no NaN leaves as a pose.

    `usec` is the time for which the pose holds, on the host's monotonic clock.

    Args:
        estimate: pose in the map.
        map_heading: compass heading of the map's x axis [rad].
    """
    if not (np.isfinite(estimate.T_map_body).all() and np.isfinite(estimate.cov).all()):
        return None
    ned = to_ned(estimate, map_heading)
    return mavlink2.MAVLink_vision_position_estimate_message(
        estimate.stamp_ns // 1000,
        *ned.position.tolist(),
        *ned.roll_pitch_yaw.tolist(),
        covariance=ned.cov[_UPPER].tolist(),
        reset_counter=estimate.reset_counter % 256,
    )


def ned_pose(message: mavlink2.MAVLink_vision_position_estimate_message) -> NedPose:
    """The pose that a VISION_POSITION_ESTIMATE carries, as the autopilot reads it."""
    cov: FloatArray = np.zeros((6, 6))
    cov[_UPPER] = message.covariance
    return NedPose(
        np.array([message.x, message.y, message.z]),
        np.array([message.roll, message.pitch, message.yaw]),
        cov + np.triu(cov, 1).T,
    )
