"""MAVLink bytes to messages, and who the autopilot among their senders is; no I/O and no clock.

Source: MAVLink developer guide, Heartbeat Protocol, Message Signing, MAVLink Id Assignment.
"""

from typing import TypeAlias

from pymavlink.dialects.v20 import all as mavlink2

from drivers.framing import DecodeStats

MavlinkMessage: TypeAlias = mavlink2.MAVLink_message

RIVAL_PERIOD_NS = 3_000_000_000
"""A second autopilot heard so soon after the first makes it unclear which one is ours."""
_BOOT_STEP_MS = (
    1000  # a boot clock that falls by more was started anew: messages overtake one another by less
)


def set_signing(ends: mavlink2.MAVLink, secret_key: bytes) -> None:
    """Accept only messages signed with this key; radios, which cannot sign, may still report themselves."""
    ends.signing.secret_key = secret_key
    ends.signing.allow_unsigned_callback = lambda _, kind: kind == mavlink2.MAVLINK_MSG_ID_RADIO_STATUS


class MavlinkParser:
    """Messages out of bytes in any chunks; damaged, unknown and wrongly signed ones are counted.

    Args:
        secret_key: of 32 bytes; None = signatures are not looked at.

    Attributes:
        stats: what became of the bytes.
    """

    def __init__(self, secret_key: bytes | None = None) -> None:
        self.stats = DecodeStats()
        self._ends = mavlink2.MAVLink(None)
        self._ends.robust_parsing = True
        if secret_key is not None:
            set_signing(self._ends, secret_key)

    @property
    def signing_timestamp(self) -> int:
        """Newest timestamp of a signature that was accepted [10 us since 2015]."""
        return int(self._ends.signing.timestamp)

    def forget_older(self, timestamp: int) -> None:
        """Refuse new senders whose signatures are more than a minute older than this [10 us since 2015]."""
        self._ends.signing.timestamp = max(timestamp, self.signing_timestamp)

    def feed(self, data: bytes) -> list[MavlinkMessage]:
        """Messages that these bytes complete."""
        found = []
        for message in self._ends.parse_buffer(data) or []:
            kind = message.get_type()
            if kind == "BAD_DATA":
                self.stats.bad += 1
                self.stats.skipped_bytes += len(message.data)
            elif not kind.startswith("UNKNOWN"):
                self.stats.good += 1
                found.append(message)
        return found


class AutopilotIdentity:
    """Which system the autopilot is, what runs on it, and how often it was started anew.

    Args:
        system: its id if the user named it; 0 = the first autopilot that is heard.

    Attributes:
        system: id of the autopilot; None until it was heard.
        kind: MAV_AUTOPILOT of its HEARTBEAT.
        boots: how often its clock began anew while we listened.
        heard_ns: when its last HEARTBEAT came.
        rival: id of another autopilot heard right after the first: then none is ours.
    """

    def __init__(self, system: int = 0) -> None:
        self._wanted = system
        self.system: int | None = None
        self.kind = mavlink2.MAV_AUTOPILOT_INVALID
        self.boots = 0
        self.heard_ns: int | None = None
        self.rival: int | None = None
        self._first_ns = 0
        self._boot_ms: int | None = None

    def hear(self, message: MavlinkMessage, stamp_ns: int) -> None:
        """Take note of a message that arrived at `stamp_ns`."""
        if message.get_srcComponent() != mavlink2.MAV_COMP_ID_AUTOPILOT1:
            return
        sender = message.get_srcSystem()
        if message.get_type() == "HEARTBEAT" and message.autopilot != mavlink2.MAV_AUTOPILOT_INVALID:
            self._hear_heartbeat(sender, message.autopilot, stamp_ns)
        elif sender == self.system:
            if message.get_type() == "TIMESYNC":
                boot_ms = message.tc1 // 1_000_000 or None
            else:
                boot_ms = getattr(message, "time_boot_ms", None)
            if boot_ms is not None:
                if self._boot_ms is not None and boot_ms < self._boot_ms - _BOOT_STEP_MS:
                    self.boots += 1
                self._boot_ms = boot_ms

    def _hear_heartbeat(self, sender: int, kind: int, stamp_ns: int) -> None:
        if self._wanted not in (0, sender) or self.rival is not None:
            return
        if self.system is None:
            self.system, self._first_ns = sender, stamp_ns
        if sender == self.system:
            self.kind, self.heard_ns = kind, stamp_ns
        elif stamp_ns - self._first_ns < RIVAL_PERIOD_NS:
            self.rival, self.system = sender, None
