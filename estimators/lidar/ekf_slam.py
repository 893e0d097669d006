"""Motion from scans: an extended Kalman filter on the robot's pose and the walls, corners and poles round it.

The four stages are pose prediction, observation, update with data association, and state augmentation. A beam
is taken from where the body is at the beam's own instant, as in scan matching. What goes out is what scans
say: the motion model's share is taken out again, and a direction that no feature holds comes out wide.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from pydantic import Field

from estimators.geometry import inverse, transform, transform_each
from estimators.lidar.feature_association import NEW, NONE, Matches, match_spots, match_walls, unite_doubles
from estimators.lidar.feature_map import FeatureMap, Kind
from estimators.lidar.features import Features, find_features
from estimators.lidar.scan_fit import LEAST_INFORMATION, UNKNOWN_SPEED_SIGMA
from estimators.lidar.scan_preparation import LEAST_GAP_NS, PreparedScan, ScanPreparation
from estimators.lidar.sightings import STATES, Rows, SpotSightings, WallSightings
from estimators.messages import FloatArray, IntArray, Measurement, PoseIncrement, Scan
from estimators.models.motion import constant_velocity, cubic_between, smooth_motion
from estimators.models.motion_settings import MotionInScans

LOST_SIGMA = np.array([1.0, 0.35])
"""With a prediction less certain than this [m] in every direction, or than this in yaw [rad], features are
not told apart and linearising means nothing."""
TRIED = 3
"""A feature that was seen less often ..."""
FORGOTTEN = 10
"""... and not in so many scans is not believed."""


class EkfSlam:
    """Turns scans into increments of the body pose, through a map of features.

    Source: chen2019, section on EKF-SLAM (four stages, displacement and rotation out); its formulas are lost,
    they are chosen here. Decorrelation: Bar-Shalom et al., Tracking and Data Fusion, 9.5.
    """

    class Config(MotionInScans):
        """Settings of the EKF-SLAM."""

        max_features: int = Field(
            60,
            ge=4,
            le=1000,
            description="of more features those that were not seen for longest are forgotten",
        )
        keyframe_distance: float = Field(
            1.0, gt=0, le=5, description="increments start anew after this much travel [m]"
        )
        keyframe_angle_deg: float = Field(45.0, gt=0, le=180, description="... or this much turn [deg]")
        min_known_share: float = Field(
            0.3,
            gt=0,
            le=1,
            description="with a smaller share of points on walls that are known, tracking begins anew",
        )
        stamp_sigma_ms: float = Field(
            3.0,
            ge=0,
            le=100,
            description="standard deviation of the scans' constant latency; 1 when calibrated [ms]",
        )

    def __init__(
        self, config: Config, T_body_lidar: FloatArray, preparation: ScanPreparation.Config | None = None
    ) -> None:
        """Start without a map.

        Args:
            config: settings.
            T_body_lidar: (3,) mounting of the lidar in the body: x [m], y [m], yaw [rad].
            preparation: what is done with the points beforehand; by default what its Config says.
        """
        # Numba loads slowly: here, and not at the first scan.
        import estimators.kernels.scan_fit  # noqa: F401

        self._config = config
        self._T_body_lidar = T_body_lidar
        self._preparation = ScanPreparation(preparation or ScanPreparation.Config(), T_body_lidar)
        self.map: FeatureMap | None = None
        """Motion and features as estimated; None before the first feature."""
        self._keyframe_ns = self._stamp_ns = 0
        self._keyframe_velocity = np.zeros(3)
        self._keyframe_is_blind = False
        self.points = np.empty((0, 2))
        """(N, 2) [m] of the newest scan, as seen from where the body is at its end."""
        self.points_cov = np.zeros((3, 3))
        """(3, 3) where among these points the body was: x, y [m], yaw [rad]."""
        self.refused = 0
        """Scans in which too little was known again, so that tracking began anew."""

    @property
    def landmarks(self) -> FloatArray:
        """(N, 2) [m] believed corners and poles, in the body frame at the end of the newest scan."""
        here = self.map
        if here is None:
            return np.empty((0, 2))
        believed = (here.kinds != Kind.WALL) & (here.sightings >= TRIED)
        return transform(inverse(here.pose), here.features[believed])

    def update(self, measurement: Measurement) -> PoseIncrement | None:
        """Take a scan through the four stages; of other measurements, remember what the preparation needs.

        Returns:
            The increment from the newest keyframe to the end of this scan. The first scan, and a scan after
            tracking was lost, founds a keyframe instead (`from_stamp_ns == stamp_ns`). None for a scan with
            too few returns or without features, and for one that is not newer than the last.
        """
        if not isinstance(measurement, Scan):
            self._preparation.observe(measurement)
            return None
        stamp_ns = measurement.end_stamp_ns
        if self.map is not None and stamp_ns < self._stamp_ns + LEAST_GAP_NS:
            return None
        scan = self._preparation.prepare(measurement)
        if len(scan.points) < self._config.min_points:
            return None
        return self._begin(scan) if self.map is None else self._track(scan, self.map)

    def _begin(self, scan: PreparedScan) -> PoseIncrement | None:
        """Found a map where nothing is known of the motion."""
        dt = max(-float(scan.times[0]), LEAST_GAP_NS * 1e-9)
        back, _ = constant_velocity(-dt, 0.0, 0.0)
        both = np.vstack([back, np.eye(6)])
        here = FeatureMap(np.zeros(STATES), both @ np.diag([0.0] * 3 + [UNKNOWN_SPEED_SIGMA**2] * 3) @ both.T)
        look = _Look(scan, here.states, dt, self._T_body_lidar, self._config.range_sigma)
        if not look.has_features:
            return None
        look.augment(here, look.all_new())
        _forget(here, self._config.max_features)
        self.map = here
        self._keyframe_ns = self._stamp_ns = scan.stamp_ns
        self._keyframe_velocity = np.zeros(3)
        self._keyframe_is_blind = True
        self.points, self.points_cov = look.seen_from_end(here)
        return PoseIncrement(scan.stamp_ns, scan.stamp_ns, np.zeros(3), np.zeros((3, 3)), is_keyframe=True)

    def _track(self, scan: PreparedScan, here: FeatureMap) -> PoseIncrement | None:
        config = self._config
        dt = (scan.stamp_ns - self._stamp_ns) * 1e-9
        F, Q = smooth_motion(dt, config.accel_noise, config.yaw_accel_noise, config.bandwidth)
        now = here.states[6:]
        look = _Look(scan, np.concatenate([now, F @ now]), dt, self._T_body_lidar, config.range_sigma)
        if not look.has_features:
            return None
        here.predict(F, Q)
        expected = here.pose_cov.copy()
        matches = look.match(here)
        if _is_lost(expected) or look.known_share(matches) < config.min_known_share:
            self.refused += 1
            self.map = None
            return self._begin(scan)
        matches = look.reconciled(here, matches)
        look.correct(here, matches)
        increment, cov = here.pose.copy(), _said_by_scan(expected, here.pose_cov)
        # A late stamp does nothing to a motion that goes on as it was at the keyframe.
        change = here.states[9:] - self._carried(here.pose)
        cov += (1e-3 * config.stamp_sigma_ms) ** 2 * np.outer(change, change)
        look.note(here, matches)
        look.augment(here, matches)
        _forget(here, config.max_features)
        self.points, self.points_cov = look.seen_from_end(here)

        is_keyframe = self._keyframe_is_blind or self._moved_far(here.pose)
        found = PoseIncrement(self._keyframe_ns, scan.stamp_ns, increment, cov, is_keyframe)
        self._stamp_ns = scan.stamp_ns
        if is_keyframe:
            here.move_origin()
            self._keyframe_ns, self._keyframe_is_blind = scan.stamp_ns, False
            self._keyframe_velocity = here.states[9:].copy()
        return found

    def _carried(self, pose: FloatArray) -> FloatArray:
        """Velocity (3,) of a point at the pose that goes on with the body as it moved at the keyframe."""
        forward, left, rate = self._keyframe_velocity
        return np.array([forward - rate * pose[1], left + rate * pose[0], rate])

    def _moved_far(self, pose: FloatArray) -> bool:
        return bool(
            np.hypot(pose[0], pose[1]) > self._config.keyframe_distance
            or abs(pose[2]) > np.deg2rad(self._config.keyframe_angle_deg)
        )


class _Look:
    """What one scan shows, deskewed by the predicted states."""

    def __init__(
        self,
        scan: PreparedScan,
        states: FloatArray,
        dt: float,
        T_body_lidar: FloatArray,
        range_sigma: float,
    ) -> None:
        self._scan = scan
        self._basis = cubic_between(1.0 + scan.times / dt, dt)
        poses = self._basis @ states.reshape(4, 3)
        points = transform_each(poses, scan.points)
        self._found: Features = find_features(
            points, transform_each(poses, T_body_lidar[None, :2]), range_sigma
        )
        self._walls = WallSightings.of(self._found.walls, scan.points, self._basis)
        self._spots = {
            Kind.CORNER: SpotSightings.of(self._found.corners, self._basis, states),
            Kind.POLE: SpotSightings.of(self._found.poles, self._basis, states),
        }

    @property
    def has_features(self) -> bool:
        return bool(len(self._walls.size) or any(len(spots.points) for spots in self._spots.values()))

    def all_new(self) -> dict[Kind, Matches]:
        """As if the map knew none of the features."""
        counts = {Kind.WALL: len(self._walls.size)}
        counts |= {kind: len(spots.points) for kind, spots in self._spots.items()}
        return {
            kind: Matches(np.full(count, NEW), np.zeros(count, bool), []) for kind, count in counts.items()
        }

    def match(self, here: FeatureMap) -> dict[Kind, Matches]:
        """Hold every sighting against the map."""
        walls = match_walls(here, self._found.walls, self._walls)
        if unite_doubles(here, walls.doubles):
            walls = match_walls(here, self._found.walls, self._walls)
        found = {Kind.WALL: walls}
        for kind, spots in self._spots.items():
            matches = match_spots(here, kind, spots)
            # A wall may be seen in parts, but no corner or pole twice.
            times = np.bincount(matches.feature[matches.feature >= 0], minlength=len(here.kinds))
            twice = (matches.feature >= 0) & (times[matches.feature] > 1)
            found[kind] = replace(matches, feature=np.where(twice, NONE, matches.feature))
        return found

    def known_share(self, matches: dict[Kind, Matches]) -> float:
        """Share of the points on walls that are of known walls; of spots where there are no walls."""
        if len(self._walls.size):
            return float(self._walls.size[matches[Kind.WALL].known].sum() / self._walls.size.sum())
        return float(np.concatenate([matches[kind].known for kind in self._spots]).mean())

    def reconciled(self, here: FeatureMap, matches: dict[Kind, Matches]) -> dict[Kind, Matches]:
        """Associations that fit together; what does not fit is taken for new."""
        while any((of_kind.feature >= 0).any() for of_kind in matches.values()):
            misfit = here.misfit(self._rows(here, matches)())
            if misfit is None:
                break
            matches = {
                kind: replace(of_kind, feature=np.where(of_kind.feature == misfit, NEW, of_kind.feature))
                for kind, of_kind in matches.items()
            }
        return matches

    def correct(self, here: FeatureMap, matches: dict[Kind, Matches]) -> None:
        """Stages 2 and 3: iterated update with all sightings of known features."""
        here.correct(self._rows(here, matches))

    def _rows(self, here: FeatureMap, matches: dict[Kind, Matches]) -> Callable[[], Rows]:
        """What gives the rows of all sightings of known features at the map's present mean."""
        walls, wall_of = _known(matches[Kind.WALL])
        sightings = self._walls.chosen(walls)
        spots: list[tuple[SpotSightings, IntArray, int]] = []
        for kind, seen in self._spots.items():
            which, feature = _known(matches[kind])
            # Across a wall, the wall says all there is to say of its corner.
            spots.append((seen.chosen(which), feature, 1 if kind is Kind.CORNER else 2))

        def look() -> Rows:
            features = here.features
            rows = sightings.rows(here.states, wall_of, features[wall_of], here.anchors[wall_of])
            for seen, feature, directions in spots:
                rows += seen.rows(here.states, feature, features[feature], directions)
            return rows

        return look

    def note(self, here: FeatureMap, matches: dict[Kind, Matches]) -> None:
        """Remember what was seen of known features."""
        for kind, of_kind in matches.items():
            which, feature = _known(of_kind)
            here.unseen[feature] = 0
            here.sightings[np.unique(feature)] += 1
            if kind is Kind.WALL:
                walls, theta = self._found.walls, here.features[feature, 0]
                off = walls.centre[which] - here.anchors[feature]
                along = np.cos(theta) * off[:, 1] - np.sin(theta) * off[:, 0]
                np.minimum.at(here.extents[:, 0], feature, along + walls.low[which])
                np.maximum.at(here.extents[:, 1], feature, along + walls.high[which])

    def augment(self, here: FeatureMap, matches: dict[Kind, Matches]) -> None:
        """Stage 4: put what is new into the map."""
        new = np.flatnonzero(matches[Kind.WALL].feature == NEW)
        if len(new):
            walls, index = self._found.walls, np.zeros(len(new), dtype=np.int64)
            values = np.column_stack([walls.angle[new], np.zeros(len(new))])
            extents = np.column_stack([walls.low[new], walls.high[new]])
            rows = self._walls.chosen(new).rows(here.states, index, values, walls.centre[new])
            here.add(Kind.WALL, values, walls.centre[new], extents, rows)
        for kind, spots in ((Kind.CORNER, self._found.corners), (Kind.POLE, self._found.poles)):
            new = np.flatnonzero(matches[kind].feature == NEW)
            if len(new):
                rows = (
                    self._spots[kind]
                    .chosen(new)
                    .rows(here.states, np.zeros(len(new), dtype=np.int64), spots.position[new])
                )
                nothing = np.zeros((len(new), 2))
                here.add(kind, spots.position[new], nothing, nothing, rows)

    def seen_from_end(self, here: FeatureMap) -> tuple[FloatArray, FloatArray]:
        """Points (N, 2) in the body frame at the end, and covariance (3, 3) of where among them it was."""
        seen = transform_each(self._basis @ here.states.reshape(4, 3), self._scan.points)
        weights = -self._basis.mean(axis=0)
        weights[2] += 1.0
        H = np.kron(weights, np.eye(3))
        return transform(inverse(here.pose), seen), H @ here.cov[:STATES, :STATES] @ H.T


def _known(matches: Matches) -> tuple[IntArray, IntArray]:
    """Sightings of known features, and which these are."""
    which = np.flatnonzero(matches.feature >= 0)
    return which, matches.feature[which]


def _is_lost(expected: FloatArray) -> bool:
    """Whether a pose with this covariance (3, 3) tells nothing of where features should be seen."""
    least = float(np.linalg.eigvalsh(expected[:2, :2])[0])
    return bool(least > LOST_SIGMA[0] ** 2 or expected[2, 2] > LOST_SIGMA[1] ** 2)


def _said_by_scan(expected: FloatArray, cov: FloatArray) -> FloatArray:
    """Covariance (3, 3) of the pose as the scan says it without the prediction.

    What no feature holds goes on as predicted, and is a metre less certain than that. The pose itself stays
    the filter's: so errors of one increment are made good by the next.

    Args:
        expected: (3, 3) covariance before the update.
        cov: (3, 3) after it.
    """
    least = np.linalg.inv(expected + np.eye(3) / LEAST_INFORMATION)
    said = np.linalg.inv(np.linalg.inv(cov) - np.linalg.inv(expected) + least)
    return 0.5 * (said + said.T)


def _forget(here: FeatureMap, most: int) -> None:
    """Leave out what was seen once by mistake, and of too many features those not seen for longest."""
    kept = np.flatnonzero((here.sightings >= TRIED) | (here.unseen <= FORGOTTEN))
    if len(kept) > most:
        kept = np.sort(kept[np.argsort(here.unseen[kept], kind="stable")[:most]])
    if len(kept) < len(here.kinds):
        here.keep(kept)
