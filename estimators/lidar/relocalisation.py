"""Where in a known map a scan was taken: a global search that tells ambiguity in place of guessing."""

from enum import StrEnum
from typing import TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.ndimage import map_coordinates, maximum_filter

from estimators import chi2
from estimators.base import Setup
from estimators.geometry import compose, rotation
from estimators.immutable import immutable
from estimators.lidar.floor_map import FloorMap
from estimators.messages import FloatArray, RangeFrame
from estimators.models.range import horizontal_range, reduce_height

LEVELS = 6
"""Of the pyramid: its blocks are up to 32 x 32 cells large."""
MOST_CANDIDATES = 8
APART, TURNED_APART = 0.5, np.deg2rad(20.0)
"""Candidates closer than this [m] and [rad] are one."""
REFINEMENTS = 10


class Finding(StrEnum):
    """What a search came to."""

    FOUND = "found"
    AMBIGUOUS = "ambiguous"
    """Several places look alike, and no range tells them apart."""
    NOT_FOUND = "not found"
    """The scan fits nowhere well enough."""


@immutable
class Candidate:
    """A place that a scan fits.

    Attributes:
        pose: (3,) x [m], y [m], yaw [rad] of the body, map frame.
        cov: (3, 3) its covariance.
        score: mean likelihood of the beams' ends, 0 to 1.
        range_nis: sum of squared range residuals over their variance, of four or more without the largest;
            0 without ranges.
    """

    pose: FloatArray
    cov: FloatArray
    score: float
    range_nis: float


@immutable
class Relocation:
    """Result of a search: the candidates, best first, and whether the first is the answer."""

    finding: Finding
    candidates: list[Candidate]


_Range: TypeAlias = tuple[FloatArray, float, float]
"""Anchor, horizontal range [m] and its standard deviation [m]."""


class Relocaliser:
    """Finds scans in one map."""

    class Config(BaseModel):
        """Settings of the search."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        sigma: float = Field(
            0.1, gt=0, le=2, description="of the distance between a beam's end and an obstacle of the map [m]"
        )
        points: int = Field(150, ge=20, le=5000, description="so many points of a scan are compared")
        least_score: float = Field(
            0.6, gt=0, lt=1, description="mean likelihood below which a scan fits nowhere"
        )
        rival: float = Field(
            0.9, gt=0, le=1, description="a second place is a rival from this share of the best score on"
        )
        range_sigma: float = Field(0.1, gt=0, le=10, description="standard deviation of a range [m]")
        range_gate: float = Field(
            0.999, gt=0.5, lt=1, description="share of true places that pass the gate of the ranges"
        )

    def __init__(self, config: Config, floor: FloorMap, setup: Setup) -> None:
        # Numba loads slowly: only who searches waits for it.
        from estimators.kernels import pose_search

        self._kernels = pose_search
        self._config = config
        self._floor = floor
        self._setup = setup
        self._field = floor.likelihood(config.sigma)
        self._pyramid = _pyramid(self._field)

    def locate(self, points: FloatArray, ranges: RangeFrame | None = None) -> Relocation:
        """Search all places and headings.

        Args:
            points: (N, 2) [m] of a deskewed scan, body frame.
            ranges: taken at the same time; where there are four or more, one of them may be blocked.
        """
        config = self._config
        usable = self._usable(ranges)
        thinned = points[np.linspace(0, len(points) - 1, min(config.points, len(points))).astype(int)]
        if len(thinned) < 3:
            return Relocation(Finding.NOT_FOUND, [])
        turns, cells = self._cells(thinned)
        rows, columns = self._field.shape
        spread = int(np.abs(cells).max())
        blocks = self._kernels.top_blocks(
            self._pyramid, cells, -spread, rows + spread, -spread, columns + spread
        )
        blocks = np.ascontiguousarray(blocks[np.argsort(-blocks[:, 0], kind="stable")])
        within = [
            round(TURNED_APART / (2.0 * np.pi) * turns),
            round(APART / self._floor.cell),
        ]
        taken = np.empty((0, 5), dtype=np.int64)
        found: list[Candidate] = []
        least = config.least_score * len(thinned)
        while len(found) < MOST_CANDIDATES:
            total, turn, row, column = self._kernels.search(self._pyramid, cells, blocks, taken, least)
            if turn < 0:
                break
            taken = np.vstack([taken, [[turn, row, column, *within]]])
            T_grid_body = np.array([column, row, 0.0]) * self._floor.cell
            T_grid_body[2] = 2.0 * np.pi * turn / turns
            found.append(self._refined(T_grid_body, thinned, usable))
            # With ranges a place that looks a little worse may be the right one.
            share = config.rival**3 if usable else config.rival
            least = max(least, share * total if len(found) == 1 else least)
        return self._judged(found, usable)

    def _cells(self, points: FloatArray) -> tuple[int, np.ndarray[tuple[int, ...], np.dtype[np.int64]]]:
        """How many headings are tried, and the cells (turns, N, 2) of the points at each."""
        cell = self._floor.cell
        farthest = float(np.hypot(points[:, 0], points[:, 1]).max())
        turns = int(np.ceil(2.0 * np.pi * max(farthest, cell) / cell))
        yaw = 2.0 * np.pi * np.arange(turns)[:, None] / turns
        c, s = np.cos(yaw), np.sin(yaw)
        x, y = points.T
        turned = np.stack([s * x + c * y, c * x - s * y], axis=2) / cell
        return turns, np.floor(turned).astype(np.int64)

    def _refined(self, T_grid_body: FloatArray, points: FloatArray, usable: list[_Range]) -> Candidate:
        """Gauss-Newton on the likelihood of the points, between the cells' centres.

        Source: Kohlbrecher et al., "A flexible and scalable SLAM system", SSRR 2011, Eq. (7)-(13).
        """
        cell, field = self._floor.cell, self._field
        pose = T_grid_body.copy()
        for _ in range(REFINEMENTS):
            turned = points @ rotation(pose[2]).T
            at = ((turned + pose[:2]) / cell - 0.5).T[::-1]
            value = map_coordinates(field, at, order=1, mode="constant", output=np.float64)
            slope_y, slope_x = (
                (
                    map_coordinates(field, at + step, order=1, mode="constant", output=np.float64)
                    - map_coordinates(field, at - step, order=1, mode="constant", output=np.float64)
                )
                / cell
                for step in (np.array([[0.5], [0.0]]), np.array([[0.0], [0.5]]))
            )
            jacobian = np.column_stack([slope_x, slope_y, slope_y * turned[:, 0] - slope_x * turned[:, 1]])
            hessian = jacobian.T @ jacobian + 1e-6 * np.eye(3)
            step = np.linalg.solve(hessian, jacobian.T @ (1.0 - value))
            step *= min(1.0, cell / max(float(np.abs(step[:2]).max()), 1e-12))
            pose = pose + step
        # In these units a point's likelihood errs by about as much as it falls short of one.
        spread = max(float(((1.0 - value) ** 2).mean()), 1e-4)
        T_map_grid = self._floor.T_map_grid
        T_map_body = compose(T_map_grid, pose)
        turn = np.eye(3)
        turn[:2, :2] = rotation(T_map_grid[2])
        cov = turn @ np.linalg.inv(hessian) @ turn.T * spread + np.diag([cell**2 / 12.0] * 2 + [1e-6])
        return Candidate(T_map_body, cov, float(value.mean()), self._range_nis(T_map_body, cov, usable))

    def _usable(self, ranges: RangeFrame | None) -> list[_Range]:
        found: list[_Range] = []
        if ranges is None:
            return found
        for anchor_id, slant in zip(ranges.anchor_ids.tolist(), ranges.ranges.tolist(), strict=True):
            anchor = self._setup.anchors.get(anchor_id)
            if anchor is not None:
                reduced = reduce_height(slant, self._config.range_sigma, self._setup.height_to(anchor))
                if reduced is not None:
                    found.append((anchor, *reduced))
        return found

    def _range_nis(self, pose: FloatArray, cov: FloatArray, usable: list[_Range]) -> float:
        squares = []
        for anchor, measured, sigma in usable:
            predicted, by_pose = horizontal_range(pose, anchor, self._setup.tag_in_body)
            squares.append((measured - predicted) ** 2 / (sigma**2 + float(by_pose @ cov @ by_pose)))
        return float(sum(sorted(squares)[: _counted(usable)]))

    def _judged(self, found: list[Candidate], usable: list[_Range]) -> Relocation:
        if usable:
            gate = float(chi2.ppf(self._config.range_gate, _counted(usable)))
            found = [candidate for candidate in found if candidate.range_nis <= gate]
        if not found:
            return Relocation(Finding.NOT_FOUND, [])
        found.sort(key=lambda candidate: -candidate.score)
        rivals = [c for c in found[1:] if c.score >= self._config.rival * found[0].score]
        return Relocation(Finding.AMBIGUOUS if rivals else Finding.FOUND, found)


def _counted(usable: list[_Range]) -> int:
    """How many ranges are summed up: all of three, all but one of more."""
    return min(len(usable), max(3, len(usable) - 1))


def _pyramid(
    field: np.ndarray[tuple[int, ...], np.dtype[np.float32]],
) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """Maxima (levels, rows, columns) over 2^h x 2^h cells from each cell on."""
    levels = [field]
    for level in range(1, LEVELS):
        size = 1 << level
        # The filter's window begins at the cell itself.
        levels.append(maximum_filter(field, size=size, mode="constant", cval=0.0, origin=-(size // 2)))
    return np.ascontiguousarray(np.stack(levels))
