"""How much of a serial link our messages take; a link that is too slow delays every pose."""

import numpy as np
from pymavlink.dialects.v20 import all as mavlink2

from companion.config import Config
from companion.mavlink.contact import TIMESYNC_PERIOD_NS
from companion.mavlink.link import capacity
from companion.mavlink.profiles import PROFILES
from companion.mavlink.session import HEARTBEAT_PERIOD_NS
from drivers.mavlink_frames import MavlinkMessage
from estimators.messages import PoseEstimate

MOST = 0.7
"""Share of a link that may be planned for: requests, texts and parameters come on top."""
SIGNATURE = 13
OBSTACLE_RATE = 10.0


def bytes_per_second(config: Config) -> float:
    """What goes out at most while poses are sent, with ArduPilot's profile when it is not known [B/s]."""
    table = config.mavlink
    profile = PROFILES["ardupilot" if table.profile == "auto" else table.profile]
    # Zeros at the end of a message are not sent: nothing may be zero here.
    ones = np.ones(3)
    pose = PoseEstimate(1 << 60, np.ones((4, 4)), np.eye(6) + 1.0, 0, ones, np.eye(3) + 1.0)
    heartbeat = mavlink2.MAVLink_heartbeat_message(18, 8, 1, 1, 4, 3)
    timesync = mavlink2.MAVLink_timesync_message(1 << 62, 1 << 62)
    poses = sum(_size(message) for message in profile.messages(pose, 1.0, table, 255, 100))
    total = poses * config.pipeline.rate
    total += _size(heartbeat) * 1e9 / HEARTBEAT_PERIOD_NS
    # Our requests, and answers to as many.
    total += 2 * _size(timesync) * 1e9 / TIMESYNC_PERIOD_NS
    if table.obstacles:
        distances = [1] * 72
        obstacles = mavlink2.MAVLink_obstacle_distance_message(1 << 62, 0, distances, 5, 1, 1, 5.0, 1.0, 12)
        total += _size(obstacles) * OBSTACLE_RATE
    if table.signing_key:
        messages = config.pipeline.rate * (1 + table.speed) + 21 + OBSTACLE_RATE * table.obstacles
        total += SIGNATURE * messages
    return total


def budget_warning(config: Config) -> str:
    """One line when the autopilot's link is too slow for what is planned; empty when it is not."""
    table = config.mavlink
    carried = capacity(table.url, table.baud)
    needed = bytes_per_second(config)
    if carried is None or needed <= MOST * carried:
        return ""
    return (
        f"mavlink.url: {carried * 10:.0f} baud carry {carried:.0f} B/s, our messages take {needed:.0f} B/s "
        f"({needed / carried:.0%}, at most {MOST:.0%} are sane): raise the baud rate or lower pipeline.rate"
    )


def _size(message: MavlinkMessage) -> int:
    return len(message.pack(mavlink2.MAVLink(None)))
