"""What a scan's features say of the motion and of the map: residuals that ought to be zero, with Jacobians.

The states (12,) are pose and velocity at the end of the scan before, and at the end of this one; in between
the body follows a cubic, and every point is taken from where the body was at its own instant.
"""

import numpy as np

from estimators.geometry import transform_each
from estimators.immutable import immutable
from estimators.lidar.features import Spots, Walls
from estimators.messages import FloatArray, IntArray

STATES = 12
NOW = slice(6, 9)
"""Where the newest pose is among the states."""


@immutable
class Rows:
    """Scalar measurements, M of them.

    Attributes:
        residual: (M,) what is zero but for noise [m, rad].
        by_states: (M, 12) derivative by the states.
        by_feature: (M, 2) derivative by the feature.
        feature: (M,) which feature of the map.
        noise: (M,) variances.
        feigned: (M, 3) change of the derivative by the pose with the direction in which is measured, for one
            standard deviation of that.
    """

    residual: FloatArray
    by_states: FloatArray
    by_feature: FloatArray
    feature: IntArray
    noise: FloatArray
    feigned: FloatArray

    def __add__(self, other: "Rows") -> "Rows":
        mine, theirs = self.columns(), other.columns()
        return Rows(*[np.concatenate(pair) for pair in zip(mine, theirs, strict=True)])

    def columns(self) -> tuple[FloatArray, FloatArray, FloatArray, IntArray, FloatArray, FloatArray]:
        """The attributes in their order."""
        return (
            self.residual,
            self.by_states,
            self.by_feature,
            self.feature,
            self.noise,
            self.feigned,
        )


NO_ROWS = Rows(
    np.zeros(0),
    np.zeros((0, STATES)),
    np.zeros((0, 2)),
    np.zeros(0, dtype=np.int64),
    np.zeros(0),
    np.zeros((0, 3)),
)


@immutable
class WallSightings:
    """Walls as this scan saw them, K of them, N points in all.

    Attributes:
        points: (N, 2) [m], each in the body frame of its own instant.
        basis: (N, 4) weights of the states' four vectors in the pose at that instant.
        size: (K,) points of each wall.
        lever: (N,) as of `Walls`.
        noise: (K, 2) as of `Walls`.
    """

    points: FloatArray
    basis: FloatArray
    size: IntArray
    lever: FloatArray
    noise: FloatArray

    @classmethod
    def of(cls, walls: Walls, points: FloatArray, basis: FloatArray) -> "WallSightings":
        """Sightings of walls that were found among points (N, 2), which have these weights (N, 4)."""
        own = walls.points
        return cls(points[own], basis[own], walls.size, walls.lever, walls.noise)

    def chosen(self, which: IntArray) -> "WallSightings":
        """Some of them, by ascending number."""
        own = np.isin(np.repeat(np.arange(len(self.size)), self.size), which)
        return WallSightings(
            self.points[own], self.basis[own], self.size[which], self.lever[own], self.noise[which]
        )

    def rows(self, states: FloatArray, feature: IntArray, wall: FloatArray, anchor: FloatArray) -> Rows:
        """Distance of each wall's points from a wall of the map in the mean, and slope between the two.

        Args:
            states: (12,).
            feature: (K,) which wall of the map each is.
            wall: (K, 2) direction of that wall's normal [rad], and its distance from its anchor [m].
            anchor: (K, 2) [m].

        Returns:
            2 K rows: distance, slope, distance, slope ...
        """
        if not len(self.size):
            return NO_ROWS
        begin = np.cumsum(self.size) - self.size
        own = np.repeat(np.arange(len(self.size)), self.size)
        poses = self.basis @ states.reshape(4, 3)
        points = transform_each(poses, self.points)
        arm_x, arm_y = (points - poses[:, :2]).T
        n = np.column_stack([np.cos(wall[:, 0]), np.sin(wall[:, 0])])[own]
        x, y = (points - anchor[own]).T
        # Columns: distance, position along the wall, derivative by the pose, the turned normal's, by states.
        each = np.empty((len(own), 8 + STATES))
        each[:, 0] = n[:, 0] * x + n[:, 1] * y - wall[own, 1]
        each[:, 1] = n[:, 0] * y - n[:, 1] * x
        each[:, 2:4] = n
        each[:, 4] = n[:, 1] * arm_x - n[:, 0] * arm_y
        each[:, 5], each[:, 6] = -n[:, 1], n[:, 0]
        each[:, 7] = n[:, 0] * arm_x + n[:, 1] * arm_y
        each[:, 8:] = (self.basis[:, :, None] * each[:, None, 2:5]).reshape(-1, STATES)
        means = np.add.reduceat(each, begin, axis=0) / self.size[:, None]
        slopes = np.add.reduceat(each * self.lever[:, None], begin, axis=0)
        both = np.stack([means, slopes], axis=1)
        by_feature = np.stack([both[:, :, 1], np.broadcast_to([-1.0, 0.0], (len(means), 2))], axis=2)
        feigned = both[:, :, 5:8] * [[[1.0], [0.0]]] * np.sqrt(self.noise[:, 1])[:, None, None]
        return Rows(
            both[:, :, 0].ravel(),
            both[:, :, 8:].reshape(-1, STATES),
            by_feature.reshape(-1, 2),
            np.repeat(feature, 2),
            self.noise.ravel(),
            feigned.reshape(-1, 3),
        )


@immutable
class SpotSightings:
    """Corners or poles as this scan saw them, K of them.

    Attributes:
        points: (K, 2) [m], each in the body frame of its own instant.
        basis: (K, 4) weights of the states' four vectors in the pose at that instant.
        axis: (K, 2) as of `Spots`.
        noise: (K, 2) likewise.
        turn: (K,) likewise.
    """

    points: FloatArray
    basis: FloatArray
    axis: FloatArray
    noise: FloatArray
    turn: FloatArray

    @classmethod
    def of(cls, spots: Spots, basis: FloatArray, states: FloatArray) -> "SpotSightings":
        """Sightings of spots that were found in a scan which was deskewed by these states.

        Args:
            spots: K of them.
            basis: (N, 4) weights of the scan's points.
            states: (12,).
        """
        own = basis[spots.beam]
        poses = own @ states.reshape(4, 3)
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        x, y = (spots.position - poses[:, :2]).T
        return cls(np.column_stack([c * x + s * y, c * y - s * x]), own, spots.axis, spots.noise, spots.turn)

    def chosen(self, which: IntArray) -> "SpotSightings":
        """Some of them."""
        columns = (self.points, self.basis, self.axis, self.noise, self.turn)
        return SpotSightings(*[column[which] for column in columns])

    def rows(self, states: FloatArray, feature: IntArray, spot: FloatArray, directions: int = 2) -> Rows:
        """Offset of each from a spot of the map.

        Args:
            states: (12,).
            feature: (K,) which spot of the map each is.
            spot: (K, 2) where that is [m].
            directions: 1 for offsets along `axis` alone, 2 for those square to it too.

        Returns:
            `directions` K rows: along, across, along, across ...
        """
        poses = self.basis @ states.reshape(4, 3)
        arm = transform_each(poses, self.points) - poses[:, :2]
        off = poses[:, :2] + arm - spot
        axes = np.stack([self.axis, np.column_stack([-self.axis[:, 1], self.axis[:, 0]])], axis=1)
        turned = np.stack([axes[:, 1], -axes[:, 0]], axis=1)
        axes, turned = axes[:, :directions], turned[:, :directions]
        by_pose, of_turned = _with_lever(axes, arm), _with_lever(turned, arm)
        by_states = self.basis[:, None, :, None] * by_pose[:, :, None, :]
        return Rows(
            np.einsum("kdi,ki->kd", axes, off).ravel(),
            by_states.reshape(-1, STATES),
            -axes.reshape(-1, 2),
            np.repeat(feature, directions),
            self.noise[:, :directions].ravel(),
            (of_turned * np.sqrt(self.turn)[:, None, None]).reshape(-1, 3),
        )


def _with_lever(axes: FloatArray, arm: FloatArray) -> FloatArray:
    """Derivatives (K, D, 3) by the pose of points with these levers (K, 2), along these axes (K, D, 2)."""
    turn = axes[:, :, 1] * arm[:, None, 0] - axes[:, :, 0] * arm[:, None, 1]
    return np.concatenate([axes, turn[:, :, None]], axis=2)
