"""The simulated world: beams, and what stands between a tag and an anchor."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.sim.world import World

ROOM = [(0.0, 0.0), (8.0, 0.0), (8.0, 6.0), (0.0, 6.0), (0.0, 0.0)]


@given(x=st.floats(0.1, 7.9), y=st.floats(0.1, 5.9), angle=st.floats(-7.0, 7.0))
def test_beams_end_on_the_walls_of_a_room(x: float, y: float, angle: float) -> None:
    distance = World([ROOM], []).ray_cast(np.array([[x, y]]), np.array([angle]), 0.4)[0]
    c, s = np.cos(angle), np.sin(angle)
    along_x = np.inf if abs(c) < 1e-12 else ((8.0 if c > 0 else 0.0) - x) / c
    along_y = np.inf if abs(s) < 1e-12 else ((6.0 if s > 0 else 0.0) - y) / s
    assert distance == pytest.approx(min(along_x, along_y), abs=1e-9)


def test_a_box_is_hit_before_the_wall_unless_it_is_lower_than_the_beam() -> None:
    world = World([ROOM], [(5.0, 3.0, 1.0, 1.0, 0.0, 0.7)])
    origin, east = np.array([[1.0, 3.0]]), np.array([0.0])
    assert world.ray_cast(origin, east, 0.4)[0] == pytest.approx(3.5)
    assert world.ray_cast(origin, east, 0.8)[0] == pytest.approx(7.0)


def test_a_turned_box_shows_its_corner() -> None:
    world = World([ROOM], [(5.0, 3.0, 1.0, 1.0, np.pi / 4, 3.0)])
    assert world.ray_cast(np.array([[1.0, 3.0]]), np.array([0.0]), 0.4)[0] == pytest.approx(4 - np.sqrt(0.5))


def test_nothing_hit_is_infinite() -> None:
    world = World([[(1.0, -1.0), (1.0, 1.0)]], [])
    assert np.isinf(world.ray_cast(np.zeros((1, 2)), np.array([np.pi]), 0.0)[0])


def test_line_of_sight_passes_above_low_boxes() -> None:
    world = World([ROOM], [(4.0, 3.0, 1.0, 1.0, 0.0, 1.0)])
    tag = np.array([1.0, 3.0, 0.5])
    # The ray rises from 0.5 m; above the box, from x = 3.5 to 4.5, it is at 1.21 m and more, or 0.67 m.
    targets = np.array([[7.0, 3.0, 2.2], [7.0, 3.0, 0.9], [1.0, 5.5, 2.0]])
    assert world.line_of_sight(tag, targets).tolist() == [True, False, True]


def test_a_wall_blocks_at_any_height() -> None:
    world = World([[(2.0, 0.0), (2.0, 6.0)]], [])
    assert not world.line_of_sight(np.array([1.0, 3.0, 0.5]), np.array([[3.0, 3.0, 5.0]]))[0]
