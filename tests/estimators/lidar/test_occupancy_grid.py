"""The occupancy grid: what scans leave in it, how it grows, and what stands in a line of sight."""

from math import inf, nan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from estimators.geometry import transform
from estimators.lidar.occupancy_grid import BLOCK, LIMIT, MAX_SIDE, OccupancyGrid
from estimators.messages import FloatArray
from tests.estimators.lidar.room_scans import ROOM as WALLS
from tests.estimators.lidar.room_scans import cast

ROOM = WALLS + 0.02  # walls on the border of two cells would be seen in either
CONFIG = OccupancyGrid.Config()
POSE = np.array([1.5, 1.2, 0.4])


def seen_from(pose: FloatArray, walls: FloatArray = ROOM, beams: int = 720) -> FloatArray:
    """Ends of the beams (N, 2) in the lidar frame."""
    angles = np.linspace(0.0, 2.0 * np.pi, beams, endpoint=False)
    directions = np.column_stack([np.cos(angles + pose[2]), np.sin(angles + pose[2])])
    ranges = cast(walls, np.tile(pose[:2], (beams, 1)), directions)
    points: FloatArray = (ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]))[ranges > 0.0]
    return points


def room_grid(scans: int = 3) -> OccupancyGrid:
    grid = OccupancyGrid(CONFIG)
    for _ in range(scans):
        assert grid.insert(POSE, seen_from(POSE))
    return grid


def cell_at(grid: OccupancyGrid, point: FloatArray) -> float:
    column, row = np.floor((point - grid.origin) / grid.cell).astype(int)
    return float(grid.log_odds[row, column])


def test_beams_end_in_obstacles_and_pass_what_is_free() -> None:
    grid = room_grid()
    points = transform(POSE, seen_from(POSE))
    assert all(cell_at(grid, point) > 0.0 for point in points)
    halfway = (points + POSE[:2]) / 2.0
    assert all(cell_at(grid, point) < 0.0 for point in halfway)


def test_obstacles_lie_where_the_walls_are() -> None:
    grid = room_grid()
    rows, columns = np.nonzero(grid.obstacles)
    centres = grid.origin + (np.column_stack([columns, rows]) + 0.5) * grid.cell
    begins, along = ROOM[:, 0], ROOM[:, 1] - ROOM[:, 0]
    share = np.einsum("nmi,mi->nm", centres[:, None] - begins, along) / (along**2).sum(axis=1)
    nearest = begins + np.clip(share, 0.0, 1.0)[..., None] * along
    distance = np.linalg.norm(centres[:, None] - nearest, axis=2).min(axis=1)
    assert len(centres) > 300
    assert distance.max() <= grid.cell


def test_a_box_blocks_the_lines_behind_it_and_no_others() -> None:
    grid = room_grid()
    behind, beside = np.array([5.8, 4.0]), np.array([5.5, 1.0])  # the box covers (4.2, 2.8) to (5.0, 3.4)
    assert grid.blocked(POSE[:2], behind)
    assert grid.blocked(behind, POSE[:2])
    assert not grid.blocked(POSE[:2], beside)
    assert not grid.blocked(beside, POSE[:2])


def test_a_grid_far_from_the_origin_blocks_the_same_lines() -> None:
    grid, far_off = OccupancyGrid(CONFIG), np.array([30.0, -55.0, 0.0])
    for _ in range(3):
        assert grid.insert(POSE + far_off, seen_from(POSE))
    behind, beside = np.array([35.8, -51.0]), np.array([35.5, -54.0])
    assert grid.blocked((POSE + far_off)[:2], behind)
    assert not grid.blocked((POSE + far_off)[:2], beside)


def test_one_glimpse_is_no_obstacle() -> None:
    assert not room_grid(scans=1).obstacles.any()


def test_nothing_is_known_of_what_was_not_seen() -> None:
    grid = OccupancyGrid(CONFIG)
    assert not grid.blocked(np.array([-5.0, 3.0]), np.array([40.0, -2.0]))
    inside_box = np.array([4.6, 3.1])
    assert cell_at(room_grid(), inside_box) == 0.0


def test_a_line_from_far_outside_is_followed_where_there_is_a_grid_only() -> None:
    grid = room_grid()
    along, y = np.array([1e9, 0.0]), np.array([0.0, 3.1])
    assert grid.blocked(y - along, y + along)
    assert grid.blocked(y + along, y - along)
    assert not grid.blocked(y + 100.0 - along, y + 100.0 + along)
    assert not grid.blocked(y - along, y - 0.5 * along)


def test_what_went_away_is_forgotten() -> None:
    grid = room_grid(scans=50)
    behind = np.array([5.8, 4.0])
    for _ in range(20):
        grid.insert(POSE, seen_from(POSE, walls=ROOM[:4]))
    assert not grid.blocked(POSE[:2], behind)
    assert np.abs(grid.log_odds).max() <= np.float32(LIMIT)


def test_a_cell_changes_once_a_scan_however_many_beams_meet_it() -> None:
    few, many = OccupancyGrid(CONFIG), OccupancyGrid(CONFIG)
    point = np.array([[1.02, 0.01]])
    few.insert(np.zeros(3), point)
    many.insert(np.zeros(3), np.tile(point, (50, 1)))
    np.testing.assert_array_equal(few.log_odds, many.log_odds)


def test_a_beam_that_passes_does_not_undo_a_hit_of_the_same_scan() -> None:
    grid = OccupancyGrid(CONFIG)
    near, far = np.array([1.02, 0.01]), np.array([2.02, 0.01])
    grid.insert(np.zeros(3), np.array([far, near, far]))
    assert cell_at(grid, near) == cell_at(grid, far) > 0.0


def test_growing_keeps_every_cell_at_its_place() -> None:
    grid = OccupancyGrid(CONFIG)
    grid.insert(POSE, seen_from(POSE))
    before, origin = grid.log_odds.copy(), grid.origin.copy()
    grid.insert(np.array([-9.0, -7.0, 0.0]), np.array([[0.3, 0.2]]))
    dx, dy = np.round((origin - grid.origin) / grid.cell).astype(int)
    assert dx > 0
    assert dy > 0
    np.testing.assert_array_equal(grid.log_odds[dy : dy + before.shape[0], dx : dx + before.shape[1]], before)
    assert grid.log_odds.shape[0] % BLOCK == grid.log_odds.shape[1] % BLOCK == 0


@pytest.mark.parametrize("number", [nan, inf, 1e9, 1e300, 1.2 * MAX_SIDE * CONFIG.cell])
def test_a_scan_from_nowhere_is_left_out(number: float) -> None:
    grid = room_grid()
    before = grid.log_odds.copy()
    assert not grid.insert(np.array([number, 0.0, 0.0]), np.array([[1.0, 1.0]]))
    assert not grid.insert(POSE, np.array([[1.0, 1.0], [0.0, number]]))
    np.testing.assert_array_equal(grid.log_odds, before)
    assert not OccupancyGrid(CONFIG).insert(np.array([1e9, 0.0, 0.0]), np.array([[1e12, 1.0]]))


def test_a_scan_without_returns_changes_nothing() -> None:
    grid = room_grid()
    before = grid.log_odds.copy()
    assert grid.insert(POSE, np.empty((0, 2)))
    np.testing.assert_array_equal(grid.log_odds, before)


coordinate = st.floats(-6.0, 6.0) | st.integers(-40, 40).map(lambda i: i * 0.05)


@settings(max_examples=200, deadline=None)
@given(st.tuples(coordinate, coordinate), st.tuples(coordinate, coordinate))
def test_rays_visit_the_cells_that_densely_sampled_points_of_them_lie_in(
    begin: tuple[float, float], end: tuple[float, float]
) -> None:
    grid = OccupancyGrid(CONFIG)
    start = np.array(begin)
    point = np.array([end]) - start
    assert grid.insert(np.array([*begin, 0.0]), point)
    changed = grid.log_odds != 0.0
    shares = np.linspace(0.0, 1.0, 2001)[:, None]
    offsets = (start + shares * point - grid.origin) / grid.cell
    # A sample within rounding of a border may belong to either side.
    inner = offsets[(np.abs(offsets - np.round(offsets)) > 1e-6).all(axis=1)]
    columns, rows = np.floor(inner).astype(int).T
    assert changed[rows, columns].all()
    steps = np.abs(np.floor(offsets[-1] + 1e-9) - np.floor(offsets[0] + 1e-9)).sum()
    assert changed.sum() <= steps + 3
    assert grid.log_odds[changed].max() > 0.0


@settings(max_examples=200, deadline=None)
@given(st.tuples(coordinate, coordinate), st.tuples(coordinate, coordinate))
def test_a_line_is_blocked_exactly_when_samples_of_it_lie_in_obstacles(
    begin: tuple[float, float], end: tuple[float, float]
) -> None:
    start, stop = np.array(begin), np.array(end)
    shares = np.linspace(0.0, 1.0, 2001)[:, None]
    offsets = (start + shares * (stop - start) - ROOM_GRID.origin) / ROOM_GRID.cell
    obstacles = np.pad(ROOM_GRID.obstacles, 1)
    columns, rows = np.clip(np.floor(offsets).astype(int) + 1, 0, np.array(obstacles.shape[::-1]) - 1).T
    depth = np.abs(offsets - np.round(offsets)).min(axis=1)  # [cells] from the nearest border
    if obstacles[rows, columns][depth > 1e-3].any():
        assert ROOM_GRID.blocked(start, stop)
    elif not _near_obstacle(offsets, obstacles):
        assert not ROOM_GRID.blocked(start, stop)


def _near_obstacle(offsets: FloatArray, obstacles: NDArray[np.bool_]) -> bool:
    """Whether samples that are moved by a hundredth of a cell lie in obstacles."""
    for shift in np.array([[-0.01, -0.01], [-0.01, 0.01], [0.01, -0.01], [0.01, 0.01]]):
        moved = np.floor(offsets + shift).astype(int) + 1
        columns, rows = np.clip(moved, 0, np.array(obstacles.shape[::-1]) - 1).T
        if obstacles[rows, columns].any():
            return True
    return False


ROOM_GRID = room_grid()
