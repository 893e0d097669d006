"""What we ask of the autopilot, until it has done it: an origin, and messages at our rates.

Source: MAVLink common.xml, SET_GPS_GLOBAL_ORIGIN, GPS_GLOBAL_ORIGIN, MAV_CMD_SET_MESSAGE_INTERVAL; ArduPilot
needs an origin for position, home and arming when there is no GPS, PX4 for its auto modes.
"""

from math import cos, hypot, radians

from pymavlink.dialects.v20 import all as mavlink2

from companion.config_tables import OriginTable
from companion.mavlink.pose_out import METRES_PER_DEGREE
from companion.mavlink_table import MavlinkTable
from drivers.mavlink_frames import MavlinkMessage

ORIGIN_PERIOD_NS = 2_000_000_000
INTERVAL_PERIOD_NS = 3_000_000_000
SAME_ORIGIN = 1.0
"""An origin that is no farther away is ours [m]: degE7 and float32 round."""
COMPASS_RATE = 10.0
"""ATTITUDE for the alignment to the compass [Hz]."""


class OriginKeeper:
    """Gives the autopilot the site's origin until it confirms one.

    Args:
        table: origin of the site; None = the site has none, and nothing is sent.

    Attributes:
        confirmed: whether the autopilot has an origin.
        distance: from ours to the confirmed one [m], None before that.
    """

    def __init__(self, table: OriginTable | None) -> None:
        self._table = table
        self._due_ns = 0
        self.confirmed = False
        self.distance: float | None = None

    @property
    def is_far(self) -> bool:
        """Whether the autopilot keeps an origin that is not ours."""
        return self.distance is not None and self.distance > SAME_ORIGIN

    def restart(self) -> None:
        """The autopilot was started anew: it has forgotten."""
        self.confirmed, self.distance, self._due_ns = False, None, 0

    def hear(self, message: MavlinkMessage) -> None:
        """Take a message of the autopilot."""
        # Zeros are what an autopilot without origin may report.
        if self._table is None or message.get_type() != "GPS_GLOBAL_ORIGIN":
            return
        if message.latitude or message.longitude:
            north = (message.latitude / 1e7 - self._table.lat) * METRES_PER_DEGREE
            east = (message.longitude / 1e7 - self._table.lon) * METRES_PER_DEGREE
            self.distance = hypot(north, east * cos(radians(self._table.lat)))
            self.confirmed = True

    def poll(self, system: int, now_ns: int) -> list[MavlinkMessage]:
        """Messages to send to the autopilot at `now_ns`."""
        table = self._table
        if table is None or self.confirmed or now_ns < self._due_ns:
            return []
        self._due_ns = now_ns + ORIGIN_PERIOD_NS
        return [
            mavlink2.MAVLink_set_gps_global_origin_message(
                system, round(table.lat * 1e7), round(table.lon * 1e7), round(table.alt * 1e3), now_ns // 1000
            ),
            command(
                system, mavlink2.MAV_CMD_REQUEST_MESSAGE, float(mavlink2.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
            ),
        ]


class StreamRequests:
    """Asks for messages at given rates, again while they do not come.

    Args:
        rates: message name -> rate [Hz].
    """

    def __init__(self, rates: dict[str, float]) -> None:
        self._rates = rates
        self._heard = dict.fromkeys(rates, 0)
        self._due_ns = 0

    def hear(self, message: MavlinkMessage) -> None:
        """Take a message of the autopilot."""
        kind = message.get_type()
        if kind in self._heard:
            self._heard[kind] += 1

    def poll(self, system: int, now_ns: int) -> list[MavlinkMessage]:
        """Requests for what did not come since the last look at least half as often as asked for."""
        if now_ns < self._due_ns:
            return []
        self._due_ns = now_ns + INTERVAL_PERIOD_NS
        enough = 0.5 * INTERVAL_PERIOD_NS * 1e-9
        missing = [kind for kind, count in self._heard.items() if count < enough * self._rates[kind]]
        self._heard = dict.fromkeys(self._rates, 0)
        return [
            command(
                system,
                mavlink2.MAV_CMD_SET_MESSAGE_INTERVAL,
                float(getattr(mavlink2, f"MAVLINK_MSG_ID_{kind}")),
                1e6 / self._rates[kind],
            )
            for kind in missing
        ]


def command(system: int, number: int, *parameters: float) -> MavlinkMessage:
    """COMMAND_LONG to the autopilot, its last parameters 0."""
    seven = [*parameters, *[0.0] * (7 - len(parameters))]
    return mavlink2.MAVLink_command_long_message(system, mavlink2.MAV_COMP_ID_AUTOPILOT1, number, 0, *seven)


def wanted_rates(table: MavlinkTable, kind: int) -> dict[str, float]:
    """Messages that the settings need of the autopilot, with their rates [Hz].

    Args:
        table: settings.
        kind: MAV_AUTOPILOT, which decides where its inertial samples are.
    """
    inputs = table.inputs
    imu = "HIGHRES_IMU" if kind == mavlink2.MAV_AUTOPILOT_PX4 else "RAW_IMU"
    compass = COMPASS_RATE if table.align == "compass" else 0.0
    rates = {
        # Its boot clock tells when the autopilot was started anew.
        "SYSTEM_TIME": 1.0,
        "ATTITUDE": max(inputs.attitude, compass),
        imu: inputs.imu,
        "DISTANCE_SENSOR": inputs.height,
        "WHEEL_DISTANCE": inputs.wheels,
    }
    return {name: rate for name, rate in rates.items() if rate}
