"""UWB alone, frame by frame, by a solver of choice: in the plane at the site's height, or in space."""

from abc import ABC, abstractmethod
from math import sqrt
from typing import ClassVar

import numpy as np
from pydantic import Field

from estimators.base import Report, Setup, Verdict
from estimators.geometry import lift
from estimators.immutable import immutable
from estimators.least_squares import LeastSquares
from estimators.messages import FloatArray, Measurement, PoseEstimate, RangeFrame
from estimators.models.range import reduce_height
from estimators.trilateration import AnchorGeometryError, check_anchor_geometry
from estimators.uwb.position_solvers import Solution, closed_form, spans_space, unit_vectors

MIN_INFORMATION = 1e-6
"""Least information of N ranges of unit variance along any axis, over N; below it there is no position."""


@immutable
class TagFix:
    """Position of the tag from one frame.

    Attributes:
        stamp_ns: of the frame.
        position: (3,) [m], map frame; the height is the site's where it was not solved for.
        cov: (3, 3) [m^2], of ranges as good as stated; the variance of the height is infinite when it was
            asked for but cannot be seen.
        iterations: steps of the solver.
        dimensions: 3 where the height was solved for, else 2.
        disagreement: variance of the ranges about the position over the stated one; at least 1, and 1 where
            no range is to spare.
    """

    stamp_ns: int
    position: FloatArray
    cov: FloatArray
    iterations: int
    dimensions: int
    disagreement: float

    @property
    def widened_cov(self) -> FloatArray:
        """`cov`, (3, 3) [m^2], with what was solved for as unsure as the ranges disagree."""
        cov = self.cov.copy()
        cov[: self.dimensions, : self.dimensions] *= self.disagreement
        return cov

    @property
    def common_sigma(self) -> float:
        """What disagreement adds to the standard deviation along x and y [m].

        What blocks a range stays for a while, so the positions of that while have this error in common.
        """
        return sqrt((self.disagreement - 1.0) * float(np.trace(self.cov[:2, :2])) / 2.0)


class FrameSolver(ABC):
    """Position of every range frame; which solver finds it is the subclass's.

    Where ranges disagree by more than their noise, something blocks one of them, and the pose is as unsure as
    they disagree: its covariance grows by the variance of the residuals over the stated one.

    It knows no heading, so the body is taken to be below or above the tag and the lever arm enters the
    covariance. In space the height is solved for when the anchors do not lie in one plane. When they do, it
    is unobservable: the position is solved in the plane at the site's height, and the variance of the height
    is infinite.

    Source: li2022 Eq. (1)-(2), positions in the plane from 3 anchors, in space from 4; growth of the
    covariance: a-posteriori variance factor of least squares.
    """

    class Config(LeastSquares.Config):
        """Settings of every solver of frames."""

        PARAMETER: ClassVar[str] = "dimensions"

        dimensions: int = Field(2, ge=2, le=3, description="2: at the site's height; 3: height from ranges")

    def __init__(self, config: Config, setup: Setup) -> None:
        self._config = config
        self._setup = setup
        self._tag_height = setup.height + float(setup.tag_in_body[2])
        self._lever_variance = float(setup.tag_in_body[:2] @ setup.tag_in_body[:2]) / 2.0
        self.reset()

    def reset(self) -> None:
        """Forget the last fix."""
        self._fix: TagFix | None = None
        self._newest_ns: int | None = None

    @property
    def fix(self) -> TagFix | None:
        """The newest fix; None before the first."""
        return self._fix

    def update(self, measurement: Measurement) -> Report:
        """Solve a RangeFrame of the one tag; other measurements are not used."""
        if not isinstance(measurement, RangeFrame):
            return Report((Verdict.NOT_USED,))
        if measurement.tag_id in self._setup.tags:
            return Report((Verdict.NOT_USED,) * len(measurement.ranges))
        if self._newest_ns is not None and measurement.stamp_ns < self._newest_ns:
            return Report((Verdict.LATE,) * len(measurement.ranges))
        self._newest_ns = measurement.stamp_ns
        verdicts = [Verdict.ACCEPTED] * len(measurement.ranges)
        residuals, nis = np.full((2, len(verdicts)), np.nan)
        rows = self._usable(measurement, verdicts)
        anchors = np.array([self._setup.anchors[i] for i in measurement.anchor_ids[rows].tolist()])
        slants = measurement.ranges[rows]
        if self._config.dimensions == 3 and spans_space(anchors.reshape(-1, 3)):
            sigmas = np.full(len(rows), self._config.range_sigma)
            fix = self._solve_in_space(measurement.stamp_ns, anchors, slants, sigmas)
        else:
            fix = self._solve_in_plane(measurement.stamp_ns, rows, anchors, slants, verdicts)
        solved = [i for i in rows if verdicts[i] is Verdict.ACCEPTED]
        if fix is None:
            for i in solved:
                verdicts[i] = Verdict.TOO_FEW
            return Report(tuple(verdicts), residuals, nis)
        self._fix = fix
        residuals[rows] = slants - np.linalg.norm(anchors - fix.position, axis=1)
        residuals[[i for i in rows if i not in solved]] = np.nan
        return Report(tuple(verdicts), residuals, nis, iterations=fix.iterations)

    def pose_at(self, stamp_ns: int) -> PoseEstimate | None:
        """The last fix, held; its covariance grows with its age. Yaw variance is infinite."""
        fix = self._fix
        if fix is None or (age := abs(stamp_ns - fix.stamp_ns) * 1e-9) > self._config.max_age:
            return None
        growth = (self._config.speed_sigma * age) ** 2
        cov = self._setup.lift_covariance(np.diag([0.0, 0.0, np.inf]))
        cov[:3, :3] = fix.widened_cov + np.diag([growth + self._lever_variance] * 2 + [growth])
        T_map_body = lift(np.array([*fix.position[:2], 0.0]), fix.position[2] - self._setup.tag_in_body[2])
        return PoseEstimate(stamp_ns, T_map_body, cov, 0)

    @abstractmethod
    def _solve(self, anchors: FloatArray, ranges: FloatArray, start: FloatArray) -> Solution:
        """Position (D,) from anchors (N, D) and ranges (N,), all [m]."""

    def _usable(self, frame: RangeFrame, verdicts: list[Verdict]) -> list[int]:
        """Rows of finite, positive ranges to known anchors; the verdicts on others are set."""
        rows: list[int] = []
        for i, (anchor_id, slant) in enumerate(
            zip(frame.anchor_ids.tolist(), frame.ranges.tolist(), strict=True)
        ):
            if anchor_id not in self._setup.anchors:
                verdicts[i] = Verdict.UNKNOWN_ANCHOR
            elif not 0.0 < slant < np.inf:
                verdicts[i] = Verdict.IMPOSSIBLE
            else:
                rows.append(i)
        return rows

    def _solve_in_plane(
        self,
        stamp_ns: int,
        rows: list[int],
        anchors: FloatArray,
        slants: FloatArray,
        verdicts: list[Verdict],
    ) -> TagFix | None:
        """Fix at the site's height from the ranges that reach it; the verdicts on others are set."""
        plan: list[FloatArray] = []
        reduced: list[tuple[float, float]] = []
        for i, anchor, slant in zip(rows, anchors, slants.tolist(), strict=True):
            horizontal = reduce_height(slant, self._config.range_sigma, self._setup.height_to(anchor))
            if horizontal is None:
                verdicts[i] = Verdict.IMPOSSIBLE
            else:
                plan.append(anchor[:2])
                reduced.append(horizontal)
        try:
            check_anchor_geometry(np.array(plan).reshape(-1, 2))
        except AnchorGeometryError:
            return None
        ranges, sigmas = np.array(reduced).T
        start = closed_form(np.array(plan), ranges)
        return self._fixed(stamp_ns, np.array(plan), ranges, sigmas, start)

    def _solve_in_space(
        self, stamp_ns: int, anchors: FloatArray, slants: FloatArray, sigmas: FloatArray
    ) -> TagFix | None:
        """Fix with its height, sought on the site's side of the anchors."""
        plan = anchors[:, :2]
        try:
            check_anchor_geometry(plan)
        except AnchorGeometryError:
            return None
        lifted = self._tag_height - anchors[:, 2]
        horizontal = np.sqrt(np.maximum(slants**2 - lifted**2, 0.0))
        start = np.array([*closed_form(plan, horizontal), self._tag_height])
        return self._fixed(stamp_ns, anchors, slants, sigmas, start)

    def _fixed(
        self, stamp_ns: int, anchors: FloatArray, ranges: FloatArray, sigmas: FloatArray, start: FloatArray
    ) -> TagFix | None:
        """Fix of the solver with the covariance that independent ranges leave; None where they leave none."""
        solution = self._solve(anchors, ranges, start)
        units, _ = unit_vectors(anchors, solution.position)
        information = units.T @ units
        if not np.linalg.eigvalsh(information)[0] > MIN_INFORMATION * len(ranges):
            return None
        # All ranges count alike, whatever their sigma: so the covariance is not the inverse information.
        gain = np.linalg.solve(information, units.T) * sigmas
        position = np.array([0.0, 0.0, self._tag_height])
        position[: len(start)] = solution.position
        cov = np.zeros((3, 3))
        cov[: len(start), : len(start)] = gain @ gain.T
        if len(start) == 2:
            cov[2, 2] = np.inf if self._config.dimensions == 3 else self._setup.height_sigma**2
        spare = len(ranges) - len(start)
        off = (np.linalg.norm(anchors - solution.position, axis=1) - ranges) / sigmas
        disagreement = max(1.0, float(off @ off) / spare) if spare else 1.0
        return TagFix(stamp_ns, position, cov, solution.iterations, len(start), disagreement)
