"""MAVLink bytes to messages, and who the autopilot among their senders is; no I/O and no clock.

Source: MAVLink developer guide, Heartbeat Protocol, Message Signing, MAVLink Id Assignment.
"""

import struct
from collections.abc import Callable
from operator import itemgetter
from typing import NamedTuple, TypeAlias

from pymavlink.dialects.v20 import all as mavlink2

from drivers.framing import DecodeStats

MavlinkMessage: TypeAlias = mavlink2.MAVLink_message

RIVAL_PERIOD_NS = 3_000_000_000
"""A second autopilot heard so soon after the first makes it unclear which one is ours."""
_BOOT_STEP_MS = (
    1000  # a boot clock that falls by more was started anew: messages overtake one another by less
)


_HEAD = struct.Struct("<BBBBBBBHB")
_CRC_BYTES = 2


def set_signing(ends: mavlink2.MAVLink, secret_key: bytes) -> None:
    """Accept only messages signed with this key; radios, which cannot sign, may still report themselves."""
    ends.signing.secret_key = secret_key
    ends.signing.allow_unsigned_callback = lambda _, kind: kind == mavlink2.MAVLINK_MSG_ID_RADIO_STATUS


class _Plain(NamedTuple):
    """How to read a kind of message that has numbers alone, no arrays and no text."""

    make: type[MavlinkMessage]
    unpacker: struct.Struct
    in_order: Callable[[tuple[float, ...]], tuple[float, ...]]
    crc_extra: bytes


_PLAIN = {
    kind: _Plain(make, make.unpacker, itemgetter(*make.orders), bytes([make.crc_extra]))
    for kind, make in mavlink2.mavlink_map.items()
    if len(make.orders) > 1 and set(make.lengths) == {1} and "s" not in make.unpacker.format
}


def plain_message(data: bytes, begin: int) -> MavlinkMessage | None:
    """The message that begins there, if there is nothing to it; None leaves it to pymavlink's own parser.

    It must be whole and sound, of version 2, not signed, and of a kind with numbers alone. Nearly all are,
    and pymavlink, which is ready for everything, takes three times as long.

    Args:
        data: bytes as they arrived.
        begin: index of the first one.

    Source: MAVLink developer guide, Packet Serialization.
    """
    if len(data) < begin + _HEAD.size:
        return None
    marker, length, incompatible, *head, low, high = _HEAD.unpack_from(data, begin)
    plain = _PLAIN.get(low | high << 16)
    payload_at = begin + _HEAD.size
    crc_at = payload_at + length
    end = crc_at + _CRC_BYTES
    if marker != mavlink2.PROTOCOL_MARKER_V2 or incompatible or plain is None or len(data) < end:
        return None
    crc = data[crc_at] | data[crc_at + 1] << 8
    if mavlink2.x25crc(data[begin + 1 : crc_at] + plain.crc_extra).crc != crc:
        return None
    # A sender leaves out zeros at the end; fields that we do not know come last.
    size = plain.unpacker.size
    payload = data[payload_at : min(crc_at, payload_at + size)].ljust(size, b"\0")
    message = plain.make(*plain.in_order(plain.unpacker.unpack(payload)))
    message._msgbuf = bytearray(data[begin:end])
    message._payload = message._msgbuf[6:-_CRC_BYTES]
    message._crc = crc
    message._header = mavlink2.MAVLink_header(plain.make.id, incompatible, head[0], length, *head[1:])
    return message


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
        found: list[MavlinkMessage] = []
        end = 0
        if self._ends.signing.secret_key is None and self._ends.buf_len() == 0:
            while message := plain_message(data, end):
                end += len(message.get_msgbuf())
                found.append(message)
            self.stats.good += len(found)
            if end == len(data):
                return found
        for message in self._ends.parse_buffer(data[end:]) or []:
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
