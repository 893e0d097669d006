"""The measurements that sensors make and the pose that estimators give.

These types are the contract between drivers, estimators and the process; they need nothing but NumPy.
Every stamp is an ``int`` of nanoseconds on the host's monotonic clock and says when the quantity was
true, not when its bytes arrived. Lengths are metres, angles radians, unless a name says otherwise.
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from estimators.immutable import immutable

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]


@immutable
class RangeFrame:
    """Ranges of one UWB tag to several anchors, taken in one ranging cycle.

    Attributes:
        stamp_ns: measurement time.
        tag_id: id of the tag.
        anchor_ids: (N,) int64, ids as the device reports them.
        ranges: (N,) float64 [m], slant distance from tag antenna to anchor antenna.
        rx_power: (N,) float64 [dBm], power of everything received; NaN where the frame has none.
        fp_power: (N,) float64 [dBm], power of the first path; NaN where the frame has none.
    """

    stamp_ns: int
    tag_id: int
    anchor_ids: IntArray
    ranges: FloatArray
    rx_power: FloatArray
    fp_power: FloatArray


@immutable
class Scan:
    """One revolution of a planar LiDAR.

    Attributes:
        stamp_ns: time of the first beam.
        angles: (N,) float64 [rad], counter-clockwise from the lidar frame's x axis.
        ranges: (N,) float64 [m]; 0 where nothing came back.
        beam_times: (N,) float64 [s] after ``stamp_ns``, ascending.
        quality: (N,) float64, the device's own strength of return, 0 where it gives none.

    Raises:
        ValueError: the columns differ in length; kernels would read past the end of the shortest.
    """

    stamp_ns: int
    angles: FloatArray
    ranges: FloatArray
    beam_times: FloatArray
    quality: FloatArray

    def __post_init__(self) -> None:
        """Refuse columns of different lengths."""
        if not len(self.angles) == len(self.ranges) == len(self.beam_times) == len(self.quality):
            raise ValueError("scan: angles, ranges, beam_times and quality are not equally long")

    @property
    def end_stamp_ns(self) -> int:
        """Time of the last beam."""
        return (
            self.stamp_ns + round(float(self.beam_times[-1]) * 1e9) if len(self.beam_times) else self.stamp_ns
        )


@immutable
class ImuSample:
    """One reading of an inertial sensor, in that sensor's own axes.

    Attributes:
        stamp_ns: measurement time.
        gyro: (3,) float64 [rad/s].
        accel: (3,) float64 [m/s^2], specific force: +9.81 upward when at rest.
    """

    stamp_ns: int
    gyro: FloatArray
    accel: FloatArray


@immutable
class Attitude:
    """Orientation from a device that keeps its own attitude filter.

    Attributes:
        stamp_ns: measurement time.
        quat_wxyz: (4,) float64, unit quaternion of the device in its own local level frame.
    """

    stamp_ns: int
    quat_wxyz: FloatArray


@immutable
class Height:
    """Distance to the ground below a sensor that looks down.

    Attributes:
        stamp_ns: measurement time.
        height: [m], along the sensor's axis.
        sigma: its standard deviation [m].
    """

    stamp_ns: int
    height: float
    sigma: float


@immutable
class PoseIncrement:
    """Planar motion of the body between two instants, as odometry gives it.

    The increment is ``T_body0_body1``: where the body is at ``stamp_ns``, seen from where it was at
    ``from_stamp_ns``. Several increments may start at the same reference (a keyframe).

    Attributes:
        from_stamp_ns: time of the reference pose; equal to ``stamp_ns`` when there is no earlier
            reference and the measurement only founds one.
        stamp_ns: time of the newer pose.
        increment: (3,) float64, x [m], y [m], yaw [rad] in the body frame of the reference pose.
        cov: (3, 3) float64, covariance of ``increment``.
        is_keyframe: True when later increments start at ``stamp_ns``.
    """

    from_stamp_ns: int
    stamp_ns: int
    increment: FloatArray
    cov: FloatArray
    is_keyframe: bool


@immutable
class LoopClosure:
    """Planar motion of the body between two instants long apart: it came back to a place that it knows.

    Attributes:
        from_stamp_ns: time of the older pose; equal to ``stamp_ns`` when the instant founds a place at which
            later closures may begin.
        stamp_ns: time of the newer pose.
        increment: (3,) float64, as in PoseIncrement.
        cov: (3, 3) float64, covariance of ``increment``.
    """

    from_stamp_ns: int
    stamp_ns: int
    increment: FloatArray
    cov: FloatArray


@immutable
class LandmarkFrame:
    """Known landmarks as one look of a LiDAR or camera finds them, each already told from the others.

    Attributes:
        stamp_ns: measurement time.
        landmark_ids: (N,) int64, ids as in `Setup.landmarks`.
        ranges: (N,) float64 [m], horizontal distance from the body's origin to the landmark.
        bearings: (N,) float64 [rad], direction of the landmark in the body frame, counter-clockwise from x.
        range_sigma: standard deviation of every range [m].
        bearing_sigma: standard deviation of every bearing [rad].
    """

    stamp_ns: int
    landmark_ids: IntArray
    ranges: FloatArray
    bearings: FloatArray
    range_sigma: float
    bearing_sigma: float


PLANAR = np.ix_([0, 1, 5], [0, 1, 5])
"""Rows and columns of (x, y, yaw) in the covariance of a PoseEstimate."""


@immutable
class PoseEstimate:
    """Pose of the body in the map with its uncertainty.

    Attributes:
        stamp_ns: time for which the pose holds.
        T_map_body: (4, 4) float64, ``p_map = T_map_body @ p_body``.
        cov: (6, 6) float64, covariance of (x, y, z, roll, pitch, yaw): position along the map axes,
            angles of the ZYX (yaw, pitch, roll) sequence. Infinite variance means "not known".
        reset_counter: grows by one with every discontinuity of the estimate.
        velocity: (3,) float64 [m/s], along the map axes; None where the estimator keeps none.
        velocity_cov: (3, 3) float64, covariance of `velocity`; None as that.
    """

    stamp_ns: int
    T_map_body: FloatArray
    cov: FloatArray
    reset_counter: int
    velocity: FloatArray | None = None
    velocity_cov: FloatArray | None = None

    @property
    def xy(self) -> FloatArray:
        """Horizontal position, (2,) [m], map frame."""
        return self.T_map_body[:2, 3]

    @property
    def yaw(self) -> float:
        """Heading [rad], counter-clockwise from the map's x axis."""
        return float(np.arctan2(self.T_map_body[1, 0], self.T_map_body[0, 0]))

    @property
    def planar_cov(self) -> FloatArray:
        """Covariance of (x, y, yaw), (3, 3)."""
        return self.cov[PLANAR]


Measurement: TypeAlias = (
    RangeFrame | Scan | ImuSample | Attitude | Height | PoseIncrement | LoopClosure | LandmarkFrame
)


def measurement_stamp_ns(measurement: Measurement) -> int:
    """Time at which a measurement is complete: a scan's last beam, everything else its stamp."""
    return measurement.end_stamp_ns if isinstance(measurement, Scan) else measurement.stamp_ns
