"""What went over the link to the autopilot, for those who watch: where it thinks it is, what it says."""

import numpy as np
from pymavlink.dialects.v20 import all as mavlink2

from companion.log import Direction, RawChunk
from drivers.mavlink_frames import MavlinkMessage, MavlinkParser
from estimators.immutable import immutable
from estimators.messages import FloatArray

MAX_LATENCY = 1.0
"""A pose that seems older than this [s] when it is sent has a stamp of another clock."""
SILENCE_NS = 3_000_000_000
"""Without a HEARTBEAT for so long, the autopilot counts as gone."""
_WHOLE_TEXT = 50
"""Characters of a STATUSTEXT; only a full one may go on in the next."""


@immutable
class Heard:
    """Something that was said on the link.

    Attributes:
        stamp_ns: when it crossed the port.
        xy: (2,) position of the autopilot [m], map frame.
        latency: age of a pose when it was sent [s].
        text: for the operator; empty when there is none.
        is_urgent: the text is a warning or worse.
    """

    stamp_ns: int
    xy: FloatArray | None = None
    latency: float | None = None
    text: str = ""
    is_urgent: bool = False


class LinkListener:
    """Reads along on the link to the autopilot, both ways; never raises on any bytes.

    Args:
        map_heading: compass heading of the map's x axis [rad].
    """

    def __init__(self, map_heading: float) -> None:
        c, s = np.cos(map_heading), np.sin(map_heading)
        self._R_map_ne = np.array([[c, s], [s, -c]])
        self._parsers = {direction: MavlinkParser() for direction in Direction}
        self._texts: dict[tuple[int, int], str] = {}
        self._heartbeat_ns: int | None = None

    def listen(self, chunk: RawChunk) -> list[Heard]:
        """What these bytes complete."""
        said = []
        for message in self._parsers[chunk.direction].feed(chunk.data):
            if chunk.direction is Direction.OUT:
                heard = self._sent(message, chunk.stamp_ns)
            else:
                heard = self._received(message, chunk.stamp_ns)
            if heard is not None:
                said.append(heard)
        return said

    def _sent(self, message: MavlinkMessage, stamp_ns: int) -> Heard | None:
        match message.get_type():
            case "VISION_POSITION_ESTIMATE":
                usec = message.usec
            case "ODOMETRY":
                usec = message.time_usec
            case _:
                return None
        latency = (stamp_ns - usec * 1000) * 1e-9
        return Heard(stamp_ns, latency=latency) if 0.0 <= latency < MAX_LATENCY else None

    def _received(self, message: MavlinkMessage, stamp_ns: int) -> Heard | None:
        match message.get_type():
            case "STATUSTEXT":
                return self._text(message, stamp_ns)
            case "LOCAL_POSITION_NED" if message.get_srcComponent() == mavlink2.MAV_COMP_ID_AUTOPILOT1:
                xy = self._R_map_ne @ np.array([message.x, message.y])
                return Heard(stamp_ns, xy=xy) if np.isfinite(xy).all() else None
            case "HEARTBEAT" if message.autopilot != mavlink2.MAV_AUTOPILOT_INVALID:
                last_ns, self._heartbeat_ns = self._heartbeat_ns, stamp_ns
                if last_ns is None:
                    return Heard(stamp_ns, text=f"autopilot {message.get_srcSystem()} heard")
                if stamp_ns - last_ns > SILENCE_NS:
                    silent = (stamp_ns - last_ns) * 1e-9
                    return Heard(stamp_ns, text=f"autopilot back after {silent:.1f} s", is_urgent=True)
        return None

    def _text(self, message: MavlinkMessage, stamp_ns: int) -> Heard | None:
        """A text; long ones come in pieces that bear one number."""
        key = message.get_srcSystem(), message.id
        text = (self._texts.pop(key, "") if message.id else "") + message.text
        if message.id and len(message.text) == _WHOLE_TEXT:
            self._texts[key] = text
            return None
        return Heard(
            stamp_ns, text=f"autopilot: {text}", is_urgent=message.severity <= mavlink2.MAV_SEVERITY_WARNING
        )
