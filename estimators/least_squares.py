"""UWB alone, frame by frame: the position a tag has without memory, motion model or LiDAR."""

from collections.abc import Sequence

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from estimators import chi2
from estimators.base import Report, Setup, Verdict
from estimators.geometry import lift
from estimators.messages import FloatArray, Measurement, PoseEstimate, RangeFrame
from estimators.models.range import reduce_height
from estimators.trilateration import AnchorGeometryError, Fix, trilaterate

REACHED = float(chi2.ppf(0.997, 2))
"""NIS of a step from the last fix to this one, up to which the tag can have made it."""


class LeastSquares:
    """Weighted least-squares position of every range frame.

    Where two positions fit alike, as with two anchors or with several in line, it takes the one that the last
    fix leaves possible, or none. It knows no heading, so the body is taken to be at the tag and the lever arm
    enters the covariance.

    Source: huang2024 Eq. (3)-(4); li2022 "least squares".
    """

    class Config(BaseModel):
        """Settings of `least_squares`."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        range_sigma: float = Field(0.10, gt=0, le=10, description="standard deviation of a range [m]")
        max_age: float = Field(0.5, gt=0, le=10, description="a fix older than this is no pose [s]")
        speed_sigma: float = Field(
            0.5, ge=0, le=20, description="unknown motion since the fix, as a speed [m/s]"
        )

    def __init__(self, config: Config, setup: Setup) -> None:
        self._config = config
        self._setup = setup
        self._lever_variance = float(setup.tag_in_body[:2] @ setup.tag_in_body[:2]) / 2.0
        self.reset()

    def reset(self) -> None:
        """Forget the last fix."""
        self._fix: Fix | None = None
        self._fix_ns = 0
        self._newest_ns: int | None = None

    def update(self, measurement: Measurement) -> Report:
        """Solve a RangeFrame of the one tag; other measurements are not used."""
        if not isinstance(measurement, RangeFrame):
            return Report((Verdict.NOT_USED,))
        if measurement.tag_id in self._setup.tags:
            return Report((Verdict.NOT_USED,) * len(measurement.ranges))
        if self._newest_ns is not None and measurement.stamp_ns < self._newest_ns:
            return Report((Verdict.LATE,) * len(measurement.ranges))
        self._newest_ns = measurement.stamp_ns
        verdicts: list[Verdict] = []
        used: list[int] = []
        rows: list[tuple[FloatArray, float, float]] = []
        for i, (anchor_id, slant) in enumerate(
            zip(measurement.anchor_ids.tolist(), measurement.ranges.tolist(), strict=True)
        ):
            anchor = self._setup.anchors.get(anchor_id)
            if anchor is None:
                verdicts.append(Verdict.UNKNOWN_ANCHOR)
                continue
            reduced = reduce_height(slant, self._config.range_sigma, self._setup.height_to(anchor))
            if reduced is None:
                verdicts.append(Verdict.IMPOSSIBLE)
                continue
            verdicts.append(Verdict.ACCEPTED)
            used.append(i)
            rows.append((anchor[:2], *reduced))
        residuals = np.full(len(verdicts), np.nan)
        try:
            fixes = trilaterate(
                np.array([row[0] for row in rows]).reshape(-1, 2),
                np.array([row[1] for row in rows]),
                np.array([row[2] for row in rows]),
            )
            refusal = Verdict.AMBIGUOUS
        except AnchorGeometryError:
            fixes, refusal = (), Verdict.TOO_FEW
        fix = fixes[0] if len(fixes) == 1 else self._reached(fixes, measurement.stamp_ns)
        if fix is None:
            for i in used:
                verdicts[i] = refusal
            return Report(tuple(verdicts), residuals, residuals)
        residuals[used] = fix.residuals
        self._fix = fix
        self._fix_ns = measurement.stamp_ns
        return Report(tuple(verdicts), residuals, np.full(len(verdicts), np.nan))

    def _reached(self, fixes: Sequence[Fix], stamp_ns: int) -> Fix | None:
        """The only one of several positions to which the tag can have come from the last fix."""
        if self._fix is None:
            return None
        age = (stamp_ns - self._fix_ns) * 1e-9
        if age > self._config.max_age:
            return None
        moved = (self._config.speed_sigma * age) ** 2 * np.eye(2)
        near = []
        for fix in fixes:
            step = fix.position - self._fix.position
            nis = float(step @ np.linalg.solve(fix.cov + self._fix.cov + moved, step))
            if nis < REACHED:
                near.append(fix)
        return near[0] if len(near) == 1 else None

    def pose_at(self, stamp_ns: int) -> PoseEstimate | None:
        """The last fix, held; its covariance grows with its age. Yaw variance is infinite."""
        age = abs(stamp_ns - self._fix_ns) * 1e-9
        if self._fix is None or age > self._config.max_age:
            return None
        planar = np.zeros((3, 3))
        growth = (self._config.speed_sigma * age) ** 2 + self._lever_variance
        planar[:2, :2] = self._fix.cov + growth * np.eye(2)
        planar[2, 2] = np.inf
        pose = np.array([*self._fix.position, 0.0])
        return PoseEstimate(stamp_ns, lift(pose, self._setup.height), self._setup.lift_covariance(planar), 0)
