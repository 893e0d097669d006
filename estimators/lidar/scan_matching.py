"""Motion from scans: point-to-line matching of each scan against a keyframe, in continuous time.

A beam is taken from where the body is at the beam's own instant. Pose and velocity at the end of the scan
before and at the end of this one are estimated together; between them the body follows a cubic. So a scan is
deskewed by what it says itself of the motion during it.

What goes out is what the scan says alone: the motion model's share is taken out of pose and covariance
again, and a direction that no wall holds comes out wide.
"""

from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from estimators.geometry import rotation, transform_each
from estimators.lidar.known_motion import GyroTrack, OdometryTrack
from estimators.lidar.scan_fit import UNKNOWN_SPEED_SIGMA, Fit, search_start
from estimators.lidar.scan_preparation import LEAST_GAP_NS, PreparedScan, ScanPreparation
from estimators.messages import FloatArray, ImuSample, Measurement, PoseIncrement, Scan
from estimators.models.motion_settings import MotionInScans

if TYPE_CHECKING:
    from estimators.lidar.line_map import LineMap

KEYFRAME_SHARE = 0.7
"""When a smaller share of the surface points is matched, too little of the keyframe is still in view."""

_LEAST_VARIANCE = 1e-9
"""Of a pose [m^2, rad^2], so that no covariance is singular."""


class ScanMatcher:
    """Turns scans into increments of the body pose.

    Source: Censi, "An ICP variant using a point-to-line metric", ICRA 2008, for the metric; "An accurate
    closed-form estimate of ICP's covariance", ICRA 2007, for the share of the keyframe's noise; Anderson and
    Barfoot, "Full STEAM ahead", IROS 2015, for states in continuous time.
    """

    class Config(MotionInScans):
        """Settings of the scan matcher."""

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
        stamp_sigma_ms: float = Field(
            1.0, ge=0, le=100, description="standard deviation of a scan's stamp [ms]"
        )
        gyro_sigma: float = Field(
            0.0,
            ge=0,
            le=1,
            description="standard deviation of the gyroscope's yaw rate, bias included [rad/s]; its axes are "
            "the body's; 0: no gyroscope is used",
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
        from estimators.lidar import expectation, line_map

        self._expectation, self._line_map = expectation, line_map
        self._config = config
        self._T_body_lidar = T_body_lidar
        self._noise = expectation.MotionNoise(
            config.accel_noise, config.yaw_accel_noise, config.bandwidth, config.gyro_sigma
        )
        self.odometry = OdometryTrack((config.accel_noise, config.yaw_accel_noise))
        """Of others, where there is one."""
        self._gyro = GyroTrack()
        self._preparation = ScanPreparation(preparation or ScanPreparation.Config(), T_body_lidar)
        self._keyframe: LineMap | None = None
        self._keyframe_is_blind = False
        self._stamp_ns = 0
        self._state = np.zeros(6)
        self._cov = np.zeros((6, 6))
        self.keyframe_ns = 0
        """Time of the newest keyframe."""
        self.points = np.empty((0, 2))
        """(N, 2) [m] of the newest scan, as seen from where the body is at its end."""
        self.points_cov = np.zeros((3, 3))
        """(3, 3) where among the points of the newest keyframe the body was: x, y [m], yaw [rad]."""
        self.refused = 0
        """Scans that could not be matched, so that odometry began anew."""

    def update(self, measurement: Measurement) -> PoseIncrement | None:
        """Match a scan; of other measurements, remember what they say of motion and attitude.

        Returns:
            The increment from the keyframe to the end of this scan. The first scan, and a scan after
            tracking was lost, founds a keyframe instead (`from_stamp_ns == stamp_ns`). None for a scan
            with too few returns, and for one that is not newer than the last.
        """
        if not isinstance(measurement, Scan):
            self._observe(measurement)
            return None
        stamp_ns = measurement.end_stamp_ns
        if self._keyframe is not None and stamp_ns < self._stamp_ns + LEAST_GAP_NS:
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
        increment = PoseIncrement(self.keyframe_ns, stamp_ns, match.increment, cov, is_keyframe)
        if is_keyframe:
            self._found_keyframe(is_blind=False)
        return increment

    def forget(self) -> None:
        """The next scan founds a keyframe."""
        self._keyframe = None

    def _observe(self, measurement: Measurement) -> None:
        if isinstance(measurement, ImuSample):
            if self._noise.gyro_sigma:
                self._gyro.add(measurement)
        elif isinstance(measurement, PoseIncrement):
            self.odometry.add(measurement)
        else:
            self._preparation.observe(measurement)

    def _begin(self, scan: PreparedScan) -> PoseIncrement:
        """Found a keyframe where no scan tells of the motion."""
        self._stamp_ns, self.points = scan.stamp_ns, scan.points
        duration = -float(scan.times[0])
        known = self.odometry.motion(scan.stamp_ns - round(duration * 1e9), scan.stamp_ns)
        self._state, self._cov = np.zeros(6), np.zeros((6, 6))
        if known is None:
            # The points are displaced by up to half of the way during the scan, which is not known.
            displaced = 0.5 * UNKNOWN_SPEED_SIGMA * duration
            self._cov = np.diag([displaced**2] * 3 + [UNKNOWN_SPEED_SIGMA**2] * 3)
        else:
            self.points = transform_each(self.odometry.beams(scan.stamp_ns, scan.times), scan.points)
            self._state[3:] = self.odometry.twist()
            self._cov[:3, :3], self._cov[3:, 3:] = known[1] / 3.0, known[1] / max(duration, 1e-3) ** 2
        self._cov += _LEAST_VARIANCE * np.eye(6)
        self._found_keyframe(is_blind=known is None)
        return PoseIncrement(scan.stamp_ns, scan.stamp_ns, np.zeros(3), np.zeros((3, 3)), is_keyframe=True)

    def _found_keyframe(self, *, is_blind: bool) -> None:
        """The newest scan is the new keyframe, its pose the new origin.

        The state is from now on that against the points of the keyframe. Where among them the body was at the
        end of the scan is as uncertain as before: the last beams alone tell, and the velocity.
        """
        config = self._config
        self._keyframe = self._line_map.LineMap(self.points, config.range_sigma, config.max_correspondence)
        self.keyframe_ns, self._keyframe_is_blind = self._stamp_ns, is_blind
        turn = np.eye(6)
        turn[:2, :2] = turn[3:5, 3:5] = rotation(-self._state[2])
        self._state = turn @ self._state
        self._state[:3] = 0.0
        self._cov = turn @ self._cov @ turn.T
        self.points_cov = self._cov[:3, :3]

    def _moved_far(self) -> bool:
        return bool(
            np.hypot(self._state[0], self._state[1]) > self._config.keyframe_distance
            or abs(self._state[2]) > np.deg2rad(self._config.keyframe_angle_deg)
        )

    def _match(self, scan: PreparedScan, keyframe: "LineMap") -> Fit | None:
        """Put a scan where it fits; leaves the deskewed points in `points` when it does."""
        config = self._config
        dt = (scan.stamp_ns - self._stamp_ns) * 1e-9
        expected = self._expectation.expect(
            scan, self._stamp_ns, self._state, self._cov, self._noise, self.odometry, self._gyro
        )
        # Lines go through all points; by count, what is near the scanner would outweigh the room.
        found = self._line_map.surface(expected.points, config.range_sigma, scan.apart)
        if not len(found.points):
            return None
        basis = expected.basis.take(found.own, axis=0)
        prior, predicted, doubt = expected.prior()
        mean, greatest, squarely = found.extent(self._T_body_lidar)
        start = search_start(
            keyframe, found, basis, predicted, doubt, dt, greatest, config.max_correspondence
        )
        spread = min(2.0 * float(max(doubt[0], doubt[1], doubt[2] * mean)), config.max_correspondence)
        # A wall is as far off as the part of a range says that is square to it.
        sigma = config.range_sigma * squarely
        fit = keyframe.settle(found, basis, prior, predicted, start, sigma, spread)
        if fit is None:
            return None
        # A bare wall looks the same everywhere, and half of a room like half of it turned round: after a long
        # gap it is only known to be the one when all fits.
        has_wandered = float(np.sqrt(expected.Q[0, 0])) > config.max_correspondence
        least_share = max(config.min_inlier_share, KEYFRAME_SHARE * has_wandered)
        is_another = has_wandered and np.linalg.matrix_rank(fit.held, tol=0.5) < 3
        if fit.share < least_share or is_another:
            return None

        self.points = expected.seen_from_end(fit.states)
        bent = expected.bent(found.own, fit.rows, fit.index)
        velocity, cov = fit.states[9:], fit.increment_cov
        velocity[:2] += rotation(fit.states[8]) @ expected.twist[:2]
        velocity[2] += expected.twist[2]
        cov += (1e-3 * config.stamp_sigma_ms) ** 2 * np.outer(velocity, velocity) + bent
        fit.cov[:3, :3] += bent
        return fit
