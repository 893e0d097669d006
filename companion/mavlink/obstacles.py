"""Scans as OBSTACLE_DISTANCE: the nearest return in each of 72 sectors round the robot.

Source: MAVLink common.xml, OBSTACLE_DISTANCE.
"""

import numpy as np
from pymavlink.dialects.v20 import all as mavlink2

from drivers.mavlink_frames import MavlinkMessage
from estimators.geometry import transform
from estimators.messages import FloatArray, Scan

COMPONENT = mavlink2.MAV_COMP_ID_OBSTACLE_AVOIDANCE
"""ArduPilot takes obstacles of this component."""
SECTORS = 72
LEAST_PERIOD_NS = 90_000_000
"""At 10 Hz, with scans that come a little early."""
UNKNOWN = 65_535
MIN_RANGE = 0.05
"""What an RPLIDAR sees nearer than that is itself [m]."""
_LONGEST_CM = 65_000


def obstacle_distance(scan: Scan, T_body_lidar: FloatArray, max_range: float) -> MavlinkMessage:
    """Message of one scan, in body axes: sector 0 is ahead, they go round clockwise.

    A sector whose beams all came back empty is free as far as the LiDAR sees; one without beams is unknown.

    Args:
        scan: one revolution.
        T_body_lidar: (3,) x [m], y [m], yaw [rad] of the LiDAR in the body frame.
        max_range: of the LiDAR [m].
    """
    points = scan.ranges[:, None] * np.column_stack([np.cos(scan.angles), np.sin(scan.angles)])
    returned = (scan.ranges >= MIN_RANGE) & (scan.ranges <= max_range)
    points = transform(T_body_lidar, points)
    # A beam without return is where it looks; one with return is where it hit.
    bearings = np.where(returned, np.arctan2(points[:, 1], points[:, 0]), scan.angles + T_body_lidar[2])
    width = 2.0 * np.pi / SECTORS
    sectors = np.rint(-bearings / width).astype(np.int64) % SECTORS
    longest = min(round(max_range * 100.0), _LONGEST_CM)
    nearest = np.full(SECTORS, UNKNOWN, dtype=np.int64)
    nearest[sectors[~returned]] = longest + 1
    distances = np.rint(np.hypot(points[:, 0], points[:, 1])[returned] * 100.0).astype(np.int64)
    np.minimum.at(nearest, sectors[returned], np.minimum(distances, longest))
    return mavlink2.MAVLink_obstacle_distance_message(
        scan.end_stamp_ns // 1000,
        mavlink2.MAV_DISTANCE_SENSOR_LASER,
        nearest.tolist(),
        0,
        round(MIN_RANGE * 100.0),
        longest,
        360.0 / SECTORS,
        0.0,
        mavlink2.MAV_FRAME_BODY_FRD,
    )
