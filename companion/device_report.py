"""Who a device on a serial line is and how it does, in a line for the operator."""

import re
import time
from collections import Counter
from collections.abc import Iterator
from typing import TypeVar

from drivers.discovery import Voice
from drivers.framing import DecodeStats
from drivers.linktrack import LinkTrack, measurements
from drivers.linktrack_types import Frame, Role, UserFrame1
from drivers.recognition import MAVLINK, NMEA, find_heartbeat, find_nmea
from drivers.rplidar_decoder import AnswerDecoder
from drivers.rplidar_protocol import Command, DeviceInfo, Health, HealthStatus, encode_request
from drivers.serial_line import SerialWire
from estimators.messages import RangeFrame

ANSWER_TIME = 0.5
"""How long an answer is waited for [s]."""
AUTOPILOT_COMPONENT = 1
_RPLIDAR_MODELS = {0x18: "A1M8", 0x27: "A2M7", 0x28: "A2M8", 0x2C: "A2M12"}
_RPLIDAR_SERIES = {1: "A1", 2: "A2", 3: "A3", 4: "C1", 6: "S1", 7: "S2", 8: "S3"}
A = TypeVar("A", DeviceInfo, Health)


def describe(wire: SerialWire, voice: Voice, seconds: float) -> str:
    """What speaks on a line, after a closer look at it.

    Args:
        wire: the line, at the rate of the voice.
        voice: what was recognised there.
        seconds: how long a device that sends by itself is watched.
    """
    if voice.fault:
        return str(voice)
    try:
        wire.set_baud(voice.baud)  # forgets what has piled up
        match voice.speaker:
            case "linktrack":
                return f"{_linktrack(wire, seconds)}, at {voice.baud} baud"
            case "rplidar":
                return f"{_rplidar(wire)}, at {voice.baud} baud"
    except OSError as error:
        return f"{voice}, then lost: {error}"
    if voice.speaker == MAVLINK and (beat := find_heartbeat(voice.data)):
        sender = "autopilot" if beat.component == AUTOPILOT_COMPONENT else f"component {beat.component}"
        return f"MAVLink {sender}, system {beat.system}, at {voice.baud} baud"
    if voice.speaker == NMEA and (sentence := find_nmea(voice.data)):
        return (
            f"NMEA text at {voice.baud} baud ({sentence.decode()}): if this is a LinkTrack module, set its "
            "protocol to Node_Frame2"
        )
    if voice.speaker is None and voice.data:
        return (
            f"{len(voice.data)} bytes at {voice.baud} baud, none understood at any rate "
            "(another device, or an open RX line?)"
        )
    if voice.speaker is None:
        return "silent (is the device powered, do RX and TX go to its TX and RX?)"
    return str(voice)


def _linktrack(wire: SerialWire, seconds: float) -> str:
    sensor = LinkTrack(LinkTrack.Config())
    frames = [frame for data in _read(wire, seconds) for frame in sensor.frames(data)]
    if not frames:
        return "LinkTrack module, then silent"
    kind, count = Counter(type(frame) for frame in frames).most_common(1)[0]
    name = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", kind.__name__)
    said = [f"LinkTrack {_sender(frames[0])}".rstrip(), name, f"{count / seconds:.0f} Hz"]
    if not any(isinstance(m, RangeFrame) for frame in frames for m in measurements(frame, 0)):
        said.append("NO RANGES (is its output Node_Frame2, are anchors on?)")
    return ", ".join(said)


def _sender(frame: Frame) -> str:
    """Role and id; roles are free in some modes, and a few frames do not name their sender."""
    if isinstance(frame, UserFrame1):
        return ""
    role = Role(frame.role).name.lower() if frame.role in set(Role) else f"role {frame.role}, id"
    return f"{role} {frame.id}"


def _rplidar(wire: SerialWire) -> str:
    info = _ask(wire, Command.GET_INFO, DeviceInfo)
    health = _ask(wire, Command.GET_HEALTH, Health)
    said = ["RPLIDAR"]
    if info is not None:
        model = _RPLIDAR_MODELS.get(info.model) or _RPLIDAR_SERIES.get(info.series) or f"0x{info.model:02X}"
        major, minor = info.firmware
        said = [f"RPLIDAR {model}", f"firmware {major}.{minor:02d}", f"serial {info.serial}"]
    if health is None:
        said.append("health unknown")
    elif health.status is HealthStatus.GOOD:
        said.append("health good")
    else:
        said.append(f"HEALTH {health.status.name} 0x{health.error_code:04X} (does it turn freely?)")
    return ", ".join(said)


def _ask(wire: SerialWire, command: Command, kind: type[A]) -> A | None:
    decoder = AnswerDecoder(DecodeStats())
    wire.write(encode_request(command))
    for data in _read(wire, ANSWER_TIME):
        for event in decoder.feed(data):
            if isinstance(event, kind):
                return event
    return None


def _read(wire: SerialWire, seconds: float) -> Iterator[bytes]:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        yield wire.read()
