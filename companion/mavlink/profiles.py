"""What ArduPilot and PX4 each want of an external pose: messages, frames, covariance, quality.

Source: MAVLink common.xml; ArduPilot AP_VisualOdom and AP_NavEKF3; PX4 EKF2 and its MAVLink receiver.
"""

from dataclasses import dataclass, replace
from math import nan, pi

import numpy as np
from pymavlink.dialects.v20 import all as mavlink2

from companion.mavlink.pose_out import NedPose, to_ned
from companion.mavlink_table import MavlinkTable
from drivers.mavlink_frames import MavlinkMessage
from estimators.messages import FloatArray, PoseEstimate

UPPER = np.triu_indices(6)
"""How the 21 numbers of a covariance stand in its matrix: row by row, from the diagonal on."""
UNKNOWN_YAW_VARIANCE = pi**2 / 3.0
"""Of a heading that may be any [rad^2]: ArduPilot raises an internal error for one that is not finite."""
LEAST_VARIANCE = 1e-8
"""What is claimed at least [m^2, rad^2, m^2/s^2]: none may be zero once it is rounded to float32."""
_UNKNOWN = [nan] + [0.0] * 20
_UNKNOWN_SPEED = [nan] + [0.0] * 8


@dataclass(frozen=True, slots=True)
class Profile:
    """An autopilot's ways.

    Attributes:
        name: as in the setting `mavlink.profile`.
        least_spacing_ns: it drops samples that follow each other more closely.
        odometry_frame: MAV_FRAME that it takes north-aligned poses in.
        takes_speed: whether it reads VISION_SPEED_ESTIMATE.
    """

    name: str
    least_spacing_ns: int
    odometry_frame: int
    takes_speed: bool

    def messages(
        self, pose: PoseEstimate, map_heading: float, table: MavlinkTable, reset_counter: int, quality: int
    ) -> list[MavlinkMessage]:
        """Messages that carry a pose; none when anything in it is not finite, or a variance negative.

        Their stamp is the time for which the pose holds, on the clock that TIMESYNC is answered with.

        Args:
            pose: in the map.
            map_heading: compass heading of the map's x axis [rad].
            table: which messages, and what of the pose the autopilot uses.
            reset_counter: 0 to 255, grows with every jump.
            quality: 1 to 100 [%].
        """
        covs = [pose.cov] if pose.velocity_cov is None else [pose.cov, pose.velocity_cov]
        if any((np.diag(cov) < 0.0).any() for cov in covs):
            return []
        pose = replace(pose, cov=reported_covariance(pose.cov, table))
        parts = [pose.T_map_body, pose.cov, pose.velocity, pose.velocity_cov]
        if not all(np.isfinite(part).all() for part in parts if part is not None):
            return []
        ned, usec = to_ned(pose, map_heading), pose.stamp_ns // 1000
        covariance = ned.cov[UPPER].tolist() if table.covariance == "full" else _UNKNOWN
        if table.message == "odometry":
            return [self._odometry(ned, usec, table, covariance, reset_counter, quality)]
        angles = ned.roll_pitch_yaw.tolist() if table.heading else [nan] * 3
        position = ned.position.tolist()
        messages = [
            mavlink2.MAVLink_vision_position_estimate_message(
                usec, *position, *angles, covariance, reset_counter
            )
        ]
        if table.speed and self.takes_speed and ned.velocity is not None and ned.velocity_cov is not None:
            speed_cov = _UNKNOWN_SPEED
            if table.covariance == "full":
                speed_cov = _floored(ned.velocity_cov).ravel().tolist()
            speed = ned.velocity.tolist()
            messages.append(
                mavlink2.MAVLink_vision_speed_estimate_message(usec, *speed, speed_cov, reset_counter)
            )
        return messages

    def _odometry(
        self,
        ned: NedPose,
        usec: int,
        table: MavlinkTable,
        covariance: list[float],
        reset_counter: int,
        quality: int,
    ) -> MavlinkMessage:
        """ODOMETRY with the velocity in body axes; NaN where there is none, for zeros would be fused."""
        velocity, velocity_covariance = [nan] * 3, _UNKNOWN
        if ned.velocity is not None and ned.velocity_cov is not None and table.heading:
            R_body_ned = ned.rotation.T
            velocity = (R_body_ned @ ned.velocity).tolist()
            full = np.diag(np.full(6, UNKNOWN_YAW_VARIANCE))
            full[:3, :3] = _floored(R_body_ned @ ned.velocity_cov @ R_body_ned.T)
            if table.covariance == "full":
                velocity_covariance = full[UPPER].tolist()
        return mavlink2.MAVLink_odometry_message(
            usec,
            self.odometry_frame,
            mavlink2.MAV_FRAME_BODY_FRD,
            *ned.position.tolist(),
            _quaternion(ned) if table.heading else [nan] * 4,
            *velocity,
            nan,
            nan,
            nan,
            covariance,
            velocity_covariance,
            reset_counter,
            # PX4 refuses LIDAR; VISION is taken by both.
            mavlink2.MAV_ESTIMATOR_TYPE_VISION,
            quality,
        )


PROFILES = {
    "ardupilot": Profile("ardupilot", 20_000_000, mavlink2.MAV_FRAME_LOCAL_FRD, takes_speed=True),
    "px4": Profile("px4", 0, mavlink2.MAV_FRAME_LOCAL_NED, takes_speed=False),
}


def profile_of(table: MavlinkTable, autopilot: int | None) -> Profile | None:
    """The profile that the settings name, or that the autopilot's HEARTBEAT asks for; None before that.

    Args:
        table: settings.
        autopilot: MAV_AUTOPILOT of the autopilot, None before it was heard.
    """
    if table.profile != "auto":
        return PROFILES[table.profile]
    if autopilot is None:
        return None
    # An autopilot of another make gets what is safe for both.
    return PROFILES["px4" if autopilot == mavlink2.MAV_AUTOPILOT_PX4 else "ardupilot"]


def reported_covariance(cov: FloatArray, table: MavlinkTable) -> FloatArray:
    """Covariance (6, 6) as it is sent: finite, positive, and sane when it is reduced to one number.

    ArduPilot makes one position error of the three variances, and one angle error of the other three
    (before 2026 as ``cbrt(x^2 + y^2 + z^2)``, then as ``sqrt(x + y + z)``), whichever of them it uses. So a
    height that it does not use must not make x and y look worse than they are.

    Args:
        cov: of position [m] and angles [rad]; the plane may be that of the map or of NED.
        table: what of the pose the autopilot uses.
    """
    cov = cov.copy()
    if not table.heading:
        cov[5, :] = cov[:, 5] = 0.0
        cov[5, 5] = UNKNOWN_YAW_VARIANCE
    widest = max(cov[0, 0], cov[1, 1])
    if not table.height and cov[2, 2] > widest:
        # Row and column alike, so that it stays a covariance.
        shrink = np.sqrt(widest / cov[2, 2])
        cov[2, :] *= shrink
        cov[:, 2] *= shrink
    return _floored(cov)


def _floored(cov: FloatArray) -> FloatArray:
    floored = cov.copy()
    np.fill_diagonal(floored, np.maximum(np.diag(cov), LEAST_VARIANCE))
    return floored


def _quaternion(ned: NedPose) -> list[float]:
    """w, x, y, z; normalised in double precision, for PX4 drops what is off by more than 1e-5."""
    half = ned.roll_pitch_yaw / 2.0
    (cr, cp, cy), (sr, sp, sy) = np.cos(half).tolist(), np.sin(half).tolist()
    return [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]
