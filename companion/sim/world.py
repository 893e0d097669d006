"""Walls and boxes: what a LiDAR beam hits, and what stands between a tag and an anchor."""

import numpy as np
from numpy.typing import NDArray

from estimators.messages import FloatArray

WALL_HEIGHT = 10.0
"""Height [m] of walls: above every anchor."""


class World:
    """Vertical surfaces over a floor plan.

    Args:
        polylines: walls, each a list of corners (x, y) [m]; repeat the first corner to close one.
        boxes: obstacles as (centre x, centre y, length x, length y, yaw [rad], height [m]).
    """

    def __init__(
        self,
        polylines: list[list[tuple[float, float]]],
        boxes: list[tuple[float, float, float, float, float, float]],
    ) -> None:
        segments: list[FloatArray] = []
        heights: list[float] = []
        for polyline in polylines:
            corners = np.array(polyline, dtype=np.float64)
            segments.append(np.hstack([corners[:-1], corners[1:]]))
            heights += [WALL_HEIGHT] * (len(corners) - 1)
        self.footprints = [box_outline(*box[:5]) for box in boxes]
        """Outlines of the boxes, closed, (5, 2) each [m]."""
        for corners, (*_, height) in zip(self.footprints, boxes, strict=True):
            segments.append(np.hstack([corners[:-1], corners[1:]]))
            heights += [height] * 4
        self._segments = np.vstack(segments)
        self._heights = np.array(heights)

    @property
    def segments(self) -> FloatArray:
        """All surfaces as (M, 4) of x1, y1, x2, y2 [m]."""
        return self._segments

    def ray_cast(self, origins: FloatArray, angles: FloatArray, heights: float) -> FloatArray:
        """Distance to the nearest surface along each beam.

        Args:
            origins: (N, 2) [m], map frame.
            angles: (N,) [rad], map frame, counter-clockwise from x.
            heights: height of the beams above the floor [m]; lower boxes are not seen.

        Returns:
            (N,) [m]; infinite where nothing is hit.
        """
        seen = self._segments[self._heights > heights]
        directions = np.column_stack([np.cos(angles), np.sin(angles)])
        along = _crossings(origins, directions, seen)
        distances: FloatArray = along.min(axis=1)
        return distances

    def line_of_sight(self, point: FloatArray, targets: FloatArray) -> NDArray[np.bool_]:
        """Which targets a point sees.

        Args:
            point: (3,) [m], map frame.
            targets: (N, 3) [m], map frame.

        Returns:
            (N,) True where no surface crosses the straight line.
        """
        offset = targets - point
        origins = np.broadcast_to(point[:2], (len(targets), 2))
        along = _crossings(origins, offset[:, :2], self._segments)
        crossing_height = point[2] + np.where(np.isfinite(along), along, 0.0) * offset[:, 2:3]
        blocked = (along < 1.0) & (crossing_height < self._heights)
        clear: NDArray[np.bool_] = ~blocked.any(axis=1)
        return clear


def box_outline(x: float, y: float, length_x: float, length_y: float, yaw: float) -> FloatArray:
    """Closed outline (5, 2) [m] of a box."""
    half = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]]) * [length_x / 2, length_y / 2]
    c, s = np.cos(yaw), np.sin(yaw)
    outline: FloatArray = half @ np.array([[c, s], [-s, c]]) + [x, y]
    return outline


def _crossings(origins: FloatArray, directions: FloatArray, segments: FloatArray) -> FloatArray:
    """Where rays cross segments, (N, M), in units of `directions`; infinite where they do not."""
    start = segments[:, :2]
    edge = segments[:, 2:] - start
    denominator = directions[:, 0:1] * edge[:, 1] - directions[:, 1:2] * edge[:, 0]
    to_start_x = start[:, 0] - origins[:, 0:1]
    to_start_y = start[:, 1] - origins[:, 1:2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        along = (to_start_x * edge[:, 1] - to_start_y * edge[:, 0]) / denominator
        across = (to_start_x * directions[:, 1:2] - to_start_y * directions[:, 0:1]) / denominator
        hit = (along > 1e-9) & (across >= 0.0) & (across <= 1.0)
    return np.where(hit, along, np.inf)
