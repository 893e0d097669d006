"""How accurate ranges can be over a floor, where they are bad, and where one more anchor helps most."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from matplotlib.path import Path as Polygon
from numpy.typing import NDArray
from scipy.ndimage import label

from companion.config import Config
from companion.errors import UserError
from companion.sim.world import World
from estimators.bounds import position_information
from estimators.immutable import immutable
from estimators.messages import FloatArray

_CELLS = 60
"""Cells along the longer side of the floor."""
_LEAST_CELL = 0.05
"""[m]."""
_OFF_WALL = 0.15
"""An anchor on a wall stands out from it by this [m]."""
_ANCHOR_STEP = 0.5
"""Places for one more anchor are tried every so far along the walls [m]."""
_MOST_SPOTS = 3


@dataclass(frozen=True, slots=True)
class Spot:
    """A part of the floor where ranges are bad.

    Attributes:
        x: of its middle [m], map frame; the same for y.
        area: [m^2].
        worst: largest error in it [m]; infinite without a fix.
    """

    x: float
    y: float
    area: float
    worst: float


@immutable
class Layout:
    """Accuracy over the floor, with the anchors there are and with one more.

    Attributes:
        x: (C,) of the cells' middles [m], map frame.
        y: (R,) the same.
        error: (R, C) least position error of one frame of ranges, root mean square [m]; infinite where
            ranges give no position, NaN off the floor.
        limit: error that is still good [m].
        spots: where it is worse, the largest first.
        extra: (3,) the place where one more anchor helps most [m], map frame.
        error_with_extra: (R, C) as `error`.
        segments: (M, 4) x1, y1, x2, y2 [m] of what blocks ranges.
    """

    x: FloatArray
    y: FloatArray
    error: FloatArray
    limit: float
    spots: list[Spot]
    extra: FloatArray
    error_with_extra: FloatArray
    segments: FloatArray

    def good_share(self, error: FloatArray) -> float:
        """Share of the floor with an error within the limit."""
        return float((error[~np.isnan(error)] <= self.limit).mean())

    def lines(self) -> list[str]:
        """What the picture says, in words."""
        lines = [f"now: {_summary(self.error, self)}"]
        lines += [
            f"bad: {spot.area:.1f} m2 round ({spot.x:.1f}, {spot.y:.1f}), "
            + (f"up to {spot.worst:.2f} m" if np.isfinite(spot.worst) else "in part without a position")
            for spot in self.spots
        ]
        x, y, z = self.extra.tolist()
        lines.append(
            f"one more anchor at ({x:.2f}, {y:.2f}, {z:.2f}): {_summary(self.error_with_extra, self)}"
        )
        return lines


def plan_layout(
    config: Config, world: World | None = None, limit: float = 0.2, sigma: float | None = None
) -> Layout:
    """Find out how accurate ranges can be over the floor of a site.

    Args:
        config: of the site; its outermost closed wall is the edge of the floor.
        world: what blocks ranges; None for the site's walls alone.
        limit: error that is still good [m].
        sigma: standard deviation of a range [m]; None for that of `ekf`.

    Raises:
        UserError: the site has no closed wall.
    """
    closed = [np.array(wall) for wall in config.site.walls if len(wall) > 3 and wall[0] == wall[-1]]
    if not closed:
        raise UserError(f"site {config.site.name!r}: no closed wall in site.walls, the floor has no edge")
    edge = max(closed, key=lambda wall: float(np.prod(np.ptp(wall, axis=0))))
    world = world or World([list(wall) for wall in config.site.walls], [])
    if sigma is None:
        sigma = float(config.estimator_config("ekf").model_dump()["range_sigma"])
    cell = max(float(np.ptp(edge, axis=0).max()) / _CELLS, _LEAST_CELL)
    low, high = edge.min(axis=0), edge.max(axis=0)
    x, y = (np.arange(low[i] + cell / 2, high[i], cell) for i in (0, 1))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    floor = Polygon(edge).contains_points(grid)
    for footprint in world.footprints:
        floor &= ~Polygon(footprint).contains_points(grid)
    height = config.body.height + config.body.tag[2]
    points = np.column_stack([grid[floor], np.full(int(floor.sum()), height)])

    anchors = np.array(list(config.anchors.values()))
    candidates = _places(edge, float(anchors[:, 2].mean()))
    sees = np.array([world.line_of_sight(point, np.vstack([anchors, candidates])) for point in points])
    seen, candidate_seen = sees[:, : len(anchors)], sees[:, len(anchors) :]
    information = position_information(points, anchors, seen, sigma)
    errors = _errors(information)
    with_extra = [
        _errors(information + position_information(points, candidates[[k]], candidate_seen[:, [k]], sigma))
        for k in range(len(candidates))
    ]
    # Where there is no position, a metre of error stands for it: far more than any limit of use.
    cost = [np.minimum(each, max(1.0, 2.0 * limit)).mean() for each in with_extra]
    best = int(np.argmin(cost))

    def on_grid(values: FloatArray) -> FloatArray:
        whole = np.full(len(grid), np.nan)
        whole[floor] = values
        return whole.reshape(len(y), len(x))

    error = on_grid(errors)
    return Layout(
        x=x,
        y=y,
        error=error,
        limit=limit,
        spots=_spots(x, y, error, limit),
        extra=candidates[best],
        error_with_extra=on_grid(with_extra[best]),
        segments=world.segments,
    )


def _errors(information: FloatArray) -> FloatArray:
    """Root of the trace of the inverse of each (2, 2); infinite where there is none."""
    determinant = information[:, 0, 0] * information[:, 1, 1] - information[:, 0, 1] ** 2
    trace = information[:, 0, 0] + information[:, 1, 1]
    singular = determinant <= 1e-9 * trace**2
    return np.sqrt(np.where(singular, np.inf, trace) / np.where(singular, 1.0, determinant))


def _places(edge: FloatArray, height: float) -> FloatArray:
    """Places (K, 3) for an anchor along a closed wall, on its inner side."""
    inside = Polygon(edge)
    places = []
    for begin, end in pairwise(edge):
        length = float(np.hypot(*(end - begin)))
        along = (end - begin) / length
        normal = np.array([-along[1], along[0]])
        for distance in np.arange(_OFF_WALL, length - _OFF_WALL / 2, _ANCHOR_STEP):
            for side in (1.0, -1.0):
                place = begin + along * distance + side * normal * _OFF_WALL
                if inside.contains_point(place):
                    places.append([*place, height])
    return np.array(places)


def _spots(x: FloatArray, y: FloatArray, error: FloatArray, limit: float) -> list[Spot]:
    bad: NDArray[np.bool_] = np.nan_to_num(error, nan=0.0) > limit
    areas, count = label(bad)
    cell = float(x[1] - x[0]) * float(y[1] - y[0])
    spots = []
    for number in range(1, count + 1):
        rows, columns = np.nonzero(areas == number)
        worst = float(error[rows, columns].max())
        spots.append(Spot(float(x[columns].mean()), float(y[rows].mean()), len(rows) * cell, worst))
    return sorted(spots, key=lambda spot: -spot.area)[:_MOST_SPOTS]


def _summary(error: FloatArray, layout: Layout) -> str:
    known = error[~np.isnan(error)]
    without = float(np.isinf(known).mean())
    return (
        f"median {np.median(known):.3f} m, {layout.good_share(error):.0%} of the floor within "
        f"{layout.limit:g} m, {without:.0%} without a position"
    )
