"""Joint estimate of the robot's motion and of the features round it, seen from the newest keyframe.

Mean and covariance hold the states (12,) of `estimators.lidar.sightings` and two numbers a feature: of a wall
the direction of its normal [rad] and its distance [m] from its anchor, of a corner or pole x and y [m]. The
anchor is a constant point near the wall, so that its direction has no long lever.

The origin is where the body was at the keyframe, and moves on with it. So the newest pose and its covariance
are the increment since the keyframe, with all that pose and map have in common, and no error of an old
heading is ever linearised.

Source: Castellanos, Martinez-Cantin, Tardos and Neira, "Robocentric map joining: improving the consistency of
EKF-SLAM", Robotics and Autonomous Systems 55, 2007.
"""

from collections.abc import Callable
from enum import IntEnum

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from estimators import chi2
from estimators.geometry import inverse, rotation, transform, wrap_angle, wrap_angles
from estimators.lidar.scan_fit import LEAST_INFORMATION
from estimators.lidar.sightings import NOW, STATES, Rows
from estimators.messages import FloatArray, IntArray

MOST_ITERATIONS = 5
CONVERGED = 1e-5
"""A step of the pose that is smaller [m, rad] is the last."""
_JOINTLY = 0.999
"""Share of right associations that pass as a whole."""
UNTHREADED = 8
"""Rows that are taken into the covariance at once: of more, BLAS would start threads for it, and wait for
them longer than the product takes."""


class Kind(IntEnum):
    """What a feature is."""

    WALL = 0
    CORNER = 1
    POLE = 2


class FeatureMap:
    """States and features with their joint covariance.

    Attributes:
        mean: (12 + 2 M,).
        cov: (12 + 2 M, 12 + 2 M).
        kinds: (M,) a `Kind` each.
        anchors: (M, 2) [m], of walls.
        extents: (M, 2) between which of a wall was seen, along it from its anchor [m].
        sightings: (M,) how often each was seen.
        unseen: (M,) how many scans ago that was.
    """

    def __init__(self, states: FloatArray, cov: FloatArray) -> None:
        """Know no feature.

        Args:
            states: (12,).
            cov: (12, 12).
        """
        self.mean, self.cov = states, cov
        self.kinds = np.zeros(0, dtype=np.int64)
        self.anchors = np.zeros((0, 2))
        self.extents = np.zeros((0, 2))
        self.sightings = np.zeros(0, dtype=np.int64)
        self.unseen = np.zeros(0, dtype=np.int64)

    @property
    def states(self) -> FloatArray:
        """Pose and velocity at the end of the scan before, pose and velocity now, (12,)."""
        return self.mean[:STATES]

    @property
    def features(self) -> FloatArray:
        """Two numbers each, (M, 2)."""
        return self.mean[STATES:].reshape(-1, 2)

    @property
    def pose(self) -> FloatArray:
        """Newest pose, (3,)."""
        return self.mean[NOW]

    @property
    def pose_cov(self) -> FloatArray:
        """Its covariance, (3, 3)."""
        return self.cov[NOW, NOW]

    def predict(self, F: FloatArray, Q: FloatArray) -> None:
        """Stage 1: the state now becomes the state before, and moves.

        Args:
            F: (6, 6) transition of pose and velocity.
            Q: (6, 6) covariance of its noise.
        """
        T = np.zeros((STATES, STATES))
        T[:6, 6:], T[6:, 6:] = np.eye(6), F
        self.mean[:STATES] = T @ self.mean[:STATES]
        self.cov[:STATES] = T @ self.cov[:STATES]
        self.cov[:, :STATES] = self.cov[:, :STATES] @ T.T
        self.cov[6:STATES, 6:STATES] += Q
        self.unseen += 1

    def misfit(self, rows: Rows) -> int | None:
        """The feature whose sightings fit the others least, when all together they do not pass a gate.

        Each by itself may, where the pose is uncertain: together they would need motion that nobody expects.

        Args:
            rows: at the predicted mean, at least one.

        Source: Neira and Tardos, "Data association in stochastic mapping using the joint compatibility test",
        IEEE Transactions on Robotics and Automation 17, 2001.
        """
        precision = np.linalg.inv(self._innovation(rows)[1])
        pulls = precision @ rows.residual
        if rows.residual @ pulls < chi2.ppf(_JOINTLY, len(pulls)):
            return None
        return int(rows.feature[np.argmax(pulls**2 / np.diag(precision))])

    def _innovation(self, rows: Rows) -> tuple[FloatArray, FloatArray]:
        """Covariance of M rows with the mean (M, N) and with each other (M, M)."""
        by_states = _held(rows)
        columns = STATES + 2 * rows.feature[:, None] + [0, 1]
        HP = by_states @ self.cov[:STATES]
        HP += (rows.by_feature[:, :, None] * self.cov[columns]).sum(axis=1)
        S = HP[:, :STATES] @ by_states.T
        S += (HP[:, columns] * rows.by_feature).sum(axis=2)
        S[np.diag_indices(len(S))] += rows.noise
        return HP, S

    def correct(self, look: Callable[[], Rows]) -> None:
        """Stage 3: iterated update.

        Directions of the pose that no row holds stay as predicted.

        Args:
            look: gives the rows at the present mean.

        Source: Bell and Cathey, "The iterated Kalman filter update as a Gauss-Newton method", IEEE
        Transactions on Automatic Control 38, 1993.
        """
        prior = self.mean
        for _ in range(MOST_ITERATIONS):
            rows = look()
            HP, S = self._innovation(rows)
            factor = cho_factor(S, lower=True)
            moved = self.mean - prior
            columns = STATES + 2 * rows.feature[:, None] + [0, 1]
            linear = _held(rows) @ moved[:STATES] + (rows.by_feature * moved[columns]).sum(axis=1)
            before = self.pose
            self.mean = prior + cho_solve(factor, linear - rows.residual) @ HP
            if float(np.abs(self.pose - before).max()) < CONVERGED:
                break
        root = np.linalg.inv(np.tril(factor[0]))
        for first in range(0, len(root), UNTHREADED):
            part = root[first : first + UNTHREADED] @ HP
            self.cov -= part.T @ part
        self.mean[8] = wrap_angle(self.mean[8])
        walls = STATES + 2 * np.flatnonzero(self.kinds == Kind.WALL)
        self.mean[walls] = wrap_angles(self.mean[walls])

    def add(
        self, kind: Kind, values: FloatArray, anchors: FloatArray, extents: FloatArray, rows: Rows
    ) -> None:
        """Stage 4: augment by K features, each known from its own two rows.

        Args:
            kind: of all of them.
            values: (K, 2) near which they are.
            anchors: (K, 2).
            extents: (K, 2).
            rows: (2 K) at `values`.
        """
        count = len(values)
        by_feature = np.linalg.inv(rows.by_feature.reshape(count, 2, 2))
        values = values - np.einsum("kij,kj->ki", by_feature, rows.residual.reshape(count, 2))
        G = -np.einsum("kij,kjn->kin", by_feature, rows.by_states.reshape(count, 2, STATES))
        G = G.reshape(2 * count, STATES)
        across = G @ self.cov[:STATES]
        own = across[:, :STATES] @ G.T
        noise = np.einsum("kij,kj,klj->kil", by_feature, rows.noise.reshape(count, 2), by_feature)
        for k in range(count):
            own[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += noise[k]
        self.mean = np.concatenate([self.mean, values.ravel()])
        self.cov = np.block([[self.cov, across.T], [across, own]])
        self.kinds = np.append(self.kinds, np.full(count, kind))
        self.anchors = np.vstack([self.anchors, anchors])
        self.extents = np.vstack([self.extents, extents])
        self.sightings = np.append(self.sightings, np.ones(count, dtype=np.int64))
        self.unseen = np.append(self.unseen, np.zeros(count, dtype=np.int64))

    def keep(self, which: IntArray) -> None:
        """Forget all other features."""
        index = np.concatenate([np.arange(STATES), (STATES + 2 * which[:, None] + [0, 1]).ravel()])
        self.mean, self.cov = self.mean[index], self.cov[np.ix_(index, index)]
        self.kinds, self.anchors, self.extents = self.kinds[which], self.anchors[which], self.extents[which]
        self.sightings, self.unseen = self.sightings[which], self.unseen[which]

    def unite(self, kept: int, other: int) -> None:
        """A wall is another one, too: what was seen of the other counts as seen of it."""
        theta = self.features[kept, 0]
        off = self.anchors[other] - self.anchors[kept]
        ends = np.cos(theta) * off[1] - np.sin(theta) * off[0] + self.extents[other]
        self.extents[kept] = min(self.extents[kept, 0], ends[0]), max(self.extents[kept, 1], ends[1])
        self.unseen[kept] = min(self.unseen[kept], self.unseen[other])

    def move_origin(self) -> None:
        """The newest pose becomes the origin: known exactly, as everything else is seen from there."""
        pose = self.pose.copy()
        back = rotation(-pose[2])
        T = np.zeros_like(self.cov)
        velocity = back @ self.mean[9:11]
        T[9:11, 9:11], T[11, 11] = back, 1.0
        T[9, 8], T[10, 8] = velocity[1], -velocity[0]
        values = self.features.copy()
        walls = np.flatnonzero(self.kinds == Kind.WALL)
        spots = np.flatnonzero(self.kinds != Kind.WALL)
        at = STATES + 2 * walls
        values[walls, 0] = wrap_angles(values[walls, 0] - pose[2])
        self.anchors[walls] = transform(inverse(pose), self.anchors[walls])
        c, s = np.cos(values[walls, 0]), np.sin(values[walls, 0])
        T[at, at] = T[at + 1, at + 1] = 1.0
        T[at, 8] = -1.0
        T[at + 1, 6], T[at + 1, 7] = -(c * back[0, 0] - s * back[0, 1]), -(s * back[0, 0] + c * back[0, 1])
        T[at + 1, 8] = c * self.anchors[walls, 1] - s * self.anchors[walls, 0]
        at = STATES + 2 * spots
        values[spots] = transform(inverse(pose), values[spots])
        for row in (0, 1):
            T[at + row, at], T[at + row, at + 1] = back[row]
            T[at + row, 6], T[at + row, 7] = -back[row]
        T[at, 8], T[at + 1, 8] = values[spots, 1], -values[spots, 0]
        self.mean = np.concatenate([np.zeros(9), velocity, self.mean[11:12], values.ravel()])
        cov = T @ self.cov @ T.T
        self.cov = 0.5 * (cov + cov.T)


def _held(rows: Rows) -> FloatArray:
    """Derivative (R, 12) by the states, without directions of the pose that nothing holds."""
    # Numba loads slowly: only who maps features waits for it.
    from estimators.kernels.scan_fit import held_directions

    by_pose = rows.by_states[:, :3] + rows.by_states[:, 6:9]
    weight = 1.0 / rows.noise[:, None]
    feigned = rows.feigned.T @ (weight * rows.feigned) + LEAST_INFORMATION * np.eye(3)
    held = held_directions(by_pose.T @ (weight * by_pose), feigned)
    return (rows.by_states.reshape(-1, 4, 3) @ held).reshape(-1, STATES)
