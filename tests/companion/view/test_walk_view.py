"""The truth of an emulated walk: what is drawn is where the robot is and what it sees."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import rerun as rr

from companion.sim.robot import Robot
from companion.sim.scenario import Scenario, load_scenario
from companion.view.viewer import free_port
from companion.view.walk_view import WalkScene, WalkView
from estimators.messages import FloatArray
from tests.companion.view.recordings import read
from tests.conftest import Command, write_scenario

GREEN, VERMILION = 0x009E73FF, 0xD55E00FF
SECOND = 1_000_000_000


@pytest.fixture
def scenario(tmp_path: Path) -> Scenario:
    sets = [f"view.web_port={free_port()}", f"view.data_port={free_port()}"]
    return load_scenario(write_scenario(tmp_path), 3, sets)


def test_the_robot_stands_where_it_is_and_lines_tell_which_anchors_it_sees(
    scenario: Scenario, tmp_path: Path
) -> None:
    robot = Robot(scenario)
    stream = rr.RecordingStream("test")
    stream.save(tmp_path / "walk.rrd")
    scene = WalkScene(stream, robot, 0)
    robot.begin(2 * SECOND)
    stamps_ns = [k * SECOND for k in range(14)]
    for now_ns in stamps_ns:
        scene.send(now_ns)
    stream.disconnect()

    drawn = read(tmp_path / "walk.rrd")
    poses = np.array([robot.motion(now_ns).pose[0] for now_ns in stamps_ns])
    assert np.array(drawn["map/truth/position"]["Points2D:positions"])[:, 0] == pytest.approx(poses[:, :2])
    x, y = np.array(drawn["map/truth/heading"]["Arrows2D:vectors"])[:, 0].T
    assert np.arctan2(y, x) == pytest.approx(poses[:, 2], abs=1e-6)
    steps = np.array(drawn["map/truth/trail"]["LineStrips2D:strips"])[:, 0]
    assert steps == pytest.approx(np.stack([poses[:-1, :2], poses[1:, :2]], axis=1), abs=1e-6)

    body, anchors = scenario.config.body, np.array(list(scenario.config.anchors.values()))
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    tags = poses[:, :2] + np.column_stack(
        [c * body.tag[0] - s * body.tag[1], s * body.tag[0] + c * body.tag[1]]
    )
    lines = np.array(drawn["map/sight"]["LineStrips2D:strips"])
    assert lines[:, :, 0] == pytest.approx(np.repeat(tags[:, None], len(anchors), axis=1), abs=1e-5)
    assert lines[:, :, 1] == pytest.approx(np.repeat(anchors[None, :, :2], len(tags), axis=0), abs=1e-5)
    hidden = np.array([[crosses_column(tag, anchor[:2]) for anchor in anchors] for tag in tags])
    assert hidden.any()
    colours = np.array(drawn["map/sight"]["LineStrips2D:colors"])
    assert (colours == np.where(hidden, VERMILION, GREEN)).all()


def crosses_column(tag: FloatArray, anchor: FloatArray) -> bool:
    """Whether the line goes through the column of the scenario, looked at point by point."""
    points = tag + np.linspace(0.0, 1.0, 2000)[:, None] * (anchor - tag)
    return bool((np.abs(points - (4.0, 3.6)).max(axis=1) < 0.3).any())


def test_a_viewer_that_is_killed_ends_the_picture_and_nothing_else(scenario: Scenario) -> None:
    before = children()
    said: list[str] = []
    view = WalkView(Robot(scenario), "web", said.append)
    (viewer,) = children() - before
    try:
        assert said == [f"view: open {page(scenario)}"]
        os.kill(viewer, signal.SIGKILL)
        end = time.monotonic() + 20.0
        while len(said) < 2 and time.monotonic() < end:
            time.sleep(0.02)
        assert said[1:] == ["view: the viewer was closed; the emulation goes on"]
    finally:
        view.close()
    assert children() == before


def children() -> set[int]:
    """Processes that this thread has started."""
    pid = os.getpid()
    return set(map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split()))


def page(scenario: Scenario) -> str:
    """Address at which the scenario's view is served."""
    view = scenario.config.view
    data = f"rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{view.data_port}%2Fproxy"
    return f"http://127.0.0.1:{view.web_port}/?url={data}&theme=dark"


def test_a_window_without_a_screen_is_the_users_error(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    done = command("emulate", write_scenario(tmp_path), "--view", "native")
    assert (done.returncode, done.stdout) == (2, "")
    assert "error: --view native: this computer has no screen" in done.stderr
