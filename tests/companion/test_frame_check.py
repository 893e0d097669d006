"""The frame self-test: what a walk says of the axes."""

import re
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from typer.testing import CliRunner

from companion.cli import app
from companion.frame_check import judge_autopilot, judge_compass, judge_walk
from companion.sim.emulate import Emulator
from companion.sim.scenario import load_scenario
from estimators.geometry import compose
from tests.companion.test_sitl import Sitl, served
from tests.conftest import write_scenario

angles = st.floats(-3.1, 3.1)
REST = 5.0
"""Before the walk [s]: so long it takes until the pose is good."""


def walked(
    begin: tuple[float, float, float], angle_deg: float, length: float = 2.0, turn: float = 0.0
) -> tuple:  # type: ignore[type-arg]
    """Poses before and after a walk in a direction seen from the first."""
    step = np.array([length * np.cos(np.deg2rad(angle_deg)), length * np.sin(np.deg2rad(angle_deg)), turn])
    return np.array(begin), compose(np.array(begin), step)


@given(yaw=angles, turn=angles, error=st.floats(-20, 20))
def test_walks_as_they_should_be_agree_wherever_the_robot_looks(
    yaw: float, turn: float, error: float
) -> None:
    assert judge_walk("forward", *walked((1, 2, yaw), error, turn=turn)).agrees
    assert judge_walk("left", *walked((1, 2, yaw), 90 + error, turn=turn)).agrees


@given(yaw=angles, what=st.sampled_from(["forward", "left"]), off=st.floats(30, 330))
def test_a_pose_that_is_turned_never_agrees(yaw: float, what: str, off: float) -> None:
    meant = 0.0 if what == "forward" else 90.0
    assert judge_walk(what, *walked((1, 2, yaw), meant + off)).agrees is False


@pytest.mark.parametrize(
    ("what", "angle", "words"),
    [
        ("forward", 90.0, "to its left: the pose is turned by +90 deg"),
        ("forward", 180.0, "the other way"),
        ("forward", -90.0, "to its right: the pose is turned by -90 deg"),
        ("left", -90.0, "the map is mirrored"),
        ("left", 180.0, "to its left: the pose is turned by +90 deg"),
    ],
)
def test_each_mistake_has_its_words(what: str, angle: float, words: str) -> None:
    assert words in judge_walk(what, *walked((0, 0, 0.7), angle)).text


def test_a_mirrored_map_shows_in_the_walk_to_the_left_alone() -> None:
    mirror = np.array([1.0, -1.0, -1.0])
    begin, ahead = walked((1, 2, 0.3), 0.0)
    assert judge_walk("forward", begin * mirror, ahead * mirror).agrees
    begin, left = walked((1, 2, 0.3), 90.0)
    assert not judge_walk("left", begin * mirror, left * mirror).agrees


def test_a_step_is_no_walk() -> None:
    finding = judge_walk("forward", *walked((0, 0, 0), 0.0, length=0.3))
    assert not finding.agrees
    assert "only 0.30 m" in finding.text


def test_north_is_written_in_one_way() -> None:
    assert "autopilot 0 deg, ours 0 deg" in judge_compass(-0.001, 0.001).text


@given(heading=angles, off=st.floats(-170, 170))
def test_the_compass_tells_what_to_add_to_the_maps_heading(heading: float, off: float) -> None:
    assume(abs(abs(off) - 20.0) > 0.01)
    finding = judge_compass(heading, heading + np.deg2rad(off))
    assert finding.agrees is (abs(off) <= 20.0)
    if not finding.agrees:
        added = re.search(r"add ([+-]\d+) deg", finding.text)
        assert added is not None
        assert int(added[1]) == pytest.approx(off, abs=0.5 + 1e-6)


def test_an_autopilot_that_goes_another_way_or_not_at_all() -> None:
    north = np.array([2.0, 0.0])
    assert judge_autopilot(north, north * 0.9).agrees
    assert judge_autopilot(north, np.array([0.0, 2.0])).agrees is False
    assert judge_autopilot(north, np.zeros(2)).agrees is None
    assert judge_autopilot(north, None).agrees is None


@pytest.mark.realtime
def test_two_walks_of_an_emulated_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    legs = "waypoints = [[1.5, 1.2], [2.7, 1.2], [2.7, 2.4]]"
    walk = f"[trajectory]\n{legs}\nlaps = 0\nrest = {REST}\nspeed = 0.8\n"
    scenario = load_scenario(write_scenario(tmp_path, walk), 3, [])
    times = np.arange(0.0, scenario.trajectory.duration, 0.01)
    yaw = scenario.trajectory.at(times).pose[:, 2]
    arrivals = [float(times[np.argmax(yaw > yaw[0] + 0.02)]), scenario.trajectory.duration - REST]
    emulator, stop = Emulator(scenario), threading.Event()
    devices = threading.Thread(target=emulator.run, args=(stop, lambda _: None))

    def wait_for_the_corner(*_: object, **__: object) -> str:
        arrival = arrivals.pop(0)
        while emulator.robot.seconds(time.monotonic_ns()) < arrival:
            time.sleep(0.01)
        return ""

    monkeypatch.setattr("companion.frames_cli.typer.prompt", wait_for_the_corner)
    ports = [f"sensor.{name}.port={port.path}" for name, port in emulator.ports.items()]
    devices.start()
    try:
        with served(Sitl()) as url:
            sets = [word for port in ports for word in ("--set", port)]
            result = CliRunner().invoke(
                app, ["doctor", "frames", "--site", "demo_room", "--mavlink", url, *sets]
            )
    finally:
        stop.set()
        devices.join()
        emulator.close()
    # The autopilot's compass shows north, the site's map 30 deg; the autopilot goes where we are.
    for line, expected in zip(
        result.stdout.splitlines(),
        (
            r"wrong +compass: autopilot 0 deg, ours (29|30|31) deg.* add -(29|30|31) deg",
            r"ok +forward: \d\.\d\d m, .* agrees",
            # It gets no pose before health has been good for a second.
            r"open +autopilot: it had no position when the walk began",
            r"ok +left: \d\.\d\d m, .* agrees",
            r"ok +autopilot: its position went \d\.\d\d m, .* agrees",
        ),
        strict=True,
    ):
        assert re.match(expected, line), line
    assert result.exit_code == 1
