"""Motion from scans: point-to-line matching of each scan against a keyframe, in continuous time.

A beam is taken from where the body is at the beam's own instant. Pose and velocity at the end of the scan
before and at the end of this one are estimated together; between them the body follows a cubic. So a scan is
deskewed by what it says itself of the motion during it.

What goes out is what the scan says alone: the motion model's share is taken out of pose and covariance
again, and a direction that no wall holds comes out wide.
"""

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from estimators.geometry import inverse, rotation, transform, transform_each, wrap_angle
from estimators.lidar.scan_preparation import PreparedScan, ScanPreparation
from estimators.messages import FloatArray, Measurement, PoseIncrement, Scan
from estimators.models.motion import cubic_between, smooth_motion

if TYPE_CHECKING:
    from estimators.lidar.line_map import LineMap

UNKNOWN_SPEED_SIGMA = 1.0
"""Standard deviation of each velocity [m/s, rad/s] before the first match."""
HELD_RATIO = 5.0
"""Walls hold a direction when a scan says so many times more of it than noise of the normals feigns."""
LEAST_INFORMATION = 1.0
"""Information [1/m^2, 1/rad^2] that every direction has: what nothing observes comes out with sigma 1."""
KEYFRAME_SHARE = 0.7
"""When a smaller share of the surface points is matched, too little of the keyframe is still in view."""
LEAST_MATCHED = 10
"""With fewer matched points there is no match."""
CONVERGED = 1e-4
"""A step of the pose that is smaller [m, rad] is the last."""
MOST_ITERATIONS = 20
MOST_STEPS = np.array([3, 3, 20])
"""So many steps are searched at most to either side along x, y and in yaw."""
STARTING_POINTS = 100
"""With about so many points the start of a match is looked for."""

_LEAST_VARIANCE = 1e-9
"""Of a pose [m^2, rad^2], so that no covariance is singular."""
_NEWEST = np.arange(6, 9)
_OTHERS = np.delete(np.arange(12), _NEWEST)


@dataclass(frozen=True, slots=True, eq=False)
class _Match:
    """A scan in place: both states (12,), covariance of the newer (6, 6), increment and its covariance.

    The share is that of the surface points that are matched.
    """

    states: FloatArray
    cov: FloatArray
    increment: FloatArray
    increment_cov: FloatArray
    share: float


class ScanMatcher:
    """Turns scans into increments of the body pose.

    Source: Censi, "An ICP variant using a point-to-line metric", ICRA 2008, for the metric; "An accurate
    closed-form estimate of ICP's covariance", ICRA 2007, for the share of the keyframe's noise; Anderson and
    Barfoot, "Full STEAM ahead", IROS 2015, for states in continuous time.
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
            0.5, gt=0, le=1, description="a match with a smaller share of matched surface points is refused"
        )
        min_points: int = Field(40, ge=10, le=10000, description="scans with fewer returns are skipped")
        accel_noise: float = Field(
            0.5,
            gt=0,
            le=100,
            description="density of white acceleration [m/s^2/sqrt(Hz)]: about the robot's acceleration "
            "times the square root of how long it lasts",
        )
        yaw_accel_noise: float = Field(
            1.5,
            gt=0,
            le=100,
            description="density of white angular acceleration [rad/s^2/sqrt(Hz)], likewise",
        )
        bandwidth: float = Field(
            2.0,
            gt=0,
            le=50,
            description="the fastest swaying, as of a gait, that scans are deskewed for [Hz]",
        )
        stamp_sigma_ms: float = Field(
            1.0, ge=0, le=100, description="standard deviation of a scan's stamp [ms]"
        )

    def __init__(
        self, config: Config, T_body_lidar: FloatArray, preparation: ScanPreparation.Config | None = None
    ) -> None:
        """Start without a keyframe.

        Args:
            config: settings.
            T_body_lidar: (3,) mounting of the lidar in the body: x [m], y [m], yaw [rad].
            preparation: what is done with the points beforehand; by default what its Config says.
        """
        # Numba loads slowly: only who makes a matcher waits for it.
        from estimators.lidar import line_map

        self._line_map = line_map
        self._config = config
        self._T_body_lidar = T_body_lidar
        self._preparation = ScanPreparation(preparation or ScanPreparation.Config(), T_body_lidar)
        self._keyframe: LineMap | None = None
        self._keyframe_ns = 0
        self._keyframe_is_blind = False
        self._stamp_ns = 0
        self._state = np.zeros(6)
        self._cov = np.zeros((6, 6))
        self.points = np.empty((0, 2))
        """(N, 2) [m] of the newest scan, as seen from where the body is at its end."""
        self.points_cov = np.zeros((3, 3))
        """(3, 3) where among the points of the newest keyframe the body was: x, y [m], yaw [rad]."""
        self.refused = 0
        """Scans that could not be matched, so that odometry began anew."""

    def update(self, measurement: Measurement) -> PoseIncrement | None:
        """Match a scan; of other measurements, remember what the preparation needs.

        Returns:
            The increment from the keyframe to the end of this scan. The first scan, and a scan after
            tracking was lost, founds a keyframe instead (`from_stamp_ns == stamp_ns`). None for a scan
            with too few returns, and for one that is not newer than the last.
        """
        if not isinstance(measurement, Scan):
            self._preparation.observe(measurement)
            return None
        stamp_ns = measurement.end_stamp_ns
        if self._keyframe is not None and stamp_ns <= self._stamp_ns:
            return None
        scan = self._preparation.prepare(measurement)
        if len(scan.points) < self._config.min_points:
            return None
        if self._keyframe is None:
            return self._begin(scan)
        match = self._match(scan, self._keyframe)
        if match is None:
            self.refused += 1
            return self._begin(scan)

        self._stamp_ns, self._state, self._cov = stamp_ns, match.states[6:], match.cov
        # A keyframe that was taken without knowing the speed is distorted, so it is left at once.
        is_keyframe = self._keyframe_is_blind or self._moved_far() or match.share < KEYFRAME_SHARE
        cov = match.increment_cov + self.points_cov
        increment = PoseIncrement(self._keyframe_ns, stamp_ns, match.increment, cov, is_keyframe)
        if is_keyframe:
            self._found_keyframe(is_blind=False)
        return increment

    def _begin(self, scan: PreparedScan) -> PoseIncrement:
        """Found a keyframe where nothing is known of the motion."""
        self._stamp_ns, self.points = scan.stamp_ns, scan.points
        self._state = np.zeros(6)
        # The points are displaced by up to half of the way during the scan, which is not known.
        displaced = -0.5 * UNKNOWN_SPEED_SIGMA * float(scan.times[0])
        self._cov = np.diag([displaced**2 + _LEAST_VARIANCE] * 3 + [UNKNOWN_SPEED_SIGMA**2] * 3)
        self._found_keyframe(is_blind=True)
        return PoseIncrement(scan.stamp_ns, scan.stamp_ns, np.zeros(3), np.zeros((3, 3)), is_keyframe=True)

    def _found_keyframe(self, *, is_blind: bool) -> None:
        """The newest scan is the new keyframe, its pose the new origin.

        The state is from now on that against the points of the keyframe. Where among them the body was at the
        end of the scan is as uncertain as before: the last beams alone tell, and the velocity.
        """
        config = self._config
        self._keyframe = self._line_map.LineMap(self.points, config.range_sigma, config.max_correspondence)
        self._keyframe_ns, self._keyframe_is_blind = self._stamp_ns, is_blind
        turn = np.eye(6)
        turn[:2, :2] = turn[3:5, 3:5] = rotation(-self._state[2])
        self._state = turn @ self._state
        self._state[:3] = 0.0
        self._cov = turn @ self._cov @ turn.T
        self.points_cov = self._cov[:3, :3]

    def _start(
        self,
        keyframe: "LineMap",
        points: FloatArray,
        normals: FloatArray,
        basis: FloatArray,
        predicted: FloatArray,
        doubt: FloatArray,
        dt: float,
    ) -> FloatArray:
        """States (12,) near which the match is looked for: the predicted ones, or what fits best round about.

        The search covers twice the doubt (3,) of the prediction in steps as wide as a point may be off. With
        many scans a second, and walls near by, there is nothing to search.

        Source: Olson, "Real-time correlative scan matching", ICRA 2009.
        """
        reach = self._config.max_correspondence
        far = float(np.percentile(np.hypot(points[:, 0], points[:, 1]), 75))
        steps = reach / np.array([1.0, 1.0, max(far, reach)])
        x, y, yaw = (np.minimum(2.0 * doubt // steps, MOST_STEPS)).astype(int)
        if not (x or y or yaw):
            return predicted
        thin = slice(None, None, -(-len(points) // STARTING_POINTS))
        few, faces, at = (np.ascontiguousarray(column[thin]) for column in (points, normals, basis))
        best, best_score = predicted, -1.0
        for offset in sorted(product(range(-x, x + 1), range(-y, y + 1), range(-yaw, yaw + 1)), key=_size):
            states = predicted.copy()
            states[_NEWEST] += steps * offset
            # The acceleration that leads there is constant.
            states[9:] += steps * offset * (2.0 / dt)
            rows, index = keyframe.match(few, faces, at, states)
            score = float((1.0 / (1.0 + (rows[index >= 0, 0] * (4.0 / reach)) ** 2)).sum())
            if score > best_score:
                best, best_score = states, score
        return best

    def _moved_far(self) -> bool:
        return bool(
            np.hypot(self._state[0], self._state[1]) > self._config.keyframe_distance
            or abs(self._state[2]) > np.deg2rad(self._config.keyframe_angle_deg)
        )

    def _match(self, scan: PreparedScan, keyframe: "LineMap") -> _Match | None:
        """Gauss-Newton on both states; leaves the deskewed points in `points` when it succeeds."""
        config, sigma = self._config, self._config.range_sigma
        dt = (scan.stamp_ns - self._stamp_ns) * 1e-9
        every_basis = cubic_between(1.0 + scan.times / dt, dt)
        found = self._line_map.surface(scan.points, sigma)
        points, normals, basis = found.points, found.normals, every_basis[found.own]
        if len(points) < LEAST_MATCHED:
            return None

        # A range errs along its beam, a distance from a wall by the part of that which is square to it.
        beams = points - self._T_body_lidar[:2]
        least_variance = sigma**2 * float(
            ((beams * normals).sum(axis=1) ** 2 / (beams**2).sum(axis=1)).mean()
        )

        F, Q = smooth_motion(dt, config.accel_noise, config.yaw_accel_noise, config.bandwidth)
        motion = np.hstack([-F, np.eye(6)])
        prior = motion.T @ np.linalg.solve(Q, motion)
        prior[:6, :6] += np.linalg.inv(self._cov)
        predicted = np.concatenate([self._state, F @ self._state])

        doubt = np.sqrt(np.diag(F @ self._cov @ F.T + Q)[:3])
        states = self._start(keyframe, points, normals, basis, predicted, doubt, dt)
        for _ in range(MOST_ITERATIONS):
            rows, index = keyframe.match(points, normals, basis, states)
            distances = np.abs(rows[index >= 0, 0])
            if len(distances) < LEAST_MATCHED:
                return None
            # Cauchy weight; its scale is the noise of two scans, or what the distances say when larger.
            middle = len(distances) // 2
            scale = max(2.0 * sigma, 1.5 * float(np.partition(distances, middle)[middle]))
            sums = keyframe.sums(basis, rows, index, scale)
            held = held_directions(sums.pose_hessian, sums.feigned)
            of_all = np.zeros((12, 12))
            for k in range(0, 12, 3):
                of_all[k : k + 3, k : k + 3] = held
            # Half of the squares is noise of the keyframe, which does not average out from scan to scan.
            variance = max(least_variance, 0.5 * sums.squares / sums.weight)
            posterior = prior + of_all @ sums.hessian @ of_all / variance
            gradient = of_all @ sums.gradient / variance + prior @ (states - predicted)
            # What nothing holds goes on as predicted; else the least doubt of its direction would move it.
            step = of_all @ np.linalg.solve(posterior, -gradient)
            states = states + step
            if float(np.abs(step[_NEWEST]).max()) < CONVERGED:
                break
        share = len(distances) / len(points)
        wandered = config.accel_noise * np.sqrt(dt**3 / 3.0)
        # A bare wall looks the same everywhere: after a long gap it is only known to be one when all fits.
        is_another = wandered > config.max_correspondence and np.linalg.matrix_rank(held, tol=0.5) < 3
        if share < config.min_inlier_share or is_another:
            return None

        poses = every_basis @ states.reshape(4, 3)
        in_keyframe = transform_each(poses, scan.points)
        self.points = transform(inverse(states[_NEWEST]), in_keyframe)
        increment, cov = _said_by_scan(prior, posterior, states, predicted, held)
        gain = np.linalg.pinv(held @ sums.pose_hessian @ held, rcond=1e-9, hermitian=True)
        keyframe_cov = variance * gain @ keyframe.gradient_noise(sums.by_line) @ gain.T
        velocity = states[9:]
        cov += keyframe_cov + (1e-3 * config.stamp_sigma_ms) ** 2 * np.outer(velocity, velocity)
        cov_of_states = np.linalg.inv(posterior)[6:, 6:]
        return _Match(states, 0.5 * (cov_of_states + cov_of_states.T), increment, 0.5 * (cov + cov.T), share)


def _said_by_scan(
    prior: FloatArray, posterior: FloatArray, states: FloatArray, predicted: FloatArray, held: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Increment (3,) and covariance (3, 3) without what the motion model added.

    Source: Bar-Shalom et al., Tracking and Data Fusion, 9.5: tracklets by decorrelation.
    """
    expected, known = _marginal(prior), _marginal(posterior)
    cov = np.asarray(np.linalg.inv(known - expected + LEAST_INFORMATION * np.eye(3)), dtype=np.float64)
    correction = cov @ known @ (states[_NEWEST] - predicted[_NEWEST])
    increment = predicted[_NEWEST] + correction @ held
    increment[2] = wrap_angle(increment[2])
    return increment, cov


def _size(offset: tuple[int, int, int]) -> int:
    return sum(step * step for step in offset)


def held_directions(pose_hessian: FloatArray, feigned: FloatArray) -> FloatArray:
    """Projection (3, 3) of a change of the pose [m, rad] on what walls hold.

    Along a bare corridor the information is not zero: normals are noisy, so every line seems to hold a
    little. How much that is on average is known; a direction with hardly more than that is held by nothing.

    Args:
        pose_hessian: (3, 3) by the pose, for distances of unit variance.
        feigned: (3, 3) share of it that noise of the normals has on average.

    Source: after Zhang, Kaess and Singh, "On degeneracy of optimization-based state estimation problems",
    ICRA 2016; here noise is the measure.
    """
    root = np.linalg.cholesky(feigned + 1e-9 * np.trace(feigned) * np.eye(3))
    half = np.linalg.solve(root, pose_hessian)
    values, vectors = np.linalg.eigh(np.linalg.solve(root, half.T))
    if values[0] > HELD_RATIO:
        return np.eye(3)
    free, _ = np.linalg.qr(np.linalg.solve(root.T, vectors[:, values <= HELD_RATIO]))
    held: FloatArray = np.eye(3) - free @ free.T
    return held


def _marginal(information: FloatArray) -> FloatArray:
    """Information (3, 3) on the newest pose in that on both states (12, 12)."""
    across = information[np.ix_(_OTHERS, _NEWEST)]
    others = np.linalg.solve(information[np.ix_(_OTHERS, _OTHERS)], across)
    own: FloatArray = information[np.ix_(_NEWEST, _NEWEST)] - across.T @ others
    return own
