"""Maps from a log, on disk and back; files of other tools; bad files."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from companion.cli import app
from companion.errors import UserError
from companion.log import Log
from companion.map_file import load_map, save_map
from companion.mapping import survey
from companion.replay import config_of
from companion.sim.scenario import load_scenario
from companion.sim.simulate import simulate
from estimators.lidar.floor_map import FloorMap

SCENARIO = """
site = "{site}"
[trajectory]
waypoints = [[1.5, 1.2], [4.0, 1.2]]
laps = 0
rest = 1.0
[[world.boxes]]
centre = [4.0, 3.6]
size = [0.6, 0.6]
"""


@given(
    arrays(np.uint8, st.tuples(st.integers(1, 12), st.integers(1, 12)), elements=st.integers(0, 2)),
    st.floats(0.01, 1.0),
    st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3, 3)),
)
def test_a_map_is_read_as_it_was_saved(
    tmp_path_factory: pytest.TempPathFactory,
    cells: np.ndarray[tuple[int, int], np.dtype[np.uint8]],
    cell: float,
    origin: tuple[float, float, float],
) -> None:
    path = tmp_path_factory.mktemp("map") / "room.yaml"
    save_map(FloorMap(cells == 1, cells == 2, cell, np.array(origin)), path)
    back = load_map(path)
    np.testing.assert_array_equal(back.occupied, cells == 1)
    np.testing.assert_array_equal(back.free, cells == 2)
    assert back.cell == cell
    np.testing.assert_array_equal(back.T_map_grid, origin)


def test_a_map_of_map_server_is_read(tmp_path: Path) -> None:
    # As its map_saver writes it: PGM, first row on top, keys that we do not need.
    Image.fromarray(np.array([[0, 205, 254], [254, 254, 0]], dtype=np.uint8)).save(tmp_path / "lab.pgm")
    (tmp_path / "lab.yaml").write_text(
        "image: lab.pgm\nmode: trinary\nresolution: 0.05\norigin: [-1.0, -2.5, 0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    floor = load_map(tmp_path / "lab.yaml")
    np.testing.assert_array_equal(floor.occupied, [[False, False, True], [True, False, False]])
    np.testing.assert_array_equal(floor.free, [[True, True, False], [False, False, True]])
    np.testing.assert_array_equal(floor.T_map_grid, [-1.0, -2.5, 0.0])


def test_a_negated_map_has_white_walls(tmp_path: Path) -> None:
    Image.fromarray(np.array([[0, 255]], dtype=np.uint8)).save(tmp_path / "lab.png")
    (tmp_path / "lab.yaml").write_text("image: lab.png\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 1\n")
    np.testing.assert_array_equal(load_map(tmp_path / "lab.yaml").occupied, [[False, True]])


GOOD = {"image": "lab.png", "resolution": 0.1, "origin": [0, 0, 0]}


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"resolution": 0}, "resolution: Input should be greater than 0"),
        ({"origin": [0, 0]}, "origin"),
        ({"origin": [0, 0, ".nan"]}, "origin"),
        ({"negate": 2}, "negate"),
        ({"image": "none.png"}, "cannot read"),
        ({"image": "lab.yaml"}, "is not a picture"),
        ({"free_thresh": 0.7}, "free_thresh"),
        (None, "it has no keys"),
    ],
)
def test_a_bad_map_is_one_clear_line(tmp_path: Path, change: dict[str, object] | None, told: str) -> None:
    Image.fromarray(np.zeros((2, 2), dtype=np.uint8)).save(tmp_path / "lab.png")
    path = tmp_path / "lab.yaml"
    path.write_text("- a list" if change is None else json.dumps({**GOOD, **change}))
    with pytest.raises(UserError, match=told) as caught:
        load_map(path)
    assert "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("walk")
    site = Path(__file__).parents[2] / "params" / "sites" / "demo_room.toml"
    (folder / "walk.toml").write_text(SCENARIO.format(site=site.as_posix()))
    exact = ["start.sigma_xy=0.005", "start.sigma_yaw_deg=0.1"]
    for _ in simulate(load_scenario(folder / "walk.toml", 1, exact), folder / "walk.mcap"):
        pass
    return folder / "walk.mcap"


def test_the_map_of_a_walk_shows_walls_and_boxes_where_they_are(log: Path, tmp_path: Path) -> None:
    opened, shares = Log(log), list[float]()
    made = survey(opened, config_of(opened, []), "ekf", shares.append)
    assert shares[0] < 0.1 < 0.9 < shares[-1]
    assert made.inserted > 0.8 * made.scans
    save_map(made.floor, tmp_path / "room.yaml")
    floor = load_map(tmp_path / "room.yaml")
    rows, columns = np.nonzero(floor.occupied)
    x = floor.T_map_grid[0] + (columns + 0.5) * floor.cell
    y = floor.T_map_grid[1] + (rows + 0.5) * floor.cell
    from_walls = np.minimum.reduce([np.abs(x), np.abs(x - 8.0), np.abs(y), np.abs(y - 7.0)])
    from_box = np.abs(np.maximum(np.abs(x - 4.0), np.abs(y - 3.6)) - 0.3)
    off = np.minimum(from_walls, from_box)
    assert len(off) > 400
    assert np.mean(off < 0.1) > 0.97
    assert floor.free.sum() > 20.0 / floor.cell**2


def test_the_command_names_what_is_wrong(log: Path) -> None:
    for arguments, told in (
        (["--out", "room.png"], "--out room.png: the name must end in .yaml"),
        (["--estimator", "nobody"], "unknown estimator 'nobody'"),
        (["--set", "body.lidar=[1]"], "body.lidar"),
        (["--estimator", "least_squares"], "there is no map to write"),
    ):
        with pytest.raises(UserError, match=re.escape(told)):
            app(["map", str(log), *arguments], standalone_mode=False)
