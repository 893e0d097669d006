"""How far poses are from the truth, and whether their covariance says so."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.log import Truth
from estimators.geometry import wrap_angles
from estimators.immutable import immutable
from estimators.messages import FloatArray, PoseEstimate


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Errors of one track against truth, no alignment.

    Attributes:
        poses: number of poses compared.
        availability: share of the instants with truth at which there was a pose.
        rmse: root mean square of the horizontal position error [m].
        max: largest horizontal error [m].
        p95: 95th percentile of the horizontal error [m].
        yaw_rmse_deg: root mean square heading error [deg]; None when heading or its truth is unknown.
        nees: mean normalised estimation error squared; its expectation is `nees_dof`.
        nees_dof: 3 with heading (x, y, yaw), 2 without.
    """

    poses: int
    availability: float
    rmse: float
    max: float
    p95: float
    yaw_rmse_deg: float | None
    nees: float
    nees_dof: int


@immutable
class Errors:
    """Errors of one track at every instant with pose and truth.

    Attributes:
        stamps_ns: (N,) int64.
        pose: (N, 3) estimated x [m], y [m], yaw [rad].
        truth: (N, 3) the same, true; yaw NaN where the reference has none.
        error: (N, 3) estimate minus truth, yaw wrapped.
        cov: (N, 3, 3) claimed covariance of (x, y, yaw).
        height: (N,) estimated z of the body [m].
        height_variance: (N,) claimed variance of the same [m^2]; infinite where ranges cannot show it.
        availability: share of the instants with truth at which there was a pose.
    """

    stamps_ns: np.ndarray[tuple[int], np.dtype[np.int64]]
    pose: FloatArray
    truth: FloatArray
    error: FloatArray
    cov: FloatArray
    height: FloatArray
    height_variance: FloatArray
    availability: float

    @property
    def distance(self) -> FloatArray:
        """Horizontal error, (N,) [m]."""
        return np.hypot(self.error[:, 0], self.error[:, 1])

    @property
    def has_yaw(self) -> bool:
        """Whether the heading is estimated, and its truth known, throughout."""
        return bool(np.isfinite(self.error[:, 2]).all() and np.isfinite(self.cov[:, 2, 2]).all())

    @property
    def nees_dof(self) -> int:
        """Expectation of `nees`: 3 with heading (x, y, yaw), 2 without."""
        return 3 if self.has_yaw else 2

    @property
    def nees(self) -> FloatArray:
        """Normalised estimation error squared, (N,)."""
        dof = self.nees_dof
        error, cov = self.error[:, :dof], self.cov[:, :dof, :dof]
        whitened = np.linalg.solve(cov, error[:, :, None])[:, :, 0]
        return np.asarray(np.einsum("ni,ni->n", error, whitened))

    def accuracy(self) -> Accuracy | None:
        """The figures of the table; None when nothing can be compared."""
        if len(self.stamps_ns) == 0:
            return None
        distance, yaw = self.distance, self.error[:, 2]
        return Accuracy(
            poses=len(distance),
            availability=self.availability,
            rmse=float(np.sqrt((distance**2).mean())),
            max=float(distance.max()),
            p95=float(np.percentile(distance, 95)),
            yaw_rmse_deg=float(np.rad2deg(np.sqrt((yaw**2).mean()))) if self.has_yaw else None,
            nees=float(self.nees.mean()),
            nees_dof=self.nees_dof,
        )


class Reference:
    """True poses of a log, to be asked at any time between the first and the last.

    Args:
        truths: in stamp order.
    """

    def __init__(self, truths: Sequence[Truth]) -> None:
        self._stamps_ns = np.array([truth.stamp_ns for truth in truths], dtype=np.int64)
        poses = np.array([truth.pose for truth in truths]).reshape(-1, 3)
        self._xy, self._yaw = poses[:, :2], poses[:, 2].copy()
        known = np.isfinite(self._yaw)
        self._yaw[known] = np.unwrap(self._yaw[known])

    def covers(self, stamp_ns: int) -> bool:
        """Whether truth is known at a time."""
        if len(self._stamps_ns) == 0:
            return False
        return bool(self._stamps_ns[0] <= stamp_ns <= self._stamps_ns[-1])

    def at(self, stamps_ns: Sequence[int]) -> FloatArray:
        """Poses (N, 3) by linear interpolation; the yaw may exceed a full turn."""
        # Relative to the first stamp: float64 seconds since boot would round the nanoseconds.
        times = np.array(stamps_ns, dtype=np.int64) - self._stamps_ns[0]
        known = (self._stamps_ns - self._stamps_ns[0]).astype(np.float64)
        columns = (self._xy[:, 0], self._xy[:, 1], self._yaw)
        return np.column_stack([np.interp(times, known, column) for column in columns])


def compare(poses: Sequence[PoseEstimate], reference: Reference, ticks_with_truth: int) -> Errors:
    """Errors of a track.

    Args:
        poses: estimates, in stamp order; those outside the truth's time are left out.
        reference: the truth.
        ticks_with_truth: number of instants at which a pose was asked for and truth is known.
    """
    covered = [pose for pose in poses if reference.covers(pose.stamp_ns)]
    stamps = [pose.stamp_ns for pose in covered]
    estimated = np.array([[*pose.xy, pose.yaw] for pose in covered]).reshape(-1, 3)
    truth = reference.at(stamps) if covered else np.empty((0, 3))
    error = estimated - truth
    error[:, 2] = wrap_angles(error[:, 2])
    return Errors(
        stamps_ns=np.array(stamps, dtype=np.int64),
        pose=estimated,
        truth=truth,
        error=error,
        cov=np.array([pose.planar_cov for pose in covered]).reshape(-1, 3, 3),
        height=np.array([pose.T_map_body[2, 3] for pose in covered]),
        height_variance=np.array([pose.cov[2, 2] for pose in covered]),
        availability=len(covered) / ticks_with_truth if ticks_with_truth else 0.0,
    )
