"""Places seen before: keyframes matched to much older ones, and checked before anyone believes it."""

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from estimators import chi2
from estimators.geometry import between, compose, inverse, rotation, wrap_angle
from estimators.lidar.scan_fit import held_directions
from estimators.messages import FloatArray, PoseIncrement

if TYPE_CHECKING:
    from estimators.lidar.line_map import LineMap, Surface

STARTS = tuple(product((0.0, -0.6, 0.6), (0.0, -0.6, 0.6), np.deg2rad((0.0, -12.0, 12.0))))
"""Offsets [m, m, rad] from the expected pose at which matching begins, the expected pose first."""
SAME = (0.1, np.deg2rad(3.0))
"""Results closer than this [m] and [rad] are one."""
ITERATIONS = 12
_STILL = np.array([[0.0, 0.0, 1.0, 0.0]])


@dataclass(frozen=True, slots=True, eq=False)
class _Keyframe:
    stamp_ns: int
    pose: FloatArray
    points_cov: FloatArray
    surface: "Surface"
    lines: "LineMap"


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Pose of one keyframe in another, its covariance, share of the surface points that fit."""

    pose: FloatArray
    cov: FloatArray
    share: float


class LoopCloser:
    """Proposes motions between keyframes that are far apart in time and near each other in space.

    A closure must fit from either side, to the same result, hold the robot in every direction, and be the
    only one round about. What passes may still be wrong in a building of equal rooms: whoever takes it should
    be able to refuse it.
    """

    class Config(BaseModel):
        """Settings of the search for closures."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        radius: float = Field(1.5, gt=0, le=50, description="keyframes further away are not compared [m]")
        keyframes_between: int = Field(
            15, ge=1, le=10_000, description="younger keyframes than this many are no closure"
        )
        least_share: float = Field(
            0.7, gt=0, le=1, description="of the surface points that must fit, from either side"
        )
        range_sigma: float = Field(0.015, gt=0, le=1, description="standard deviation of a LiDAR range [m]")
        reach: float = Field(
            0.4, gt=0, le=5, description="points further than this from a surface are not matched [m]"
        )
        gate: float = Field(
            0.9999, gt=0.5, lt=1, description="share of true closures whose two sides pass as equal"
        )

    def __init__(self, config: Config) -> None:
        # Numba loads slowly: only who closes loops waits for it.
        from estimators.lidar import line_map

        self._line_map = line_map
        self._config = config
        self._gate = float(chi2.ppf(config.gate, 3))
        self._keyframes: list[_Keyframe] = []
        self.refused = 0
        """Comparisons with near keyframes that failed a check."""

    def add(
        self, stamp_ns: int, pose: FloatArray, points: FloatArray, points_cov: FloatArray
    ) -> PoseIncrement | None:
        """Take a keyframe and compare it with the nearest old one.

        Args:
            stamp_ns: of the keyframe.
            pose: (3,) where the estimator believes the body was, map frame; may have drifted by `STARTS`.
            points: (N, 2) [m] of the deskewed scan, body frame.
            points_cov: (3, 3) where among them the body was, as `ScanMatcher.points_cov`.

        Returns:
            The motion from the old keyframe to this one; None without a closure. Its `from_stamp_ns` is that
            of a keyframe long gone, so only an estimator that keeps old poses has a use for it.
        """
        config = self._config
        found = self._line_map.surface(points, config.range_sigma)
        lines = self._line_map.LineMap(points, config.range_sigma, config.reach)
        newest = _Keyframe(stamp_ns, pose, points_cov, found, lines)
        old = self._keyframes[: max(0, len(self._keyframes) - config.keyframes_between)]
        self._keyframes.append(newest)
        distances = [float(np.hypot(*(keyframe.pose - pose)[:2])) for keyframe in old]
        if not distances or min(distances) > config.radius:
            return None
        return self._closure(old[int(np.argmin(distances))], newest)

    def _closure(self, old: _Keyframe, newest: _Keyframe) -> PoseIncrement | None:
        forth = self._only_fit(old, newest)
        back = None if forth is None else self._fit(newest, old, inverse(forth.pose))
        if forth is None or back is None or back.share < self._config.least_share:
            self.refused += 1
            return None
        turned = np.eye(3)
        turned[:2, :2] = rotation(forth.pose[2])
        gap = compose(forth.pose, back.pose)
        cov = forth.cov + turned @ back.cov @ turned.T
        if float(gap @ np.linalg.solve(cov, gap)) > self._gate:
            self.refused += 1
            return None
        cov = forth.cov + old.points_cov + turned @ newest.points_cov @ turned.T
        return PoseIncrement(old.stamp_ns, newest.stamp_ns, forth.pose, cov, is_keyframe=False)

    def _only_fit(self, old: _Keyframe, newest: _Keyframe) -> _Fit | None:
        """Best fit round the expected pose; None when there is none, or another that is as good."""
        expected = between(old.pose, newest.pose)
        fits = [self._fit(old, newest, expected + np.array(start)) for start in STARTS]
        good = [fit for fit in fits if fit is not None and fit.share >= self._config.least_share]
        if not good:
            return None
        best = max(good, key=lambda fit: fit.share)
        for fit in good:
            apart = between(best.pose, fit.pose)
            if np.hypot(apart[0], apart[1]) > SAME[0] or abs(apart[2]) > SAME[1]:
                return None
        return best

    def _fit(self, old: _Keyframe, newest: _Keyframe, guess: FloatArray) -> _Fit | None:
        """Point-to-line Gauss-Newton of a still scan."""
        sigma = self._config.range_sigma
        points, normals = newest.surface.points, newest.surface.normals
        if len(points) < ITERATIONS:
            return None
        basis = np.repeat(_STILL, len(points), axis=0)
        state = np.zeros(12)
        state[6:9] = guess
        for _ in range(ITERATIONS):
            rows, index = old.lines.match(points, normals, basis, state)
            distances = np.abs(rows[index >= 0, 0])
            if len(distances) < ITERATIONS:
                return None
            scale = max(2.0 * sigma, 1.5 * float(np.median(distances)))
            sums = old.lines.sums(basis, rows, index, scale)
            if np.linalg.matrix_rank(held_directions(sums.pose_hessian, sums.feigned), tol=0.5) < 3:
                return None
            step = np.linalg.solve(sums.pose_hessian, -sums.gradient[6:9])
            state[6:9] += step
            if float(np.abs(step).max()) < 1e-4:
                break
        variance = max(sigma**2, 0.5 * sums.squares / sums.weight)
        gain = np.linalg.inv(sums.pose_hessian)
        cov = variance * (gain + gain @ old.lines.gradient_noise(sums.by_line) @ gain)
        pose = state[6:9].copy()
        pose[2] = wrap_angle(pose[2])
        share = float(np.count_nonzero(distances < 3.0 * scale)) / len(points)
        return _Fit(pose, 0.5 * (cov + cov.T), share)
