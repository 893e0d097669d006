"""Single ranges as RANGING_BEACON, for an autopilot that fuses them itself; a message still in development.

Source: MAVLink development.xml, RANGING_BEACON; PX4 EKF2, which takes anchors by latitude and longitude.
"""

from math import cos, radians

import numpy as np
from pymavlink.dialects.v20 import all as mavlink2

from companion.config import Config
from companion.mavlink.pose_out import METRES_PER_DEGREE, ned_from_map
from drivers.mavlink_frames import MavlinkMessage
from estimators.base import Report, Verdict
from estimators.messages import RangeFrame

_UNKNOWN = 2**32 - 1


class RangingBeacons:
    """Messages for the ranges that the estimator has accepted.

    Args:
        config: of a site with an origin.
    """

    def __init__(self, config: Config) -> None:
        assert config.site.origin is not None
        origin = config.site.origin
        sigma = getattr(config.estimator_config(config.pipeline.estimator), "range_sigma", None)
        self._sigma_mm = _UNKNOWN if sigma is None else round(sigma * 1000.0)
        self._sequence = 0
        R_ned_map = ned_from_map(config.map_heading())
        self._anchors: dict[int, tuple[int, int, float]] = {}
        for number, position in config.anchors.items():
            north, east, down = R_ned_map @ np.array(position)
            lat = origin.lat + north / METRES_PER_DEGREE
            lon = origin.lon + east / (METRES_PER_DEGREE * cos(radians(origin.lat)))
            self._anchors[number] = round(lat * 1e7), round(lon * 1e7), origin.alt - float(down)

    def messages(self, frame: RangeFrame, report: Report, system: int) -> list[MavlinkMessage]:
        """A message for each accepted range.

        Args:
            frame: ranges.
            report: what the estimator made of them.
            system: id of the autopilot.
        """
        found = []
        pairs = zip(frame.anchor_ids.tolist(), frame.ranges.tolist(), report.verdicts, strict=True)
        for number, distance, verdict in pairs:
            if verdict is not Verdict.ACCEPTED or number not in self._anchors or number > 0xFFFF:
                continue
            lat, lon, alt = self._anchors[number]
            self._sequence = (self._sequence + 1) % 256
            found.append(
                mavlink2.MAVLink_ranging_beacon_message(
                    frame.stamp_ns // 1000,
                    system,
                    mavlink2.MAV_COMP_ID_AUTOPILOT1,
                    number,
                    round(distance * 1000.0),
                    lat,
                    lon,
                    alt,
                    mavlink2.RANGING_BEACON_ALT_TYPE_MSL,
                    _UNKNOWN,
                    _UNKNOWN,
                    0,
                    self._sigma_mm,
                    self._sequence,
                    0,
                )
            )
        return found
