"""An autopilot that listens: HEARTBEAT out, everything we send parsed by pymavlink's own parser."""

import numpy as np
from pymavlink.dialects.v20 import all as mavlink2

from companion.mavlink.pose_out import NedPose
from companion.mavlink.profiles import UPPER
from estimators.messages import FloatArray

SYSTEM_ID = 7
"""Not 1, so that taking over the autopilot's system id shows."""
_PERIOD_NS = 1_000_000_000


class EmulatedAutopilot:
    """The far side of the MAVLink link; free of I/O like the other devices."""

    def __init__(self) -> None:
        self._packer = mavlink2.MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=1)
        self._parser = mavlink2.MAVLink(None)
        self._next_ns = 0
        self.poses: list[tuple[int, NedPose]] = []
        """Received poses with their `usec` stamp."""
        self.heartbeats = 0
        """Heartbeats received from our component as the protocol asks for them."""

    def poll(self, now_ns: int) -> bytes:
        """Heartbeat when it is due."""
        if now_ns < self._next_ns:
            return b""
        self._next_ns = now_ns + _PERIOD_NS
        message = mavlink2.MAVLink_heartbeat_message(
            mavlink2.MAV_TYPE_QUADROTOR,
            mavlink2.MAV_AUTOPILOT_ARDUPILOTMEGA,
            0,
            0,
            mavlink2.MAV_STATE_STANDBY,
            3,
        )
        return bytes(message.pack(self._packer))

    def feed(self, data: bytes) -> None:
        """Take bytes from the companion."""
        for message in self._parser.parse_buffer(data) or []:
            if message.get_type() == "VISION_POSITION_ESTIMATE":
                self.poses.append((message.usec, ned_pose(message)))
            elif message.get_type() == "HEARTBEAT":
                self.heartbeats += (
                    message.type == mavlink2.MAV_TYPE_ONBOARD_CONTROLLER
                    and message.autopilot == mavlink2.MAV_AUTOPILOT_INVALID
                )


def ned_pose(message: mavlink2.MAVLink_vision_position_estimate_message) -> NedPose:
    """The pose that a VISION_POSITION_ESTIMATE carries, as the autopilot reads it."""
    cov: FloatArray = np.zeros((6, 6))
    cov[UPPER] = message.covariance
    return NedPose(
        np.array([message.x, message.y, message.z]),
        np.array([message.roll, message.pitch, message.yaw]),
        cov + np.triu(cov, 1).T,
    )
