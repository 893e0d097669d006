"""What an autopilot measures, out of the MAVLink bytes that it sends: inertial, attitude, height, odometry.

It is a `Sensor` on the autopilot's link, but none that stands alone on a port: the process talks to the
autopilot, this only listens. NED and FRD end here: everything comes out in forward, left, up.

Source: MAVLink common.xml and ardupilotmega.xml; units of RAW_IMU as ArduPilot fills them.
"""

from math import isfinite, sqrt
from typing import ClassVar

import numpy as np
from pydantic import ConfigDict, Field
from pymavlink.dialects.v20 import all as mavlink2

from drivers.autopilot_clock import AutopilotClock
from drivers.autopilot_odometry import OdometryConfig, OdometryInput
from drivers.mavlink_frames import AutopilotIdentity, MavlinkMessage, MavlinkParser
from estimators.messages import Attitude, FloatArray, Height, ImuSample, Measurement, PoseIncrement

_MILLI_G = 9.80665e-3
_MS, _US = 1_000_000, 1000
_IMU_RANKS = {"SCALED_IMU": 0, "RAW_IMU": 1, "HIGHRES_IMU": 2}
"""An autopilot may send several of its one sensor: only the best kind heard is used."""
_DOWN = mavlink2.MAV_SENSOR_ROTATION_PITCH_270
_RANGEFINDER_SIGMA = 0.05  # [m]; for a sensor that says nothing of its noise
_UNKNOWN_COVARIANCE = 255
_INVALID_SIGNAL = 1


class Autopilot:
    """Measurements in the messages of the autopilot, and of odometry computers beside it.

    Args:
        config: what is used.
        autopilot_id: its system id; 0 = the first one heard.
        secret_key: that its messages must be signed with, or None.

    Attributes:
        clock: the autopilot's.
        identity: who it is.
    """

    class Config(OdometryConfig):
        """Settings: how often the autopilot is asked to send what; 0 = not used."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        attitude: float = Field(0.0, ge=0, le=400, description="ATTITUDE [Hz]")
        imu: float = Field(0.0, ge=0, le=1000, description="HIGHRES_IMU, RAW_IMU or SCALED_IMU [Hz]")
        height: float = Field(0.0, ge=0, le=100, description="DISTANCE_SENSOR that looks down [Hz]")

    MEASURES: ClassVar[frozenset[type]] = frozenset({ImuSample, Attitude, Height, PoseIncrement})

    def __init__(self, config: Config, autopilot_id: int = 0, secret_key: bytes | None = None) -> None:
        self._config = config
        self._parser = MavlinkParser(secret_key)
        self.stats = self._parser.stats
        self.identity = AutopilotIdentity(autopilot_id)
        self.clock = AutopilotClock()
        self._odometry = OdometryInput(config)
        self._imu_rank = 0
        self._has_distance_sensor = False

    def feed(self, data: bytes, stamp_ns: int) -> list[Measurement]:
        """Decode bytes that arrived at `stamp_ns`; never raises on any bytes."""
        found: list[Measurement] = []
        for message in self._parser.feed(data):
            self.identity.hear(message, stamp_ns)
            if message.get_srcSystem() != self.identity.system:
                continue
            if message.get_srcComponent() == mavlink2.MAV_COMP_ID_AUTOPILOT1:
                measurement = self._from_autopilot(message, stamp_ns)
            elif message.get_type() == "ODOMETRY" and self._config.odometry:
                measurement = self._odometry.pose(message, stamp_ns)
            else:
                continue
            if measurement is not None:
                found.append(measurement)
        return found

    def _from_autopilot(self, message: MavlinkMessage, stamp_ns: int) -> Measurement | None:
        match message.get_type():
            case "TIMESYNC":
                # Of the answers to us only: those to others hold their clock.
                if message.tc1 > 0 and 0 <= stamp_ns - message.ts1 < 10_000 * _MS:
                    self.clock.answered(message.ts1, message.tc1, stamp_ns)
            case "ATTITUDE" if self._config.attitude:
                return self._attitude(message, self._host_ns(message.time_boot_ms * _MS, stamp_ns))
            case "SCALED_IMU" | "RAW_IMU" | "HIGHRES_IMU" if self._config.imu:
                return self._imu(message, stamp_ns)
            case "DISTANCE_SENSOR" if self._config.height:
                return self._distance(message, stamp_ns)
            case "RANGEFINDER" if self._config.height and not self._has_distance_sensor:
                return _height(stamp_ns, message.distance, _RANGEFINDER_SIGMA)
            case "WHEEL_DISTANCE" if self._config.wheels:
                return self._odometry.wheels(message, self._host_ns(message.time_usec * _US, stamp_ns))
        return None

    def _host_ns(self, boot_ns: int, arrival_ns: int) -> int:
        self.clock.hear(boot_ns, arrival_ns)
        return self.clock.host_ns(boot_ns, arrival_ns)

    def _attitude(self, message: MavlinkMessage, stamp_ns: int) -> Attitude | None:
        """Attitude of forward-left-up axes in a level frame: pitch and yaw change their signs."""
        half = np.array([message.roll, -message.pitch, -message.yaw], dtype=np.float64) / 2.0
        if not _is_finite(half):
            return None
        (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
        quat = [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
        return Attitude(stamp_ns, np.array(quat))

    def _imu(self, message: MavlinkMessage, arrival_ns: int) -> ImuSample | None:
        kind = message.get_type()
        rank = _IMU_RANKS[kind]
        is_ardupilot = self.identity.kind == mavlink2.MAV_AUTOPILOT_ARDUPILOTMEGA
        is_second = "id" in message.fieldnames and message.id != 0
        # Nothing says what the units of another autopilot's RAW_IMU are.
        if rank < self._imu_rank or is_second or (kind == "RAW_IMU" and not is_ardupilot):
            return None
        self._imu_rank = rank
        boot_ns = message.time_boot_ms * _MS if kind == "SCALED_IMU" else message.time_usec * _US
        rate, force = (1.0, 1.0) if kind == "HIGHRES_IMU" else (1e-3, _MILLI_G)
        p, q, r = message.xgyro * rate, message.ygyro * rate, message.zgyro * rate
        x, y, z = message.xacc * force, message.yacc * force, message.zacc * force
        stamp_ns = self._host_ns(boot_ns, arrival_ns)
        # The sum of float32 is finite when each of them is.
        if not isfinite(p + q + r + x + y + z):
            return None
        return ImuSample(stamp_ns, np.array((p, -q, -r)), np.array((x, -y, -z)))

    def _distance(self, message: MavlinkMessage, arrival_ns: int) -> Height | None:
        if message.orientation != _DOWN:
            return None
        self._has_distance_sensor = True
        in_range = message.min_distance <= message.current_distance <= message.max_distance
        if not in_range or message.signal_quality == _INVALID_SIGNAL:
            return None
        stamp_ns = self._host_ns(message.time_boot_ms * _MS, arrival_ns)
        says_noise = 0 < message.covariance < _UNKNOWN_COVARIANCE
        sigma = sqrt(message.covariance) / 100.0 if says_noise else _RANGEFINDER_SIGMA
        return _height(stamp_ns, message.current_distance / 100.0, sigma)


def _height(stamp_ns: int, metres: float, sigma: float) -> Height | None:
    return Height(stamp_ns, metres, sigma) if isfinite(metres) and metres > 0.0 else None


def _is_finite(values: FloatArray) -> bool:
    return bool(np.isfinite(values).all())
