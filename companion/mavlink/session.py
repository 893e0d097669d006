"""What we say to the autopilot, and when: heartbeat and poses. Free of I/O: bytes in, bytes out."""

from pymavlink.dialects.v20 import common as mavlink2

from companion.config import MavlinkTable
from companion.health import Health, State
from companion.mavlink.pose_out import vision_position_estimate
from estimators.messages import PoseEstimate

HEARTBEAT_PERIOD_NS = 1_000_000_000
LEAST_SPACING_NS = 20_000_000
"""ArduPilot's EKF3 drops samples that follow each other more closely than this."""
_STATUS = {
    State.STARTING: mavlink2.MAV_STATE_BOOT,
    State.OK: mavlink2.MAV_STATE_ACTIVE,
    State.DEGRADED: mavlink2.MAV_STATE_ACTIVE,
    State.LOST: mavlink2.MAV_STATE_CRITICAL,
}


class MavlinkSession:
    """Packs our messages in MAVLink 2 with the autopilot's system id.

    Args:
        table: ids.
        map_heading: compass heading of the map's x axis [rad].
    """

    def __init__(self, table: MavlinkTable, map_heading: float) -> None:
        self._map_heading = map_heading
        self._packer = mavlink2.MAVLink(None, srcSystem=table.system_id, srcComponent=table.component_id)
        self._parser = mavlink2.MAVLink(None)
        self._parser.robust_parsing = True
        self._heartbeat_due_ns = 0
        self._pose_ns: int | None = None
        self.autopilot: int | None = None
        """System id of the autopilot, once it was heard."""
        self.poses_packed = 0

    def receive(self, data: bytes) -> None:
        """Take bytes from the link; our system id follows the first autopilot heard."""
        if self.autopilot is not None:
            return
        for message in self._parser.parse_buffer(data) or []:
            if (
                message.get_type() == "HEARTBEAT"
                and message.get_srcComponent() == mavlink2.MAV_COMP_ID_AUTOPILOT1
                and message.autopilot != mavlink2.MAV_AUTOPILOT_INVALID
            ):
                self.autopilot = message.get_srcSystem()
                self._packer.srcSystem = self.autopilot
                return

    def tick(self, pose: PoseEstimate | None, health: Health, now_ns: int) -> bytes:
        """Bytes to send at `now_ns`: a heartbeat when it is due, the pose when it may be sent."""
        out = b""
        overdue = now_ns - self._heartbeat_due_ns
        if overdue >= 0:
            # Counted from when it was due, so that ticks of 33 ms still make 1 Hz.
            base = self._heartbeat_due_ns if overdue < HEARTBEAT_PERIOD_NS else now_ns
            self._heartbeat_due_ns = base + HEARTBEAT_PERIOD_NS
            out += self._heartbeat(health)
        spaced = self._pose_ns is None or now_ns - self._pose_ns >= LEAST_SPACING_NS
        if pose is not None and health.sends and spaced:
            message = vision_position_estimate(pose, self._map_heading)
            if message is not None:
                self._pose_ns = now_ns
                self.poses_packed += 1
                out += self._pack(message)
        return out

    def _heartbeat(self, health: Health) -> bytes:
        return self._pack(
            mavlink2.MAVLink_heartbeat_message(
                mavlink2.MAV_TYPE_ONBOARD_CONTROLLER,
                mavlink2.MAV_AUTOPILOT_INVALID,
                0,
                0,
                _STATUS[health.state],
                3,
            )
        )

    def _pack(self, message: mavlink2.MAVLink_message) -> bytes:
        packed = bytes(message.pack(self._packer))
        self._packer.seq = (self._packer.seq + 1) % 256
        return packed
