"""Points of a scan: what came back, how far it is, and where it is as seen from the end of the scan."""

from math import cos, hypot, pi, sin, sqrt, tau

import numpy as np
from numpy.typing import NDArray

from estimators.kernels.compilation import MATRIX, VECTOR, compiled
from estimators.messages import FloatArray

BooleanArray = NDArray[np.bool_]
BOOLEANS = "boolean[::1]"


@compiled(
    f"Tuple(({MATRIX}, {VECTOR}, {BOOLEANS}))"
    f"({VECTOR}, {VECTOR}, {VECTOR}, {VECTOR}, float64, float64, int64, float64)"
)
def returns(
    angles: FloatArray,
    ranges: FloatArray,
    beam_times: FloatArray,
    T_body_lidar: FloatArray,
    min_range: float,
    max_range: float,
    max_points: int,
    spacing: float,
) -> tuple[FloatArray, FloatArray, BooleanArray]:
    """Where beams ended that are good for anything.

    Args:
        angles: (N,) [rad], lidar frame; not finite where a beam is none.
        ranges: (N,) [m]; 0, or not finite, where nothing came back.
        beam_times: (N,) [s].
        T_body_lidar: (3,) mounting of the lidar in the body: x [m], y [m], yaw [rad].
        min_range: nearer returns are left out [m].
        max_range: returns from further away are left out [m].
        max_points: of more returns every second (third, ...) is left.
        spacing: of beams where they end [m].

    Returns:
        Points (M, 2) [m], body frame; their times (M,) [s] after the last of all beams, so never positive;
        and which of them to keep, (M,), so that there is at least about the spacing between them.
    """
    count = len(angles)
    kept, found = np.empty(count, dtype=np.int64), 0
    for i in range(count):
        if ranges[i] > 0.0 and min_range <= ranges[i] <= max_range and np.isfinite(angles[i]):
            kept[found] = i
            found += 1
    every = max(-(-found // max_points), 1)
    left = -(-found // every)
    points, times, apart = np.empty((left, 2)), np.empty(left), np.ones(left, dtype=np.bool_)
    c, s = cos(T_body_lidar[2]), sin(T_body_lidar[2])
    way, cell, before = 0.0, -1.0, 0.0
    for k in range(left):
        i = kept[k * every]
        angle, distance = angles[i], ranges[i]
        x, y = distance * cos(angle), distance * sin(angle)
        points[k, 0] = c * x - s * y + T_body_lidar[0]
        points[k, 1] = s * x + c * y + T_body_lidar[1]
        times[k] = beam_times[i] - beam_times[-1]
        if spacing > 0.0:
            # Square to the beams: the noise of ranges is none.
            turn = angle - before if k else 0.0
            way += abs((turn + pi) % tau - pi) * distance
            reached = np.floor(way / spacing)
            apart[k] = reached > cell
            cell, before = reached, angle
    return points, times, apart


@compiled(f"{MATRIX}({VECTOR}, {VECTOR}, {VECTOR}, {VECTOR})")
def ends_of_beams(
    angles: FloatArray, ranges: FloatArray, beam_times: FloatArray, T_last_first: FloatArray
) -> FloatArray:
    """Where beams that came back ended, as the scanner sees it at the last beam.

    Args:
        angles: (N,) [rad], lidar frame.
        ranges: (N,) [m]; 0, or not finite, where nothing came back.
        beam_times: (N,) [s] after the first beam.
        T_last_first: (3,) scanner at the first beam, seen from where it was at the last; it moved steadily.

    Returns:
        (M, 2) [m].
    """
    ends, found = np.empty((len(angles), 2)), 0
    for i in range(len(angles)):
        if not 0.0 < ranges[i] < np.inf:
            continue
        to_go = 1.0 - beam_times[i] / beam_times[-1]
        angle = angles[i] + to_go * T_last_first[2]
        ends[found, 0] = to_go * T_last_first[0] + ranges[i] * cos(angle)
        ends[found, 1] = to_go * T_last_first[1] + ranges[i] * sin(angle)
        found += 1
    return ends[:found]


@compiled(f"Tuple((float64, float64, float64))({MATRIX}, {MATRIX}, {VECTOR})")
def extent(points: FloatArray, normals: FloatArray, scanner: FloatArray) -> tuple[float, float, float]:
    """How far surface points are, and how squarely beams meet them.

    Args:
        points: (N, 2) [m], body frame; at least one.
        normals: (N, 2) unit normals of the surface there.
        scanner: x [m], y [m] of the scanner in the body.

    Returns:
        Mean and greatest distance from the body [m]; root of the mean square of the cosine between a beam and
        the normal.
    """
    total, greatest, squares = 0.0, 0.0, 0.0
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        distance = hypot(x, y)
        total += distance
        greatest = max(greatest, distance)
        x, y = x - scanner[0], y - scanner[1]
        squares += (x * normals[i, 0] + y * normals[i, 1]) ** 2 / (x * x + y * y)
    return total / len(points), greatest, sqrt(squares / len(points))


@compiled(f"{MATRIX}({MATRIX}, {MATRIX}, {VECTOR})")
def seen_from_end(points: FloatArray, basis: FloatArray, states: FloatArray) -> FloatArray:
    """Points of a scan as the body sees them at the end of it.

    Args:
        points: (N, 2) [m], each in the body frame of its own instant.
        basis: (N, 4) weights of the states' four vectors in the pose at that instant.
        states: (12,) pose and velocity at the end of the scan before, and at the end of this one.

    Returns:
        (N, 2) [m].
    """
    seen = np.empty_like(points)
    end_c, end_s = cos(states[8]), sin(states[8])
    for i in range(len(points)):
        b0, b1, b2, b3 = basis[i, 0], basis[i, 1], basis[i, 2], basis[i, 3]
        yaw = b0 * states[2] + b1 * states[5] + b2 * states[8] + b3 * states[11]
        c, s = cos(yaw), sin(yaw)
        x = b0 * states[0] + b1 * states[3] + b2 * states[6] + b3 * states[9] - states[6]
        y = b0 * states[1] + b1 * states[4] + b2 * states[7] + b3 * states[10] - states[7]
        x += c * points[i, 0] - s * points[i, 1]
        y += s * points[i, 0] + c * points[i, 1]
        seen[i, 0], seen[i, 1] = end_c * x + end_s * y, end_c * y - end_s * x
    return seen
