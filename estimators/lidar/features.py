"""Walls, corners and poles in a scan: what EKF-SLAM keeps of it.

A *wall* is a straight run of points. A *corner* is the end of a wall with free space behind it: where two
walls meet, both say all there is to say, and a point made of the two would count their noise twice. A *pole*
is a thin thing that stands alone.
"""

import numpy as np
from numpy.typing import NDArray

from estimators.geometry import wrap_angles
from estimators.immutable import immutable
from estimators.messages import FloatArray, IntArray

STEEPEST = np.deg2rad(10.0)
"""Neighbouring points are of one surface when a wall that a beam meets at this angle could hold both."""
SPLIT_SIGMAS = 3.0
"""A run is split where it is further from its chord than so many standard deviations of a range."""
SMOOTHED = 2
"""... in the mean over so many points to either side. As many are left out at the ends of a wall: they may be
those of the next one."""
LEAST_WALL_POINTS = 6
LEAST_POLE_POINTS = 4
MOST_BOW = 4.0
"""A run that bends by more than so many standard deviations is round, and no wall."""
SHARP = np.deg2rad(40.0)
"""Pieces of a run that bend by less where they meet are of something round, and no walls ..."""
MOST_BEND = 3.0
"""... if they bend by more than so many standard deviations."""
MOST_NOISE = 2.0
"""Points of a wall scatter by at most so many standard deviations of a range."""
LEAST_WALL = 0.3
"""Length of the shortest wall [m]."""
WIDEST_POLE = 0.3
"""Diameter of the thickest pole [m]."""
LEAST_STEP = 0.25
"""What stands behind a corner or a pole is at least so much further away [m]."""
HOLE = 1.6
"""Beams further apart than so many times the usual step have a hole between them."""
POLE_SHAPE = 0.4
"""Standard deviation of a pole's centre along the beam, for who does not know its shape, in its radii."""
_MEAN_DEPTH = np.pi / 4.0
"""Mean of how far a circle's near side stands out, in its radii."""


@immutable
class Walls:
    """Straight runs of points, K of them, N points in all.

    Attributes:
        points: (N,) indices of their points, wall by wall.
        begin: (K,) where each wall begins in `points`.
        size: (K,) its number of points.
        centre: (K, 2) mean of its points [m].
        angle: (K,) direction of its normal, which points to the scanner [rad].
        low: (K,) where it begins, along its direction, which is the normal's turned to the left, from the
            centre [m].
        high: (K,) where it ends, likewise.
        lever: (N,) weights of the points in its slope: distance along it from the centre, over the sum of
            the squares of these.
        noise: (K, 2) variances of its mean distance [m^2] and of its slope [rad^2].
    """

    points: IntArray
    begin: IntArray
    size: IntArray
    centre: FloatArray
    angle: FloatArray
    low: FloatArray
    high: FloatArray
    lever: FloatArray
    noise: FloatArray


NO_WALLS = Walls(
    points=np.zeros(0, dtype=np.int64),
    begin=np.zeros(0, dtype=np.int64),
    size=np.zeros(0, dtype=np.int64),
    centre=np.zeros((0, 2)),
    angle=np.zeros(0),
    low=np.zeros(0),
    high=np.zeros(0),
    lever=np.zeros(0),
    noise=np.zeros((0, 2)),
)


@immutable
class Spots:
    """Corners or poles, K of them.

    Attributes:
        position: (K, 2) [m].
        beam: (K,) index of the point at whose instant it was seen.
        axis: (K, 2) unit vector along which it is known best.
        noise: (K, 2) variances along `axis` and square to it [m^2].
        turn: (K,) variance of the direction of `axis` [rad^2].
    """

    position: FloatArray
    beam: IntArray
    axis: FloatArray
    noise: FloatArray
    turn: FloatArray


@immutable
class Features:
    """What was found in a scan."""

    walls: Walls
    corners: Spots
    poles: Spots


def find_features(points: FloatArray, origins: FloatArray, range_sigma: float) -> Features:
    """Walls, corners and poles.

    Args:
        points: (N, 2) [m] where beams ended, in the order of the beams.
        origins: (N, 2) [m] where they began.
        range_sigma: standard deviation of a range [m].

    Source: breakpoints: Borges and Aldon, "Line extraction in 2D range images for mobile robotics", Journal
    of Intelligent and Robotic Systems 40, 2004; splitting: Nguyen et al., "A comparison of line extraction
    algorithms using 2D laser rangefinder", IROS 2005.
    """
    beams = points - origins
    ranges = np.hypot(beams[:, 0], beams[:, 1])
    beams = beams / ranges[:, None]
    bearings = np.arctan2(beams[:, 1], beams[:, 0])
    steps = np.abs(wrap_angles(np.diff(bearings)))
    usual = float(np.median(steps)) if len(steps) else 0.0
    gaps = np.hypot(*np.diff(points, axis=0).T)
    nearer = np.minimum(ranges[1:], ranges[:-1])
    whole = steps <= HOLE * usual
    apart = ~whole | (gaps > nearer * steps / np.sin(STEEPEST) + 5.0 * range_sigma)
    cuts = np.flatnonzero(apart) + 1
    bounds = np.concatenate([[0], cuts, [len(points)]])
    straight = _split(_smooth(points, bounds), bounds, SPLIT_SIGMAS * range_sigma)
    walls, spans = _walls(points, beams, straight, range_sigma)
    # Beyond the ends of the scan there is a hole.
    open_after = np.append(whole & (np.diff(ranges) > LEAST_STEP), False)
    open_before = np.concatenate([[False], whole & (np.diff(ranges) < -LEAST_STEP)])
    corners = _corners(walls, spans, points, origins, bearings, usual, open_before, open_after, range_sigma)
    runs = np.column_stack([bounds[:-1], bounds[1:]])
    stand_alone = open_before[runs[:, 0]] & open_after[runs[:, 1] - 1] if len(points) else np.zeros(0, bool)
    poles = _poles(runs[stand_alone], origins, ranges, bearings, usual, range_sigma)
    return Features(walls, corners, poles)


def _smooth(points: FloatArray, bounds: IntArray) -> FloatArray:
    """Every point as the mean of itself and its neighbours in the same run."""
    index, length = np.arange(len(points)), np.diff(bounds)
    first = np.maximum(index - SMOOTHED, np.repeat(bounds[:-1], length))
    last = np.minimum(index + SMOOTHED + 1, np.repeat(bounds[1:], length))
    sums = np.vstack([np.zeros(2), np.cumsum(points, axis=0)])
    smooth: FloatArray = (sums[last] - sums[first]) / (last - first)[:, None]
    return smooth


def _split(points: FloatArray, bounds: IntArray, threshold: float) -> list[tuple[int, int]]:
    """Runs (begin, end) between the bounds, split where they bend; only those long enough for a wall."""
    straight = []
    waiting = list(zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True))[::-1]
    while waiting:
        begin, end = waiting.pop()
        if end - begin < LEAST_WALL_POINTS + 2 * SMOOTHED:
            continue
        chord = points[end - 1] - points[begin]
        length = float(np.hypot(chord[0], chord[1]))
        x, y = (points[begin:end] - points[begin]).T
        # A run that comes back to where it began has no chord: it is split where it is furthest.
        off = np.abs(x * chord[1] - y * chord[0]) / length if length > threshold else np.hypot(x, y)
        worst = int(off.argmax())
        if off[worst] > threshold and 0 < worst < end - begin - 1:
            waiting += [(begin + worst, end), (begin, begin + worst + 1)]
        else:
            straight.append((begin, end))
    return straight


def _walls(
    points: FloatArray, beams: FloatArray, straight: list[tuple[int, int]], range_sigma: float
) -> tuple[Walls, IntArray]:
    """Lines through the runs, as far as they are walls; and the runs (K, 2) of these, begin and end."""
    spans = np.array(straight, dtype=np.int64).reshape(-1, 2)
    size = spans[:, 1] - spans[:, 0] - 2 * SMOOTHED
    begin = np.cumsum(size) - size
    own = np.repeat(np.arange(len(spans)), size)
    chosen = np.arange(len(own)) - begin[own] + spans[own, 0] + SMOOTHED

    def mean(values: FloatArray) -> FloatArray:
        sums: FloatArray = np.add.reduceat(values, begin, axis=0)
        return (sums.T / size).T

    if not len(spans):
        return NO_WALLS, spans
    centre = mean(points[chosen])
    x, y = (points[chosen] - centre[own]).T
    xx, xy, yy = mean(x * x), mean(x * y), mean(y * y)
    along = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    # The scanner is on the side of the normal, which is the direction turned to the right.
    to_points = mean(beams[chosen])
    faces_away = np.sin(along) * to_points[:, 0] - np.cos(along) * to_points[:, 1] > 0.0
    along = np.where(faces_away, along + np.pi, along)
    c, s = np.cos(along)[own], np.sin(along)[own]
    u, off = c * x + s * y, s * x - c * y
    spread, scatter = mean(u * u), mean(off * off)
    # A bow is what is square to an offset and to a slope.
    bow = u * u - spread[own]
    bow -= u * (mean(bow * u) / spread)[own]
    bent = np.abs(mean(bow * off)) * np.sqrt(size / (mean(bow * bow) * np.maximum(scatter, range_sigma**2)))
    square = s * beams[chosen, 0] - c * beams[chosen, 1]
    variance = np.maximum(range_sigma**2 * mean(square**2), scatter * size / np.maximum(size - 2, 1))
    low, high = np.minimum.reduceat(u, begin), np.maximum.reduceat(u, begin)
    slopes = variance / (spread * size)
    turn = np.abs(wrap_angles(np.diff(along)))
    goes_on = (spans[1:, 0] < spans[:-1, 1]) & (turn < SHARP)
    bends = goes_on & (turn > MOST_BEND * np.sqrt(slopes[1:] + slopes[:-1]))
    surface = np.concatenate([[0], np.cumsum(~goes_on)])
    is_round = np.isin(surface, surface[1:][bends])
    good = (
        ~is_round
        & (high - low >= LEAST_WALL)
        & (bent < MOST_BOW)
        & (scatter < (MOST_NOISE * range_sigma) ** 2)
    )
    of_good = good[own]
    return Walls(
        chosen[of_good],
        np.cumsum(size[good]) - size[good],
        size[good],
        centre[good],
        wrap_angles(along[good] - 0.5 * np.pi),
        low[good],
        high[good],
        (u / (spread * size)[own])[of_good],
        np.column_stack([variance / size, slopes])[good],
    ), spans[good]


def _corners(
    walls: Walls,
    spans: IntArray,
    points: FloatArray,
    origins: FloatArray,
    bearings: FloatArray,
    usual: float,
    open_before: NDArray[np.bool_],
    open_after: NDArray[np.bool_],
    range_sigma: float,
) -> Spots:
    """Ends of walls behind which the next beam goes on: between the last beam that met it and that one."""
    first = np.flatnonzero(open_before[spans[:, 0]])
    last = np.flatnonzero(open_after[spans[:, 1] - 1])
    wall = np.concatenate([first, last])
    beam = np.concatenate([spans[first, 0], spans[last, 1] - 1])
    beyond = np.concatenate([spans[first, 0] - 1, spans[last, 1]])
    # Along a wall that is seen at a glance, the next beam may meet the same wall far away.
    normal = np.column_stack([np.cos(walls.angle[wall]), np.sin(walls.angle[wall])])
    behind = (normal * (walls.centre[wall] - points[beyond])).sum(axis=1) > LEAST_STEP
    wall, beam, beyond, normal = wall[behind], beam[behind], beyond[behind], normal[behind]
    turned = 0.5 * wrap_angles(bearings[beyond] - bearings[beam])
    towards = bearings[beam] + turned
    ray = np.column_stack([np.cos(towards), np.sin(towards)])
    sine = -(normal * ray).sum(axis=1)
    distance = (normal * (origins[beam] - walls.centre[wall])).sum(axis=1) / sine
    # The edge is anywhere between the beams.
    along = (distance * usual / sine) ** 2 / 12.0
    return Spots(
        origins[beam] + distance[:, None] * ray,
        beam,
        np.column_stack([-normal[:, 1], normal[:, 0]]),
        np.column_stack([along, np.full(len(along), (SPLIT_SIGMAS * range_sigma) ** 2)]),
        walls.noise[wall, 1],
    )


def _poles(
    runs: IntArray,
    origins: FloatArray,
    ranges: FloatArray,
    bearings: FloatArray,
    usual: float,
    range_sigma: float,
) -> Spots:
    """Runs narrow enough for a pole."""
    size = runs[:, 1] - runs[:, 0]
    middle = runs[:, 0] + size // 2
    width = size * usual * ranges[middle]
    thin = (size >= LEAST_POLE_POINTS) & (width <= WIDEST_POLE)
    runs, middle, size, radius = runs[thin], middle[thin], size[thin], 0.5 * width[thin]
    nearest = np.array([ranges[begin:end].mean() for begin, end in runs.tolist()])
    first, last = bearings[runs[:, 0]], bearings[runs[:, 1] - 1]
    towards = first + 0.5 * wrap_angles(last - first)
    ray = np.column_stack([np.cos(towards), np.sin(towards)])
    distance = nearest + _MEAN_DEPTH * radius
    # Either edge is anywhere between two beams, the middle is the mean of both.
    across = (distance * usual) ** 2 / 24.0
    depth = range_sigma**2 / size + (POLE_SHAPE * radius) ** 2
    return Spots(
        origins[middle] + distance[:, None] * ray,
        middle,
        np.column_stack([-ray[:, 1], ray[:, 0]]),
        np.column_stack([across, depth]),
        np.zeros(len(middle)),
    )
