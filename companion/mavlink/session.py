"""What we say on MAVLink, and when, and what we make of what we hear. Free of I/O: bytes in, bytes out."""

from collections import Counter

from pymavlink.dialects.v20 import all as mavlink2

from companion.config import Config, config_from_toml
from companion.health import Health, State
from companion.mavlink import obstacles
from companion.mavlink.alignment import CompassAlignment
from companion.mavlink.announcer import Announcer
from companion.mavlink.contact import AutopilotContact, Watch
from companion.mavlink.endpoint import Endpoint
from companion.mavlink.gate import Decision, SendGate
from companion.mavlink.link import GROUND, NAME, capacity
from companion.mavlink.parameters import Parameter, ParameterServer, setting_line
from companion.mavlink.profiles import Profile, profile_of
from companion.mavlink.ranging import RangingBeacons
from companion.mavlink.signing import SigningClock
from drivers.autopilot_clock import AutopilotClock
from drivers.mavlink_frames import AutopilotIdentity, MavlinkMessage
from estimators.base import Report
from estimators.messages import Measurement, PoseEstimate, RangeFrame, Scan

HEARTBEAT_PERIOD_NS = 1_000_000_000
NETWORK_CAPACITY = 200_000.0
"""Bytes a second that a network link is taken to carry."""
QUALITY = {State.OK: 100, State.DEGRADED: 50}
"""Of ODOMETRY [%]."""
_STATUS = {
    State.STARTING: mavlink2.MAV_STATE_BOOT,
    State.OK: mavlink2.MAV_STATE_ACTIVE,
    State.DEGRADED: mavlink2.MAV_STATE_ACTIVE,
    State.LOST: mavlink2.MAV_STATE_CRITICAL,
}
_CAPABILITIES = (
    mavlink2.MAV_PROTOCOL_CAPABILITY_MAVLINK2 | mavlink2.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
)


class MavlinkSession:
    """Our component beside the autopilot, on its link and on that of a ground station.

    Args:
        config: of the site.
        key: to sign with, or None.
        signing_clock: gives the signatures their timestamps; needed with a key.
        watch: who else wants to hear the autopilot.

    Attributes:
        config: with the parameters that a ground station has set and that count at once.
        poses_packed: poses given to the link.
        refused: messages of strangers, by system id.
    """

    def __init__(
        self,
        config: Config,
        key: bytes | None = None,
        signing_clock: SigningClock | None = None,
        watch: Watch | None = None,
    ) -> None:
        self.config = config
        self._contact = AutopilotContact(config, watch)
        self._changes: list[tuple[Parameter, Config]] = []
        table = config.mavlink
        timestamp = signing_clock.now if signing_clock is not None else None
        names = [NAME, GROUND] if table.ground_url else [NAME]
        self.endpoints = {
            name: Endpoint(table.component_id, i, key, timestamp) for i, name in enumerate(names)
        }
        self.poses_packed = 0
        self.refused: Counter[int] = Counter()
        self._gate = SendGate(table.gate, table.heading)
        self._announcer = Announcer()
        self._parameters = ParameterServer(config, self._parameter_set, self._begin_alignment)
        self._lists_to = NAME
        urls = {NAME: table.url, GROUND: table.ground_url}
        self._capacities = {
            name: capacity(urls[name], table.baud) or NETWORK_CAPACITY for name in self.endpoints
        }
        self._beacons = RangingBeacons(config) if table.raw_ranges else None
        self._obstacles_ns: int | None = None
        self._alignment = CompassAlignment()
        self._pose: PoseEstimate | None = None
        self._now_ns = self._heartbeat_due_ns = 0
        self._sent: tuple[int, int] | None = None

    @property
    def identity(self) -> AutopilotIdentity:
        """The autopilot, as far as it was heard."""
        return self._contact.identity

    @property
    def clock(self) -> AutopilotClock:
        """The autopilot's."""
        return self._contact.clock

    @property
    def autopilot(self) -> int | None:
        """System id of the autopilot, once it was heard."""
        return self.identity.system

    @property
    def profile(self) -> Profile | None:
        """How the autopilot wants its poses; None while that is not known."""
        kind = self.identity.kind if self.autopilot is not None else None
        return profile_of(self.config.mavlink, kind)

    @property
    def map_heading(self) -> float | None:
        """Compass heading of the map's x axis [rad]; None before it was aligned."""
        return (
            self._alignment.heading if self.config.mavlink.align == "compass" else self.config.map_heading()
        )

    def receive(self, name: str, data: bytes, arrival_ns: int, now_ns: int) -> None:
        """Take bytes from a link and put the answers into what goes out.

        Args:
            name: of the link.
            data: bytes.
            arrival_ns: when they came.
            now_ns: time now; later than that when much had to be done before.
        """
        self._now_ns = now_ns
        endpoint = self.endpoints[name]
        for message in endpoint.parser.feed(data):
            if name == NAME:
                self.identity.hear(message, arrival_ns)
            sender = message.get_srcSystem(), message.get_srcComponent()
            is_autopilots = name == NAME and sender[0] == self.autopilot
            if sender == (self._system, endpoint.component):
                continue
            if not is_autopilots and sender[0] not in self.config.mavlink.ground_ids:
                self.refused[sender[0]] += 1
                continue
            if is_autopilots and sender[1] == mavlink2.MAV_COMP_ID_AUTOPILOT1:
                self._hear_autopilot(message, arrival_ns)
            target = getattr(message, "target_system", None), getattr(message, "target_component", 0)
            if target[0] in (0, self._system) and target[1] in (0, endpoint.component):
                self._answer(name, message)
            # What is for everybody is for the others, too.
            if self.config.mavlink.forward and target != (self._system, endpoint.component):
                for other in self.endpoints.keys() - {name}:
                    self.endpoints[other].forward(message)

    def observe(self, measurement: Measurement, report: Report) -> None:
        """Take a measurement, and what the estimator made of it, for what is sent besides the pose."""
        table = self.config.mavlink
        if isinstance(measurement, Scan) and table.obstacles:
            end_ns = measurement.end_stamp_ns
            if self._obstacles_ns is None or end_ns - self._obstacles_ns >= obstacles.LEAST_PERIOD_NS:
                self._obstacles_ns = end_ns
                message = obstacles.obstacle_distance(
                    measurement, self.config.lidar_mounting(), table.obstacle_range
                )
                self.endpoints[NAME].send(message, self._system, obstacles.COMPONENT)
        if isinstance(measurement, RangeFrame) and self._beacons is not None and self.autopilot is not None:
            for message in self._beacons.messages(measurement, report, self.autopilot):
                self._send(NAME, message)

    def tick(self, pose: PoseEstimate | None, health: Health, now_ns: int, is_late: bool = False) -> None:
        """Put into what goes out what is due at `now_ns`: the pose when it may be sent, and all the rest.

        Args:
            pose: newest; None when there is none.
            health: judgement of it.
            now_ns: time.
            is_late: the pose was computed too late to be sent; that says nothing against the next.
        """
        dt, self._now_ns = (now_ns - self._now_ns) * 1e-9, now_ns
        self._pose = pose if health.sends else None
        decision = self._gate.judge(pose, health, now_ns)
        if pose is not None and decision.sends and not is_late:
            self._send_pose(pose, health, decision)
        overdue = now_ns - self._heartbeat_due_ns
        if overdue >= 0:
            # Counted from when it was due, so that ticks of 33 ms still make 1 Hz.
            base = self._heartbeat_due_ns if overdue < HEARTBEAT_PERIOD_NS else now_ns
            self._heartbeat_due_ns = base + HEARTBEAT_PERIOD_NS
            self._send_all(_heartbeat(health, decision))
        for message in self._contact.poll(now_ns):
            self._send(NAME, message)
        for text in self._contact.take_news():
            self._announcer.say(mavlink2.MAV_SEVERITY_WARNING, text)
        for message in self._announcer.poll(health, decision, now_ns):
            self._send_all(message)
        for message in self._parameters.poll(self._capacities[self._lists_to], max(dt, 0.0)):
            self._send(self._lists_to, message)

    def take(self) -> dict[str, bytes]:
        """What is to be written on each link, without those that have nothing to say."""
        out = {name: endpoint.take() for name, endpoint in self.endpoints.items()}
        return {name: data for name, data in out.items() if data}

    def take_changes(self) -> list[tuple[Parameter, Config]]:
        """Parameters that were set since the last call, each with the configuration that it leads to."""
        changes, self._changes = self._changes, []
        return changes

    @property
    def _system(self) -> int:
        return self.autopilot if self.autopilot is not None else self.config.mavlink.system_id

    def _send(self, name: str, message: MavlinkMessage) -> None:
        self.endpoints[name].send(message, self._system)

    def _send_all(self, message: MavlinkMessage) -> None:
        for name in self.endpoints:
            self._send(name, message)

    def _send_pose(self, pose: PoseEstimate, health: Health, decision: Decision) -> None:
        profile, heading = self.profile, self.map_heading
        if profile is None or heading is None:
            return
        if self._sent is not None:
            sent_ns, stamp_ns = self._sent
            spacing_ns = min(self._now_ns - sent_ns, pose.stamp_ns - stamp_ns)
            if spacing_ns < max(profile.least_spacing_ns, 1):
                return
        messages = profile.messages(
            pose, heading, self.config.mavlink, decision.reset_counter, QUALITY[health.state]
        )
        for message in messages:
            self._send(NAME, message)
        if messages:
            self._sent = self._now_ns, pose.stamp_ns
            self.poses_packed += 1

    def _hear_autopilot(self, message: MavlinkMessage, arrival_ns: int) -> None:
        for answer in self._contact.hear(message, arrival_ns, self._now_ns):
            self._send(NAME, answer)
        if message.get_type() == "ATTITUDE" and self._pose is not None:
            told = self._alignment.outcome
            self._alignment.add(message.yaw, self._pose.yaw, arrival_ns)
            if self._alignment.outcome != told:
                self._announcer.say(mavlink2.MAV_SEVERITY_INFO, self._alignment.outcome)

    def _answer(self, name: str, message: MavlinkMessage) -> None:
        kind = message.get_type()
        if kind == "PARAM_SET" and message.target_component != self.endpoints[name].component:
            return
        if kind == "PARAM_REQUEST_LIST":
            self._lists_to = name
        for answer in self._parameters.receive(message):
            self._send(name, answer)
        if kind == "COMMAND_LONG" and message.target_component == self.endpoints[name].component:
            asks = message.command == mavlink2.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES or (
                message.command == mavlink2.MAV_CMD_REQUEST_MESSAGE
                and message.param1 == mavlink2.MAVLINK_MSG_ID_AUTOPILOT_VERSION
            )
            result = mavlink2.MAV_RESULT_ACCEPTED if asks else mavlink2.MAV_RESULT_UNSUPPORTED
            back = message.get_srcSystem(), message.get_srcComponent()
            self._send(name, mavlink2.MAVLink_command_ack_message(message.command, result, 0, 0, *back))
            if asks:
                self._send(name, _version())

    def _parameter_set(self, parameter: Parameter, config: Config) -> None:
        self._changes.append((parameter, config))
        if parameter.applies_at_once:
            # This one alone: others that were set may have to wait for the next start.
            self.config = config_from_toml(
                self.config.to_toml(), "parameter", [setting_line(parameter, config)]
            )
            self._gate.table = self.config.mavlink.gate
        else:
            self._announcer.say(mavlink2.MAV_SEVERITY_INFO, f"{parameter.name} counts from the next start on")

    def _begin_alignment(self) -> None:
        if self.config.mavlink.align != "compass":
            why = 'set mavlink.align = "compass"'
        elif self._sent is not None and self.config.mavlink.heading:
            # The autopilot's heading may be ours by now: that would be measured against itself.
            why = "poses are being sent, restart first"
        elif self._pose is None:
            why = "no good pose yet"
        else:
            self._alignment.begin(self._now_ns)
            return
        self._announcer.say(mavlink2.MAV_SEVERITY_WARNING, f"not aligned: {why}")


def _heartbeat(health: Health, decision: Decision) -> MavlinkMessage:
    status = mavlink2.MAV_STATE_STANDBY if decision.held else _STATUS[health.state]
    return mavlink2.MAVLink_heartbeat_message(
        mavlink2.MAV_TYPE_ONBOARD_CONTROLLER, mavlink2.MAV_AUTOPILOT_INVALID, 0, 0, status, 3
    )


def _version() -> MavlinkMessage:
    return mavlink2.MAVLink_autopilot_version_message(
        _CAPABILITIES, 0, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0
    )
