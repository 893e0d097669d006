"""The accuracy of an anchor layout, against least squares on drawn ranges and against what must be so."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from scipy.optimize import least_squares

from companion.config import Config, load_config
from companion.errors import UserError
from companion.plan import Layout, plan_layout
from companion.plan_plot import plan_figure
from companion.sim.world import World
from estimators.bounds import position_information
from tests.conftest import SITE


@pytest.fixture(scope="module")
def open_room() -> Config:
    return load_config(SITE)


@pytest.fixture(scope="module")
def room(open_room: Config) -> Layout:
    return plan_layout(open_room, walled(open_room), sigma=0.1)


def walled(config: Config) -> World:
    """The demo's room with a tall box that hides much from anchor 2."""
    walls = [list(wall) for wall in config.site.walls]
    return World(walls, [(6.0, 5.0, 1.0, 1.0, 0.0, 4.0)])


def at(layout: Layout, x: float, y: float) -> tuple[int, int]:
    return int(np.abs(layout.y - y).argmin()), int(np.abs(layout.x - x).argmin())


def test_the_bound_is_what_least_squares_reaches_on_drawn_ranges(config: Config) -> None:
    rng = np.random.default_rng(1)
    anchors = np.array(list(config.anchors.values()))
    tag = np.array([2.5, 4.0, 0.5])
    found = []
    for _ in range(400):
        ranges = np.linalg.norm(anchors - tag, axis=1) + 0.05 * rng.standard_normal(4)

        def residuals(xy: np.ndarray, ranges: np.ndarray = ranges) -> np.ndarray:
            return np.asarray(np.linalg.norm(anchors - [*xy, tag[2]], axis=1) - ranges)

        found.append(least_squares(residuals, tag[:2]).x - tag[:2])
    information = position_information(tag[None], anchors, np.ones((1, 4), np.bool_), 0.05)[0]
    assert np.cov(np.array(found).T) == pytest.approx(np.linalg.inv(information), rel=0.25, abs=2e-4)


def test_twice_the_noise_is_twice_the_error(open_room: Config, room: Layout) -> None:
    twice = plan_layout(open_room, walled(open_room), sigma=0.2)
    finite = np.isfinite(room.error)
    assert twice.error[finite] == pytest.approx(2.0 * room.error[finite])
    assert np.array_equal(np.isinf(twice.error), np.isinf(room.error))


def test_a_blocked_anchor_does_not_count(open_room: Config, room: Layout) -> None:
    free = plan_layout(open_room, sigma=0.1)
    behind = at(room, 5.0, 4.0)
    beside = at(room, 7.0, 3.0)
    assert room.error[behind] > 1.1 * free.error[behind]
    assert room.error[beside] == free.error[beside]
    anchors = np.array([open_room.anchors[i] for i in (0, 1, 3)])
    point = np.array([[room.x[behind[1]], room.y[behind[0]], 0.5]])
    information = position_information(point, anchors, np.ones((1, 3), np.bool_), 0.1)[0]
    assert room.error[behind] == pytest.approx(np.sqrt(np.trace(np.linalg.inv(information))))


def test_inside_furniture_and_outside_the_walls_is_no_floor(room: Layout) -> None:
    assert np.isnan(room.error[at(room, 6.0, 5.0)])
    assert np.isfinite(room.error[at(room, 3.0, 3.0)])


def test_with_one_anchor_in_view_there_is_no_position() -> None:
    information = position_information(
        np.array([[1.0, 1.0, 0.5]]),
        np.array([[0.0, 0.0, 2.0], [4.0, 0.0, 2.0]]),
        np.array([[True, False]]),
        0.1,
    )
    assert np.linalg.matrix_rank(information[0]) == 1


def test_one_more_anchor_never_harms_and_stands_at_a_wall(room: Layout) -> None:
    floor = ~np.isnan(room.error)
    assert np.all(room.error_with_extra[floor] <= room.error[floor] + 1e-12)
    assert room.good_share(room.error_with_extra) >= room.good_share(room.error)
    x, y, _ = room.extra
    assert min(x, y, 8.0 - x, 7.0 - y) == pytest.approx(0.15)


def test_no_other_place_would_help_more(open_room: Config, room: Layout) -> None:
    """Exhaustive for a handful of places: the error with the chosen one is the least on average."""
    world = walled(open_room)
    rows, columns = np.nonzero(~np.isnan(room.error))
    points = np.column_stack([room.x[columns], room.y[rows], np.full(len(rows), 0.5)])[::7]
    anchors = np.array(list(open_room.anchors.values()))

    def mean_error(extra: np.ndarray) -> float:
        every = np.vstack([anchors, extra])
        seen = np.array([world.line_of_sight(point, every) for point in points])
        information = position_information(points, every, seen, 0.1)
        errors = [
            np.sqrt(np.trace(np.linalg.inv(each))) if np.linalg.cond(each) < 1e9 else 1.0
            for each in information
        ]
        return float(np.minimum(errors, 1.0).mean())

    best = mean_error(room.extra)
    for x, y in ((0.15, 3.5), (4.0, 0.15), (4.0, 6.85), (7.85, 3.5), (0.15, 6.0)):
        assert best <= mean_error(np.array([x, y, room.extra[2]])) + 0.003


def test_bad_spots_are_where_the_error_is_beyond_the_limit(open_room: Config) -> None:
    layout = plan_layout(open_room, walled(open_room), limit=0.15, sigma=0.1)
    assert layout.spots
    cell = (layout.x[1] - layout.x[0]) * (layout.y[1] - layout.y[0])
    bad = np.nan_to_num(layout.error, nan=0.0) > 0.15
    assert sum(spot.area for spot in layout.spots) <= bad.sum() * cell + 1e-9
    assert [spot.area for spot in layout.spots] == sorted((s.area for s in layout.spots), reverse=True)
    assert all(spot.worst > 0.15 for spot in layout.spots)
    assert not plan_layout(open_room, limit=100.0, sigma=0.001).spots


def test_a_site_without_a_closed_wall_has_no_floor() -> None:
    config = load_config(SITE, ["site.walls=[[[0,0],[8,0],[8,7]]]"])
    with pytest.raises(UserError, match=r"no closed wall in site\.walls"):
        plan_layout(config)


def test_the_picture_shows_both_layouts(open_room: Config, room: Layout, tmp_path: Path) -> None:
    plan_figure(room, open_room, tmp_path / "new" / "plan.png")
    pixels = np.asarray(imread(tmp_path / "new" / "plan.png"), dtype=np.float64)[:, :, :3]
    assert pixels.shape == (725, 1500, 3)
    for half in (pixels[:, :660], pixels[:, 680:1320]):
        colourful = half.max(axis=2) - half.min(axis=2) > 0.3
        assert colourful.mean() > 0.3
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot write the picture"):
        plan_figure(room, open_room, tmp_path / "file" / "plan.png")
