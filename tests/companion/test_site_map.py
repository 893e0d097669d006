"""A saved map in the site file: it reaches the estimators, travels in the log, or is refused in one line."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pydantic import ValidationError

from companion.cli import app
from companion.config import load_config
from companion.errors import UserError
from companion.log import Log, Truth
from companion.log_edit.edit import edit_log
from companion.map_file import load_map, save_map
from companion.map_table import MapTable
from companion.pipeline import Tick
from companion.replay import config_of, replay, tum_line
from companion.sim.scenario import load_scenario
from companion.sim.simulate import simulate
from estimators.geometry import wrap_angle
from estimators.lidar.floor_map import FloorMap

SITE = Path(__file__).parents[2] / "params" / "sites" / "demo_room.toml"
SCENARIO = """
site = "{site}"
[trajectory]
waypoints = [[1.5, 1.2], [4.0, 1.2]]
laps = 0
rest = 2.0
[[world.boxes]]
centre = [4.0, 3.6]
size = [0.6, 0.6]
[[world.boxes]]
centre = [1.1, 6.4]
size = [1.2, 0.5]
"""
WALL = FloorMap(np.eye(3, dtype=bool), ~np.eye(3, dtype=bool), 0.1, np.array([1.0, 2.0, 0.3]))


def site_with(folder: Path, name: str) -> Path:
    path = folder / "site.toml"
    path.write_text(SITE.read_text().replace("[site]", f'[site]\nmap = "{name}"', 1))
    return path


def walked(folder: Path, site: Path, seed: int) -> Path:
    (folder / "walk.toml").write_text(SCENARIO.format(site=site.as_posix()))
    log = folder / f"walk_{seed}.mcap"
    for _ in simulate(load_scenario(folder / "walk.toml", seed, []), log):
        pass
    return log


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A walk, `room.yaml` made of it by the command, and another walk by a site that names this map."""
    folder = tmp_path_factory.mktemp("site")
    first = walked(folder, SITE, 1)
    app(["map", str(first), "--out", str(folder / "room.yaml")], standalone_mode=False)
    walked(folder, site_with(folder, "room.yaml"), 2)
    return folder


def test_a_site_with_a_map_finds_itself_standing_still_within_a_second_or_so(folder: Path) -> None:
    log = Log(folder / "walk_2.mcap")
    first: list[tuple[Tick, Truth]] = []

    def take(tick: Tick, truth: Truth | None) -> None:
        if not first and tick.poses["ekf"] is not None and truth is not None:
            first.append((tick, truth))

    begun = next(record.pose for record in log if isinstance(record, Truth))
    replay(log, config_of(log, ["start.known=false"]), ["ekf"], take)
    tick, truth = first[0]
    pose = tick.poses["ekf"]
    assert pose is not None
    # The LiDAR needs half a second before its first scan.
    assert (tick.stamp_ns - log.start_ns) * 1e-9 < 1.6
    np.testing.assert_allclose(truth.pose, begun, atol=1e-9)
    assert np.hypot(*(pose.xy - truth.pose[:2])) < 0.1
    assert abs(np.rad2deg(wrap_angle(pose.yaw - truth.pose[2]))) < 2.0
    without = Log(folder / "walk_1.mcap")
    until_ns = without.start_ns + 2_500_000_000
    blind = replay(without, config_of(without, ["start.known=false"]), ["ekf"], until_ns=until_ns)
    assert blind.poses["ekf"] == []


def test_a_log_is_replayed_to_the_same_bytes_without_the_file_of_the_map(
    folder: Path, tmp_path: Path
) -> None:
    log = Log(folder / "walk_2.mcap")
    until_ns = log.start_ns + 2_500_000_000

    def poses(config_from: Log) -> str:
        config = config_of(config_from, ["start.known=false"])
        return "".join(map(tum_line, replay(log, config, ["ekf"], until_ns=until_ns).poses["ekf"]))

    expected = poses(log)
    assert expected
    moved = tmp_path / "elsewhere.mcap"
    edit_log(log, config_of(log, []), [], 0, tmp_path / "edited.mcap")
    moved.write_bytes(log.path.read_bytes())
    for name in ("room.yaml", "room.png"):
        (folder / name).rename(tmp_path / name)
    try:
        assert poses(Log(moved)) == expected
        assert poses(Log(tmp_path / "edited.mcap")) == expected
    finally:
        for name in ("room.yaml", "room.png"):
            (tmp_path / name).rename(folder / name)


def test_the_map_is_that_of_the_file_beside_the_site_file(folder: Path, tmp_path: Path) -> None:
    floor = load_config(folder / "site.toml").setup().floor_map
    saved = load_map(folder / "room.yaml")
    assert floor is not None
    np.testing.assert_array_equal(floor.occupied, saved.occupied)
    np.testing.assert_array_equal(floor.free, saved.free)
    np.testing.assert_array_equal(floor.T_map_grid, saved.T_map_grid)
    assert floor.cell == saved.cell
    assert load_config(SITE).setup().floor_map is None


def test_a_map_given_by_set_is_looked_for_from_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_map(WALL, tmp_path / "maps" / "wall.yaml")
    monkeypatch.chdir(tmp_path)
    config = load_config(SITE, ["site.map=maps/wall.yaml"])
    assert config.site.map is not None
    assert config.site.map.name == "maps/wall.yaml"


def test_scans_are_held_against_a_map_where_there_are_no_walls(tmp_path: Path) -> None:
    save_map(WALL, tmp_path / "wall.yaml")
    likelihood = ["estimator.pf.scan_likelihood=true", "site.walls=[]"]
    assert load_config(site_with(tmp_path, "wall.yaml"), likelihood).setup().walls == []


@pytest.mark.parametrize(
    ("floor", "told"),
    [
        (None, "cannot read"),
        (FloorMap(np.zeros((3, 3), bool), np.ones((3, 3), bool), 0.1, np.zeros(3)), "without any obstacle"),
        (FloorMap(np.ones((2001, 2000), bool), np.zeros((2001, 2000), bool), 0.05, np.zeros(3)), "4000000"),
        (FloorMap(np.ones((2, 300), bool), np.zeros((2, 300), bool), 1.0, np.zeros(3)), "at most 200 m"),
    ],
)
def test_a_map_that_is_of_no_use_is_one_clear_line(tmp_path: Path, floor: FloorMap | None, told: str) -> None:
    if floor is not None:
        save_map(floor, tmp_path / "room.yaml")
    site = site_with(tmp_path, "room.yaml")
    with pytest.raises(UserError) as caught:
        load_config(site)
    text = str(caught.value)
    assert text.startswith(f"{site}: site.map: ")
    assert "room.yaml" in text
    assert told in text
    assert "\n" not in text


@given(
    arrays(np.uint8, st.tuples(st.integers(1, 12), st.integers(1, 12)), elements=st.integers(0, 2)),
    st.floats(0.01, 1.0),
    st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3, 3)),
)
def test_a_map_comes_out_of_its_table_as_it_went_in(
    cells: np.ndarray[tuple[int, int], np.dtype[np.uint8]], cell: float, origin: tuple[float, float, float]
) -> None:
    cells[0, 0] = 1
    table = MapTable.of(FloorMap(cells == 1, cells == 2, cell, np.array(origin)), "room.yaml")
    back = MapTable.model_validate(table.model_dump(mode="json")).floor_map()
    np.testing.assert_array_equal(back.occupied, cells == 1)
    np.testing.assert_array_equal(back.free, cells == 2)
    assert back.cell == cell
    np.testing.assert_array_equal(back.T_map_grid, origin)


@pytest.mark.parametrize("change", [{"cells": "no base64!"}, {"cells": "AAAA"}, {"rows": 4}, {"rows": 2}])
def test_a_damaged_table_is_refused(change: dict[str, object]) -> None:
    keys = MapTable.of(WALL, "room.yaml").model_dump(mode="json")
    with pytest.raises(ValidationError, match="damaged"):
        MapTable.model_validate(keys | change)
