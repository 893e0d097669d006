"""The likelihood field: distances of any grid, grids of walls, beams of a scan."""

import numpy as np
import pytest

from estimators.lidar.likelihood_field import LikelihoodField, beams_of
from estimators.messages import FloatArray, Scan
from tests.estimators.lidar.room_scans import CELL, drawn, rectangle

ROOM = np.array([[-1.0, -2.0], [4.0, -2.0], [4.0, 3.0], [-1.0, 3.0], [-1.0, -2.0]])


def test_distances_are_those_to_the_nearest_occupied_cell() -> None:
    rng = np.random.default_rng(0)
    occupied = rng.random((12, 17)) < 0.05
    field = LikelihoodField(occupied, 0.25, np.array([1.0, 2.0]))
    rows, columns = np.nonzero(occupied)
    for row, column in [(0, 0), (5, 9), (11, 16)]:
        expected = 0.25 * np.hypot(rows - row, columns - column).min()
        assert field.distances[row, column] == pytest.approx(expected)
    assert (field.distances[occupied] == 0.0).all()


def test_a_field_without_an_obstacle_is_refused() -> None:
    with pytest.raises(ValueError, match="needs an obstacle"):
        LikelihoodField(np.zeros((3, 3), dtype=bool), 0.1, np.zeros(2))


def test_distances_from_walls_are_right_to_a_cell() -> None:
    field = LikelihoodField.from_walls([ROOM, np.array([[0.0, 0.0], [1.0, 1.0]])])
    rng = np.random.default_rng(0)
    for x, y in rng.uniform([-1.5, -2.5], [4.5, 3.5], (50, 2)):
        along = np.clip((x + y) / 2.0, 0.0, 1.0)
        to_wall = np.hypot(x - along, y - along)
        inside = -1.0 <= x <= 4.0 and -2.0 <= y <= 3.0
        outward = np.hypot(max(-1.0 - x, 0.0, x - 4.0), max(-2.0 - y, 0.0, y - 3.0))
        to_room = min(abs(x + 1.0), abs(x - 4.0), abs(y + 2.0), abs(y - 3.0)) if inside else outward
        column, row = np.rint((np.array([x, y]) - field.origin) / field.resolution).astype(int)
        assert field.distances[row, column] == pytest.approx(
            min(to_wall, to_room), abs=1.5 * field.resolution
        )


@pytest.mark.parametrize("T_map_grid", [np.array([-2.0, -3.0, 0.0]), np.array([1.0, -7.0, 0.7])])
def test_distances_from_a_map_are_right_to_a_cell_however_it_lies(T_map_grid: FloatArray) -> None:
    field = LikelihoodField.from_floor(drawn(rectangle(-1.0, -2.0, 4.0, 3.0), T_map_grid))
    errors = []
    for x, y in np.random.default_rng(0).uniform([-1.0, -2.0], [4.0, 3.0], (200, 2)):
        to_room = min(abs(x + 1.0), abs(x - 4.0), abs(y + 2.0), abs(y - 3.0))
        column, row = np.rint((np.array([x, y]) - field.origin) / field.resolution).astype(int)
        errors.append(field.distances[row, column] - to_room)
    assert np.abs(errors).max() < 1.5 * CELL
    # Half a cell off everywhere would draw every particle aside.
    assert abs(np.mean(errors)) < 0.5 * CELL


def test_cells_of_a_map_along_the_axes_stay_where_they_are() -> None:
    floor = drawn(rectangle(-1.0, -2.0, 4.0, 3.0), np.array([-2.02, -3.01, 0.0]))
    field = LikelihoodField.from_floor(floor)
    rows, columns = np.nonzero(field.distances == 0.0)
    centres = field.origin + field.resolution * np.column_stack([columns, rows])
    np.testing.assert_allclose(centres, floor.obstacle_points(CELL), atol=1e-9)


def scan(angles: list[float], ranges: list[float]) -> Scan:
    """A scan whose beams come 1 ms after each other."""
    count = len(angles)
    return Scan(
        0, np.array(angles), np.array(ranges), np.linspace(0.0, 1e-3 * (count - 1), count), np.zeros(count)
    )


def test_beams_that_did_not_come_back_are_left_out() -> None:
    nan = float("nan")
    beams = beams_of(scan([0.0, 0.1, 0.2, 0.3, nan, 0.5], [0.0, 2.0, nan, -1.0, 3.0, float("inf")]))
    np.testing.assert_allclose(beams, [[0.1, 2.0, 4e-3]])
    assert beams_of(scan([], [])).shape == (0, 3)


def test_beams_are_few_and_spread_over_the_whole_scan() -> None:
    angles = np.linspace(-3.0, 3.0, 777)
    beams = beams_of(scan(angles.tolist(), [2.0] * 777))
    assert 50 <= len(beams) <= 60
    assert np.diff(beams[:, 0]).max() < 0.13
    np.testing.assert_allclose(beams[[0, -1], 0], [-3.0, 3.0], atol=0.13)
