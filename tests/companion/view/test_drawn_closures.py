"""Loop closures of a second round are drawn from the robot to the place that it passed before."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from companion.config import Config
from companion.pipeline import Tick
from companion.view.files import RerunFiles
from estimators.base import Report, Verdict
from estimators.messages import FloatArray, LoopClosure
from tests.companion.second_round import PATH, PERIOD_NS, drive
from tests.companion.view.recordings import Recording, read

GREEN, BLUE = 0x009E73FF, 0x4678DCFF


@pytest.fixture(scope="module")
def ticks() -> list[Tick]:
    """A round and a bit."""
    return list(drive(130))


def closures(ticks: list[Tick]) -> list[LoopClosure]:
    found = [o.measurement for tick in ticks for o in tick.outcomes if isinstance(o.measurement, LoopClosure)]
    return [closure for closure in found if closure.from_stamp_ns < closure.stamp_ns]


def shown(config: Config, ticks: list[Tick], path: Path) -> Recording:
    view = RerunFiles(config, ["graph", "lidar_odometry"], path, 0)
    for tick in ticks:
        view.tick(tick, None)
    view.close()
    return read(path)


def place(stamp_ns: int) -> FloatArray:
    """Where the body was, (2,)."""
    at: FloatArray = PATH.poses(np.array([stamp_ns * 1e-9]))[0, :2]
    return at


def test_a_closure_is_a_line_from_the_robot_to_the_place(
    config: Config, ticks: list[Tick], tmp_path: Path
) -> None:
    recording = shown(config, ticks, tmp_path / "run.rrd")
    found = closures(ticks)
    assert found
    rows = recording["map/estimate/graph/closures"]
    times = [time.total_seconds() for time in rows["time"]]
    assert times == pytest.approx([closure.stamp_ns * 1e-9 for closure in found])
    lines = np.array([strip for row in rows["LineStrips2D:strips"] for strip in row])
    ends = np.array([[place(c.stamp_ns), place(c.from_stamp_ns)] for c in found])
    assert lines == pytest.approx(ends, abs=0.1)
    assert [colour for row in rows["LineStrips2D:colors"] for colour in row] == [GREEN] * len(found)
    assert "map/estimate/lidar_odometry/closures" not in recording


def test_a_refused_closure_says_why_and_one_without_a_pose_is_not_drawn(
    config: Config, ticks: list[Tick], tmp_path: Path
) -> None:
    refused = Report((Verdict.GATED,))
    changed = []
    first = closures(ticks)[0]
    for tick in ticks:
        outcomes = [
            replace(o, reports={**o.reports, "graph": refused})
            if isinstance(o.measurement, LoopClosure)
            else o
            for o in tick.outcomes
        ]
        near = abs(tick.stamp_ns - first.stamp_ns) <= PERIOD_NS
        poses = {**tick.poses, "graph": None} if near else tick.poses
        changed.append(replace(tick, outcomes=outcomes, poses=poses))
    rows = shown(config, changed, tmp_path / "run.rrd")["map/estimate/graph/closures"]
    count = len(closures(ticks))
    assert count > 1
    assert [len(row) for row in rows["LineStrips2D:strips"]] == [0] + [1] * (count - 1)
    assert rows["LineStrips2D:colors"][1:] == [[BLUE]] * (count - 1)
    assert rows["LineStrips2D:labels"][1:] == [["closure: gated"]] * (count - 1)
