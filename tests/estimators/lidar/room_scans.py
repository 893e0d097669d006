"""Scans of straight walls by a moving lidar: a small ray caster, so that the truth is known exactly."""

from dataclasses import dataclass

import numpy as np

from estimators.geometry import inverse, transform
from estimators.lidar.floor_map import FloorMap
from estimators.messages import FloatArray, Scan

BEAMS = 400
PERIOD = 0.1
REACH = 12.0
CELL = 0.05


def rectangle(x0: float, y0: float, x1: float, y1: float) -> FloatArray:
    """Four walls, (4, 2, 2): start and end of each [m]."""
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


ROOM = np.vstack([rectangle(0.0, 0.0, 6.0, 4.5), rectangle(4.2, 2.8, 5.0, 3.4)])
OTHER_ROOM = np.vstack([rectangle(-9.0, -8.0, 9.5, 10.0), rectangle(6.0, -4.0, 7.0, 5.0)])
CORRIDOR = np.array([[[-50.0, 0.0], [50.0, 0.0]], [[-50.0, 2.0], [50.0, 2.0]]])


def cast(walls: FloatArray, origins: FloatArray, directions: FloatArray) -> FloatArray:
    """Distance to the nearest wall along each ray [m]; 0 where none is within `REACH`.

    Args:
        walls: (M, 2, 2) [m].
        origins: (N, 2) [m].
        directions: (N, 2) unit vectors.
    """
    along = walls[:, 1] - walls[:, 0]
    to_wall = walls[None, :, 0] - origins[:, None]
    # origin + t direction = start + s along, by Cramer's rule.
    det = directions[:, None, 0] * along[None, :, 1] - directions[:, None, 1] * along[None, :, 0]
    safe = np.where(np.abs(det) < 1e-12, np.inf, det)
    t = (to_wall[..., 0] * along[None, :, 1] - to_wall[..., 1] * along[None, :, 0]) / safe
    s = (to_wall[..., 0] * directions[:, None, 1] - to_wall[..., 1] * directions[:, None, 0]) / safe
    hit = (np.abs(det) >= 1e-12) & (t > 0.0) & (s >= 0.0) & (s <= 1.0)
    nearest: FloatArray = np.where(hit, t, np.inf).min(axis=1)
    return np.where(nearest <= REACH, nearest, 0.0)


def drawn(walls: FloatArray, T_map_grid: FloatArray) -> FloorMap:
    """Walls (M, 2, 2) as cells of a grid that may lie askew in the map."""
    corners = transform(inverse(T_map_grid), walls.reshape(-1, 2)).reshape(-1, 2, 2)
    share = np.linspace(0.0, 1.0, 2000)[:, None, None]
    on_wall = (corners[:, 0] + share * (corners[:, 1] - corners[:, 0])).reshape(-1, 2)
    cells = np.floor(on_wall / CELL).astype(int)
    assert (cells >= 0).all()
    occupied = np.zeros(cells.max(axis=0)[::-1] + 3, dtype=bool)
    occupied[cells[:, 1], cells[:, 0]] = True
    return FloorMap(occupied, ~occupied, CELL, T_map_grid)


@dataclass(frozen=True, slots=True)
class Arc:
    """Motion with constant body velocity: a straight line, a turn on the spot or an arc.

    Attributes:
        start: (3,) pose at time 0 in the map.
        twist: (3,) forward [m/s], left [m/s], counter-clockwise [rad/s].
    """

    start: FloatArray
    twist: FloatArray

    def poses(self, times: FloatArray) -> FloatArray:
        """Poses in the map at `times` [s], (N, 3)."""
        forward, left, rate = self.twist
        yaw = rate * times
        # sin(w t)/w and (1 - cos(w t))/w, which np.sinc keeps finite at w = 0.
        straight = times * np.sinc(yaw / np.pi)
        sideways = times * np.sinc(yaw / (2 * np.pi)) * np.sin(yaw / 2)
        x, y = straight * forward - sideways * left, sideways * forward + straight * left
        c, s = np.cos(self.start[2]), np.sin(self.start[2])
        return np.column_stack(
            [self.start[0] + c * x - s * y, self.start[1] + s * x + c * y, self.start[2] + yaw]
        )


@dataclass(frozen=True, slots=True)
class Loop:
    """From rest, drive round the room's middle and look about: speed and turn rate change all the time.

    Attributes:
        speed: of going round, as a factor; about 0.5 m/s and up to 0.9 rad/s at 1.
    """

    speed: float = 1.0

    def poses(self, times: FloatArray) -> FloatArray:
        """Poses in the map at `times` [s], (N, 3)."""
        phase = 0.45 * self.speed * (times - (1.0 - np.exp(-times)))
        x, y = 2.6 + 1.3 * np.cos(phase), 1.9 + 1.0 * np.sin(phase)
        return np.column_stack([x, y, phase + 0.5 * np.sin(2.1 * phase)])


def scan_while_moving(
    walls: FloatArray,
    path: Arc | Loop,
    start: float,
    rng: np.random.Generator | None = None,
    range_sigma: float = 0.0,
    lidar_in_body: FloatArray | None = None,
    period: float = PERIOD,
) -> Scan:
    """One revolution, each beam from where the lidar is at its own instant.

    Args:
        walls: (M, 2, 2) [m], map frame.
        path: motion of the body.
        start: time of the first beam [s].
        rng: source of range noise.
        range_sigma: its standard deviation [m].
        lidar_in_body: (3,) mounting; at the body origin without it.
        period: of the revolution [s].
    """
    mounting = np.zeros(3) if lidar_in_body is None else lidar_in_body
    angles = 2 * np.pi * np.arange(BEAMS) / BEAMS
    times = period * np.arange(BEAMS) / BEAMS
    body = path.poses(start + times)
    c, s = np.cos(body[:, 2]), np.sin(body[:, 2])
    origins = body[:, :2] + np.column_stack(
        [c * mounting[0] - s * mounting[1], s * mounting[0] + c * mounting[1]]
    )
    heading = body[:, 2] + mounting[2] + angles
    ranges = cast(walls, origins, np.column_stack([np.cos(heading), np.sin(heading)]))
    if rng is not None:
        ranges = np.where(ranges > 0.0, ranges + rng.normal(0.0, range_sigma, BEAMS), 0.0)
    return Scan(round(start * 1e9), angles, ranges, times, np.zeros(BEAMS))


def true_increment(path: Arc | Loop, from_stamp_ns: int, stamp_ns: int) -> FloatArray:
    """Motion of the body between two stamps, (3,), by matrices: a reference of its own."""
    matrices = []
    for x, y, yaw in path.poses(np.array([from_stamp_ns, stamp_ns]) * 1e-9):
        c, s = np.cos(yaw), np.sin(yaw)
        matrices.append(np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]]))
    T = np.linalg.inv(matrices[0]) @ matrices[1]
    return np.array([T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0])])
