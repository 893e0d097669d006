"""What speaks on a line, judged by its bytes alone; no I/O and no time.

Sensors are known by their own decoders. What else is found on serial ports and must be left alone is
known by its form: MAVLink by HEARTBEATs, which every system sends once a second, NMEA-0183 by sentences.

Source: MAVLink developer guide, Packet Serialization and Heartbeat Protocol; NMEA 0183 v3.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass

from drivers import SENSORS, make_sensor, sensor_config_class
from drivers.framing import DecodeStats, Sensor
from drivers.rplidar_decoder import AnswerDecoder
from drivers.rplidar_protocol import PACKET_BYTES, PACKET_SAMPLES, encode_descriptor

MAVLINK, NMEA = "mavlink", "nmea"
"""Speakers that are no sensors of ours; those that are have their names in SENSORS."""

_CERTAIN_FRAMES = 3
"""So many good frames, and fewer bad ones, are no chance: a checksum of 8 bits lets one in 256 pass."""
_HEARTBEAT = re.compile(
    rb"(?=\xfd(?P<v2>\x09[\x00\x01].{2}(?P<from2>.{2})\0\0\0.{9})(?P<crc2>..)"
    rb"|\xfe(?P<v1>\x09.(?P<from1>.{2})\0.{9})(?P<crc1>..))",
    re.DOTALL,
)
_HEARTBEAT_CRC_EXTRA = 50
_NMEA_SENTENCE = re.compile(rb"\$[A-Z][A-Z0-9]{2,},[ -~]{0,80}\*[0-9A-F]{2}\r?\n")
_LONGEST_LOOK = 8192
"""Bytes that are looked at for a running scan: ten of its longest packets."""


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """What a MAVLink HEARTBEAT says of its sender.

    Attributes:
        system: its system id.
        component: its component id; 1 = autopilot.
    """

    system: int
    component: int


def find_heartbeat(data: bytes | bytearray) -> Heartbeat | None:
    """First MAVLink 1 or 2 HEARTBEAT with a right checksum."""
    for match in _HEARTBEAT.finditer(data):
        content, crc = match["v2"] or match["v1"], match["crc2"] or match["crc1"]
        if _crc_x25(bytes(content) + bytes([_HEARTBEAT_CRC_EXTRA])) == int.from_bytes(crc, "little"):
            return Heartbeat(*(match["from2"] or match["from1"]))
    return None


def find_nmea(data: bytes | bytearray) -> bytes | None:
    """First sentence of NMEA-0183 text."""
    match = _NMEA_SENTENCE.search(data)
    return bytes(match[0]).rstrip() if match else None


def is_running_scan(data: bytes | bytearray) -> bool:
    """Whether this is the middle of an RPLIDAR's scan: most of it are good packets of one kind."""
    data = bytes(data[-_LONGEST_LOOK:])
    if len(set(data)) < 16:
        # A line that is stuck in one pattern reads like nodes without end at one angle.
        return False
    for scan_type in PACKET_SAMPLES:
        stats = DecodeStats()
        AnswerDecoder(stats).feed(encode_descriptor(scan_type) + data)
        if stats.good >= _CERTAIN_FRAMES and 2 * stats.good * PACKET_BYTES[scan_type] > len(data):
            return True
    return False


def new_sensor(driver: str) -> Sensor:
    """A sensor with default settings, to try bytes on."""
    return make_sensor(driver, sensor_config_class(driver)())


class Ear:
    """Listens to a line at one baud rate.

    Args:
        drivers: sensors that may be heard.

    Attributes:
        data: everything heard.
    """

    def __init__(self, drivers: Iterable[str] = tuple(SENSORS)) -> None:
        self.data = bytearray()
        self._sensors = {driver: new_sensor(driver) for driver in drivers}

    def feed(self, data: bytes, stamp_ns: int) -> str | None:
        """Take bytes that arrived at `stamp_ns`; who speaks, as soon as that is certain."""
        self.data += data
        for driver, sensor in self._sensors.items():
            sensor.feed(data, stamp_ns)
            if sensor.stats.good >= max(_CERTAIN_FRAMES, sensor.stats.bad + 1):
                return driver
        return None

    def verdict(self) -> str | None:
        """Who spoke, now that nothing more comes; None when nobody is known by these bytes."""
        for driver, sensor in self._sensors.items():
            # A slow sensor sends a single frame in this time; then little else may have come.
            if sensor.stats.good and 2 * sensor.stats.skipped_bytes <= len(self.data):
                return driver
        if find_heartbeat(self.data):
            return MAVLINK
        return NMEA if find_nmea(self.data) else None


def _crc_x25(data: bytes) -> int:
    """CRC-16/MCRF4XX, as MAVLink uses it."""
    crc = 0xFFFF
    for byte in data:
        low = (crc ^ byte) & 0xFF
        low ^= (low << 4) & 0xFF
        crc = crc >> 8 ^ low << 8 ^ low << 3 ^ low >> 4
    return crc
