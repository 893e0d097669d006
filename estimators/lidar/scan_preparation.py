"""What becomes of a scan before anything is made of it: limits, thinning, levelling, lever arm."""

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from estimators.immutable import immutable
from estimators.messages import Attitude, FloatArray, Measurement, Scan

LEAST_GAP_NS = 1_000_000
"""A scan that ends sooner after the one before is none that a scanner makes."""
MOST_ATTITUDE_AGE = 0.2
"""An older attitude [s] levels no scan."""


@immutable
class PreparedScan:
    """Where beams ended.

    Attributes:
        stamp_ns: time of the last beam, whether it came back or not.
        points: (N, 2) [m] in the order of the beams, each in the level body frame of its own instant.
        times: (N,) [s] of the beams, relative to `stamp_ns` (zero or negative).
        apart: (N,) which of them have the spacing that was asked for between them.
    """

    stamp_ns: int
    points: FloatArray
    times: FloatArray
    apart: NDArray[np.bool_]


class ScanPreparation:
    """Turns the device's polar scans into points of the body frame."""

    class Config(BaseModel):
        """Settings of the preparation."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        min_range: float = Field(0.1, ge=0, le=100, description="nearer returns are the robot itself [m]")
        max_range: float = Field(
            100.0, gt=0, le=1000, description="returns from further away are left out [m]"
        )
        max_points: int = Field(
            2000,
            ge=20,
            le=100_000,
            description="of a scan with more returns every second (third, ...) is left",
        )
        spacing: float = Field(
            0.02,
            ge=0,
            le=1,
            description="between beams where they end, at least [m]: else what is near, as a hand before the "
            "scanner, outweighs the room; for scan matching",
        )
        level: bool = Field(
            False,
            description="bring points to the horizontal by the attitude that a sensor on the body measures",
        )
        max_rise: float = Field(
            0.3,
            gt=0,
            le=10,
            description="with level: returns further above or below the scanner than this are the floor or "
            "another part of a thing, and left out [m]",
        )

    def __init__(self, config: Config, T_body_lidar: FloatArray) -> None:
        """Prepare scans of one scanner.

        Args:
            config: settings.
            T_body_lidar: (3,) mounting of the lidar in the body: x [m], y [m], yaw [rad].
        """
        # Numba loads slowly: only who prepares scans waits for it.
        from estimators.kernels.scan_points import returns

        self._returns = returns
        self._config = config
        self._T_body_lidar = T_body_lidar
        self._attitude: Attitude | None = None

    def observe(self, measurement: Measurement) -> None:
        """Remember the newest attitude, if scans are levelled by it; bad ones say nothing."""
        if (
            self._config.level
            and isinstance(measurement, Attitude)
            and abs(np.linalg.norm(measurement.quat_wxyz) - 1.0) < 0.01
        ):
            self._attitude = measurement

    def prepare(self, scan: Scan) -> PreparedScan:
        """The returns of a scan that are good for anything."""
        config, stamp_ns = self._config, scan.end_stamp_ns
        points, times, apart = self._returns(
            np.ascontiguousarray(scan.angles),
            np.ascontiguousarray(scan.ranges),
            np.ascontiguousarray(scan.beam_times),
            self._T_body_lidar,
            config.min_range,
            config.max_range,
            config.max_points,
            config.spacing,
        )
        if self._attitude is not None:
            age = abs(stamp_ns - self._attitude.stamp_ns) * 1e-9
            if age <= MOST_ATTITUDE_AGE:
                level = points @ _tilt(self._attitude.quat_wxyz)[:, :2].T
                near = np.abs(level[:, 2]) <= config.max_rise
                points, times, apart = np.ascontiguousarray(level[near, :2]), times[near], apart[near]
        return PreparedScan(stamp_ns, points, times, apart)


def _tilt(quat_wxyz: FloatArray) -> FloatArray:
    """`R_level_body` (3, 3): roll and pitch of an attitude, without its heading."""
    w, x, y, z = quat_wxyz / np.linalg.norm(quat_wxyz)
    # Third row of the rotation matrix: where up is in the body.
    up = np.array([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)])
    forward = np.array([1.0, 0.0, 0.0]) - up[0] * up
    forward /= np.linalg.norm(forward)
    return np.array([forward, np.cross(up, forward), up])
