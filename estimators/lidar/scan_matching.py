"""Motion from scans: point-to-line matching of each scan against a keyframe.

Each scan is brought to the instant of its last beam with the velocity just estimated (deskewed), then
matched to the keyframe's points by Gauss-Newton on the distance from point to local line, with a robust
weight. The covariance is the inverse Hessian, so a direction that the walls do not hold comes out wide.
"""

from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial import cKDTree

from estimators.geometry import between, compose, exponential, logarithm, rotation, transform, wrap_angle
from estimators.messages import FloatArray, IntArray, PoseIncrement, Scan

NORMAL_NEIGHBOURS = 5
"""A line is fitted through this many beams to either side of each point."""
LINE_FLATNESS = 0.25
"""A neighbourhood whose thickness exceeds this share of its length is a corner, not a line."""
NEIGHBOUR_GAP = 0.5
"""Neighbouring returns further apart than this [m] belong to different surfaces."""
NOISY_SCANS = 2.0
"""The noise of the scan and that of the keyframe both stand in a residual."""
DESKEW_VARIANCE = 2.5
"""A scan is deskewed with the velocity that two noisy matches gave, which feeds their errors back.

With m_k the error of matching points that need no deskewing, about e_k = 1.5 m_k - e_(k-1) / 4 - e_(k-2) / 4,
whose variance is 2.5 times that of m_k.
"""
LEAST_EIGENVALUE = 1.0
"""Information [1/m^2, 1/rad^2] that every direction has: what nothing observes comes out with sigma 1."""

_LEAST_INFORMATION = LEAST_EIGENVALUE * np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class _Keyframe:
    stamp_ns: int
    points: FloatArray
    normals: FloatArray
    tree: cKDTree


@dataclass(frozen=True, slots=True, eq=False)
class _Match:
    pose: FloatArray
    cov: FloatArray
    inlier_share: float


class ScanMatcher:
    """Turns scans into increments of the body pose.

    Source: Censi, "An ICP variant using a point-to-line metric", ICRA 2008, for the metric; covariance
    from the Gauss-Newton Hessian.
    """

    class Config(BaseModel):
        """Settings of the scan matcher."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        range_sigma: float = Field(
            0.015, gt=0, le=1, description="least standard deviation of a LiDAR range [m]"
        )
        max_correspondence: float = Field(
            0.4, gt=0, le=5, description="points further than this from the keyframe are not matched [m]"
        )
        keyframe_distance: float = Field(
            0.5, gt=0, le=5, description="a new keyframe after this much travel [m]"
        )
        keyframe_angle_deg: float = Field(20.0, gt=0, le=180, description="... or this much turn [deg]")
        min_inlier_share: float = Field(
            0.5, gt=0, le=1, description="a match with a smaller share of matched points is refused"
        )
        min_points: int = Field(40, ge=10, le=10000, description="scans with fewer returns are skipped")

    def __init__(self, config: Config, T_body_lidar: FloatArray) -> None:
        """Start without a keyframe.

        Args:
            config: settings.
            T_body_lidar: (3,) mounting of the lidar in the body: x [m], y [m], yaw [rad].
        """
        self._config = config
        self._T_body_lidar = T_body_lidar
        self._keyframe: _Keyframe | None = None
        self._pose = np.zeros(3)
        self._stamp_ns = 0
        self._twist = np.zeros(3)
        self.refused = 0
        """Scans that could not be matched, so that odometry began anew."""

    def update(self, scan: Scan) -> PoseIncrement | None:
        """Match one scan.

        Returns:
            The increment from the keyframe to the end of this scan. The first scan, and a scan after
            tracking was lost, founds a keyframe instead (`from_stamp_ns == stamp_ns`). None for a scan
            with too few returns, and for one that is not newer than the last.
        """
        stamp_ns = scan.end_stamp_ns
        if self._keyframe is not None and stamp_ns <= self._stamp_ns:
            return None
        valid = np.isfinite(scan.ranges) & (scan.ranges > 0.0)
        if np.count_nonzero(valid) < self._config.min_points:
            return None
        points = self._body_points(scan, valid)
        ages = scan.beam_times[valid] - scan.beam_times[-1]
        if self._keyframe is None:
            return self._found_keyframe(deskew(points, ages, self._twist), stamp_ns)

        dt = (stamp_ns - self._stamp_ns) * 1e-9
        guess = compose(self._pose, exponential(self._twist * dt))
        match = self._match(deskew(points, ages, self._twist), guess)
        # The motion during the scan is only known once it is matched: deskew again with it.
        twist = logarithm(between(self._pose, match.pose)) / dt
        still = deskew(points, ages, twist)
        match = self._match(still, match.pose)
        if match.inlier_share < self._config.min_inlier_share:
            # Nothing is known of the motion any more, least of all from this match.
            self.refused += 1
            self._twist = np.zeros(3)
            return self._found_keyframe(points, stamp_ns)

        self._twist = logarithm(between(self._pose, match.pose)) / dt
        self._pose, self._stamp_ns = match.pose, stamp_ns
        from_stamp_ns = self._keyframe.stamp_ns
        is_keyframe = self._moved_far(match.pose)
        if is_keyframe:
            self._found_keyframe(still, stamp_ns)
        return PoseIncrement(from_stamp_ns, stamp_ns, match.pose, match.cov, is_keyframe)

    def _body_points(self, scan: Scan, valid: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> FloatArray:
        angles, ranges = scan.angles[valid], scan.ranges[valid]
        in_lidar = np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])
        return transform(self._T_body_lidar, in_lidar)

    def _found_keyframe(self, points: FloatArray, stamp_ns: int) -> PoseIncrement:
        lines, normals = line_normals(points)
        self._keyframe = _Keyframe(stamp_ns, points[lines], normals, cKDTree(points[lines]))
        self._pose, self._stamp_ns = np.zeros(3), stamp_ns
        return PoseIncrement(stamp_ns, stamp_ns, np.zeros(3), np.zeros((3, 3)), is_keyframe=True)

    def _moved_far(self, pose: FloatArray) -> bool:
        return bool(
            np.hypot(pose[0], pose[1]) > self._config.keyframe_distance
            or abs(pose[2]) > np.deg2rad(self._config.keyframe_angle_deg)
        )

    def _match(self, points: FloatArray, pose: FloatArray) -> _Match:
        keyframe = self._keyframe
        assert keyframe is not None
        sigma = self._config.range_sigma
        information = _LEAST_INFORMATION
        matched, least_variance = 0, NOISY_SCANS * sigma**2
        for _ in range(20):
            turned = points @ rotation(pose[2]).T
            moved = turned + pose[:2]
            distance, nearest = keyframe.tree.query(
                moved, distance_upper_bound=self._config.max_correspondence
            )
            found = np.isfinite(distance)
            matched = int(np.count_nonzero(found))
            if matched < 3:
                break
            index = np.asarray(nearest)[found]
            normals = keyframe.normals[index]
            residual = ((moved[found] - keyframe.points[index]) * normals).sum(axis=1)
            arm = turned[found]
            jacobian = np.empty((matched, 3))
            jacobian[:, :2] = normals
            jacobian[:, 2] = normals[:, 1] * arm[:, 0] - normals[:, 0] * arm[:, 1]
            # Cauchy weight; its scale is the noise of two scans, or what the residuals say when larger.
            middle = matched // 2
            scale = max(2.0 * sigma, 1.5 * float(np.partition(np.abs(residual), middle)[middle]))
            weight = 1.0 / (1.0 + (residual / scale) ** 2)
            variance = max(least_variance, float((weight * residual**2).sum() / weight.sum()))
            weighted = jacobian * (weight / variance)[:, None]
            information = jacobian.T @ weighted + _LEAST_INFORMATION
            step = np.linalg.solve(information, -weighted.T @ residual)
            pose = np.array([pose[0] + step[0], pose[1] + step[1], wrap_angle(pose[2] + step[2])])
            if float(np.abs(step).max()) < 1e-4:
                break
        cov = DESKEW_VARIANCE * np.asarray(np.linalg.inv(information), dtype=np.float64)
        return _Match(pose, cov, matched / len(points))


def deskew(points: FloatArray, ages: FloatArray, twist: FloatArray) -> FloatArray:
    """Points of a moving body as seen from where it is at the end of the scan.

    Args:
        points: (N, 2) [m], each in the body frame of its own instant.
        ages: (N,) [s], instants relative to the end of the scan (zero or negative).
        twist: (3,) body velocity: forward [m/s], left [m/s], counter-clockwise [rad/s].

    Returns:
        (N, 2) [m], in the body frame at the end of the scan.
    """
    yaw = twist[2] * ages
    c, s = np.cos(yaw), np.sin(yaw)
    # Chord of the arc since the end of the scan, as in geometry.exponential, for every beam at once.
    along = np.sinc(yaw / np.pi) * ages
    across = np.sinc(yaw / (2.0 * np.pi)) * np.sin(yaw / 2.0) * ages
    return np.column_stack(
        [
            c * points[:, 0] - s * points[:, 1] + along * twist[0] - across * twist[1],
            s * points[:, 0] + c * points[:, 1] + across * twist[0] + along * twist[1],
        ]
    )


def line_normals(points: FloatArray) -> tuple[IntArray, FloatArray]:
    """Which points lie on a line with their neighbours, and its unit normal there.

    Args:
        points: (N, 2) [m] in the order of the beams.

    Returns:
        Indices (M,) of such points and their normals (M, 2).
    """
    count = 2 * NORMAL_NEIGHBOURS + 1
    if len(points) < count:
        return np.empty(0, dtype=np.int64), np.empty((0, 2))
    windows = np.lib.stride_tricks.sliding_window_view(points, count, axis=0)
    centred = windows - windows.mean(axis=2, keepdims=True)
    xx, yy = (centred[:, 0] ** 2).mean(axis=1), (centred[:, 1] ** 2).mean(axis=1)
    xy = (centred[:, 0] * centred[:, 1]).mean(axis=1)
    half_trace, half_spread = (xx + yy) / 2.0, np.hypot((xx - yy) / 2.0, xy)
    length, thickness = np.sqrt(half_trace + half_spread), np.sqrt(np.maximum(half_trace - half_spread, 0.0))
    gaps = np.linalg.norm(np.diff(windows, axis=2), axis=1).max(axis=1)
    good = (thickness < LINE_FLATNESS * length) & (gaps < NEIGHBOUR_GAP)
    normal_angle = 0.5 * np.arctan2(2.0 * xy, xx - yy) + np.pi / 2.0
    normals = np.column_stack([np.cos(normal_angle), np.sin(normal_angle)])[good]
    return np.flatnonzero(good) + NORMAL_NEIGHBOURS, normals
