"""Places seen before: keyframes matched to much older ones, and checked before anyone believes it."""

from collections import deque
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from estimators import chi2
from estimators.geometry import between, compose, inverse, rotation, wrap_angle
from estimators.immutable import immutable
from estimators.messages import FloatArray, LoopClosure

if TYPE_CHECKING:
    from estimators.lidar.line_map import LineMap, Surface

STARTS = tuple(product((0.0, -0.6, 0.6), (0.0, -0.6, 0.6), np.deg2rad((0.0, -12.0, 12.0))))
"""Offsets [m, m, rad] from the expected pose at which matching begins, the expected pose first."""
SAME = (0.1, np.deg2rad(3.0))
"""Results closer than this [m] and [rad] are one."""
TURNED = 0.5
"""A view that is turned by 1 rad is another one as if from so far away [m/rad]."""
ITERATIONS = 12
STARTING_POINTS = 150
"""With about so many points the places that fit are looked for."""
ALL_POINTS = slice(None)
LEAST_POINTS = 12
"""On surfaces, with fewer of which nothing is compared."""
_STILL = np.array([[0.0, 0.0, 1.0, 0.0]])


@dataclass(slots=True, eq=False)
class _Keyframe:
    """A keyframe as it is compared; its number is that of the newest one that was there."""

    number: int
    stamp_ns: int
    pose: FloatArray
    points_cov: FloatArray
    surface: "Surface"
    lines: "LineMap"


@immutable
class _Fit:
    """Pose of one keyframe in another, its covariance, share of the surface points that fit."""

    pose: FloatArray
    cov: FloatArray
    share: float


class LoopCloser:
    """Remembers places, and proposes the motion from one of them to a keyframe much later and near by.

    A closure must fit from either side, to the same result, hold the robot in every direction, and be the
    only one round about. What passes may still be wrong in a building of equal rooms: whoever takes it should
    be able to refuse it.
    """

    class Config(BaseModel):
        """Settings of the search for closures."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        spacing: float = Field(
            2.0,
            gt=0,
            le=50,
            description="a keyframe this far from every known place founds one [m]; 1 rad counts as 0.5 m",
        )
        radius: float = Field(1.5, gt=0, le=50, description="places further away are not compared [m]")
        keyframes_between: int = Field(
            15, ge=1, le=10_000, description="a place as young as this many keyframes is no closure"
        )
        places: int = Field(200, ge=1, le=100_000, description="the oldest of more places is forgotten")
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
        self._places: deque[_Keyframe] = deque(maxlen=config.places)
        self._number = 0
        self.refused = 0
        """Comparisons with near places that failed a check."""

    def add(
        self, stamp_ns: int, pose: FloatArray, points: FloatArray, points_cov: FloatArray
    ) -> LoopClosure | None:
        """Compare a keyframe with the nearest place, if that is old; where there is none it becomes one.

        Args:
            stamp_ns: of the keyframe.
            pose: (3,) where the estimator believes the body was, map frame; may have drifted by `STARTS`.
            points: (N, 2) [m] of the deskewed scan, body frame.
            points_cov: (3, 3) where among them the body was, as `ScanMatcher.points_cov`.

        Returns:
            The motion from the place to the keyframe, or that the keyframe is a place from now on
            (`from_stamp_ns == stamp_ns`); else None.
        """
        self._number += 1
        least_number = self._number - self._config.keyframes_between
        near = [place for place in self._places if _distance(place.pose, pose) <= self._config.radius]
        is_new = all(_unlikeness(place.pose, pose) >= self._config.spacing for place in self._places)
        old = [place for place in near if place.number < least_number]
        if not (is_new or old):
            return None
        newest = self._keyframe(stamp_ns, pose, points, points_cov)
        if old:
            nearest = min(old, key=lambda place: _unlikeness(place.pose, pose))
            closure = self._closure(nearest, newest)
            if closure is not None:
                # Its noise is in every closure: a second one of the same passage says little more.
                nearest.number = self._number
                return closure
        if is_new and len(newest.surface.points) >= LEAST_POINTS:
            self._places.append(newest)
            return LoopClosure(stamp_ns, stamp_ns, np.zeros(3), np.zeros((3, 3)))
        return None

    def _keyframe(
        self, stamp_ns: int, pose: FloatArray, points: FloatArray, points_cov: FloatArray
    ) -> _Keyframe:
        config = self._config
        found = self._line_map.surface(points, config.range_sigma)
        lines = self._line_map.LineMap(points, config.range_sigma, config.reach)
        return _Keyframe(self._number, stamp_ns, pose, points_cov, found, lines)

    def _closure(self, old: _Keyframe, newest: _Keyframe) -> LoopClosure | None:
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
        return LoopClosure(old.stamp_ns, newest.stamp_ns, forth.pose, cov)

    def _only_fit(self, old: _Keyframe, newest: _Keyframe) -> _Fit | None:
        """Best fit round the expected pose; None when there is none, or another that is as good."""
        expected = between(old.pose, newest.pose)
        few = slice(None, None, -(-len(newest.surface.points) // STARTING_POINTS) or 1)
        places: list[FloatArray] = []
        for start in STARTS:
            fit = self._fit(old, newest, expected + np.array(start), few)
            if fit is not None and not any(_is_same(place, fit.pose) for place in places):
                places.append(fit.pose)
        fits = [self._fit(old, newest, place) for place in places]
        good = [fit for fit in fits if fit is not None and fit.share >= self._config.least_share]
        if not good:
            return None
        best = max(good, key=lambda fit: fit.share)
        return best if all(_is_same(best.pose, fit.pose) for fit in good) else None

    def _fit(
        self, old: _Keyframe, newest: _Keyframe, guess: FloatArray, which: slice = ALL_POINTS
    ) -> _Fit | None:
        """Point-to-line Gauss-Newton of a still scan, or of some of its points."""
        sigma = self._config.range_sigma
        points, normals = (
            np.ascontiguousarray(column[which]) for column in (newest.surface.points, newest.surface.normals)
        )
        if len(points) < LEAST_POINTS:
            return None
        basis = np.repeat(_STILL, len(points), axis=0)
        state = np.zeros(12)
        state[6:9] = guess
        for _ in range(ITERATIONS):
            rows, index = old.lines.match(points, normals, basis, state)
            distances = np.abs(rows[index >= 0, 0])
            if len(distances) < LEAST_POINTS:
                return None
            scale = max(2.0 * sigma, 1.5 * float(np.median(distances)))
            sums = old.lines.sums(basis, rows, index, scale)
            if np.linalg.matrix_rank(sums.held(), tol=0.5) < 3:
                return None
            step = np.linalg.solve(sums.pose_hessian, -sums.gradient[6:9])
            state[6:9] += step
            if float(np.abs(step).max()) < 1e-4:
                break
        variance = max(sigma**2, 0.5 * sums.squares / sums.weight)
        gain = np.linalg.inv(sums.pose_hessian)
        cov = variance * (gain + gain @ old.lines.gradient_noise(rows, index, scale) @ gain)
        pose = state[6:9].copy()
        pose[2] = wrap_angle(pose[2])
        share = float(np.count_nonzero(distances < 3.0 * scale)) / len(points)
        return _Fit(pose, 0.5 * (cov + cov.T), share)


def _is_same(a: FloatArray, b: FloatArray) -> bool:
    apart = between(a, b)
    return bool(np.hypot(apart[0], apart[1]) <= SAME[0] and abs(apart[2]) <= SAME[1])


def _distance(a: FloatArray, b: FloatArray) -> float:
    return float(np.hypot(a[0] - b[0], a[1] - b[1]))


def _unlikeness(a: FloatArray, b: FloatArray) -> float:
    """How far apart views are [m]: who does not see all round sees other things when turned."""
    return _distance(a, b) + TURNED * abs(wrap_angle(float(a[2] - b[2])))
