"""Wheel and visual odometry that reaches us as MAVLink, as increments of the planar pose.

Source: MAVLink common.xml, ODOMETRY and WHEEL_DISTANCE; differential drive as in Thrun, Burgard and Fox,
Probabilistic Robotics, 5.4.
"""

from math import atan2, isfinite

import numpy as np
from pydantic import BaseModel, Field, ValidationInfo, field_validator
from pymavlink.dialects.v20 import all as mavlink2

from drivers.autopilot_clock import AutopilotClock
from drivers.mavlink_frames import MavlinkMessage
from estimators.messages import FloatArray, PoseIncrement

_LONGEST_GAP_NS = 1_000_000_000
"""After a longer one odometry begins anew [ns]."""
_MAX_SPEED = 20.0  # [m/s]; a wheel or a pose that is faster was set anew
_LEAST_SIGMA = 1e-3  # of a step [m, rad]: counters and poses are rounded
_US = 1000
_DOWNWARD = frozenset({mavlink2.MAV_FRAME_LOCAL_NED, mavlink2.MAV_FRAME_LOCAL_FRD})
_UPWARD = frozenset({mavlink2.MAV_FRAME_LOCAL_ENU, mavlink2.MAV_FRAME_LOCAL_FLU})


class OdometryConfig(BaseModel):
    """Settings of odometry."""

    odometry: float = Field(0.0, ge=0, le=100, description="ODOMETRY of a computer beside us [Hz]")
    wheels: float = Field(0.0, ge=0, le=100, description="WHEEL_DISTANCE, left wheel first [Hz]")
    wheel_track: float = Field(0.5, gt=0, le=10, description="distance between the two wheels [m]")
    odometry_sigma: float = Field(
        0.05, gt=0, le=1, description="standard deviation of a step, as a share of its length and turn"
    )

    @field_validator("wheels")
    @classmethod
    def _one_odometry(cls, wheels: float, info: ValidationInfo) -> float:
        if wheels and info.data.get("odometry"):
            raise ValueError("increments of two sources cannot be chained, set odometry = 0 or wheels = 0")
        return wheels


class OdometryInput:
    """Increments between successive messages.

    Args:
        config: noise and geometry.
    """

    def __init__(self, config: OdometryConfig) -> None:
        self._config = config
        self._clocks: dict[int, AutopilotClock] = {}
        self._stamp_ns: int | None = None
        self._sender: tuple[int, int] | None = None
        self._pose = np.zeros(3)
        self._wheels: tuple[float, float] | None = None

    def pose(self, message: MavlinkMessage, arrival_ns: int) -> PoseIncrement | None:
        """Increment up to an ODOMETRY; None when it is no use, or the autopilot's own pose."""
        if message.estimator_type == mavlink2.MAV_ESTIMATOR_TYPE_AUTOPILOT:
            return None
        planar = _planar(message)
        if planar is None or message.quality < 0:
            self._stamp_ns = None
            return None
        component = message.get_srcComponent()
        clock = self._clocks.setdefault(component, AutopilotClock())
        clock.hear(message.time_usec * _US, arrival_ns)
        stamp_ns = clock.host_ns(message.time_usec * _US, arrival_ns)
        sender = (component, message.reset_counter)
        if self._sender != sender:
            self._sender, self._stamp_ns = sender, None
        c, s = np.cos(self._pose[2]), np.sin(self._pose[2])
        dx, dy, turn = planar - self._pose
        turn = atan2(np.sin(turn), np.cos(turn))
        self._pose = planar
        step = np.array([c * dx + s * dy, c * dy - s * dx, turn])
        along = self._config.odometry_sigma * float(np.hypot(dx, dy)) + _LEAST_SIGMA
        about = self._config.odometry_sigma * abs(turn) + _LEAST_SIGMA
        return self._increment(stamp_ns, step, np.diag(np.square([along, along, about])))

    def wheels(self, message: MavlinkMessage, stamp_ns: int) -> PoseIncrement | None:
        """Increment up to a WHEEL_DISTANCE of two wheels."""
        left, right = message.distance[:2]
        if message.count < 2 or not (isfinite(left) and isfinite(right)):
            return None
        if self._wheels is None:
            self._stamp_ns = None
        before, self._wheels = self._wheels or (left, right), (left, right)
        steps = np.array([left - before[0], right - before[1]])
        track = self._config.wheel_track
        turn = float(steps[1] - steps[0]) / track
        along = float(steps.sum()) / 2.0
        # Chord of an arc, which the mean direction of the step points along.
        step = np.array([along * np.cos(turn / 2.0), along * np.sin(turn / 2.0), turn])
        by_wheels = np.array(
            [[0.5, 0.5], [-along / (2.0 * track), along / (2.0 * track)], [-1 / track, 1 / track]]
        )
        sigmas = self._config.odometry_sigma * np.abs(steps) + _LEAST_SIGMA
        cov = by_wheels @ np.diag(sigmas**2) @ by_wheels.T
        # What slips sideways no wheel measures.
        cov[1, 1] += (self._config.odometry_sigma * along) ** 2 + _LEAST_SIGMA**2
        return self._increment(stamp_ns, step, cov)

    def _increment(self, stamp_ns: int, step: FloatArray, cov: FloatArray) -> PoseIncrement | None:
        before_ns = self._stamp_ns
        if before_ns is not None and stamp_ns <= before_ns:
            return None
        self._stamp_ns = stamp_ns
        if before_ns is None or stamp_ns - before_ns > _LONGEST_GAP_NS:
            return PoseIncrement(stamp_ns, stamp_ns, np.zeros(3), np.zeros((3, 3)), is_keyframe=True)
        if np.hypot(step[0], step[1]) > _MAX_SPEED * (stamp_ns - before_ns) * 1e-9 + _LEAST_SIGMA:
            return PoseIncrement(stamp_ns, stamp_ns, np.zeros(3), np.zeros((3, 3)), is_keyframe=True)
        return PoseIncrement(before_ns, stamp_ns, step, cov, is_keyframe=True)


def _planar(message: MavlinkMessage) -> FloatArray | None:
    """x, y [m], yaw [rad], counter-clockwise seen from above; None when the frame or a number is no use."""
    w, x, y, z = message.q
    values = (message.x, message.y, w, x, y, z)
    if not all(map(isfinite, values)) or not 0.99 <= w * w + x * x + y * y + z * z <= 1.01:
        return None
    yaw = atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    if message.frame_id in _DOWNWARD and message.child_frame_id == mavlink2.MAV_FRAME_BODY_FRD:
        return np.array([message.x, -message.y, -yaw])
    if message.frame_id in _UPWARD:
        return np.array([message.x, message.y, yaw])
    return None
