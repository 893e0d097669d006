"""What happened in a log is found and named: edited logs, each with one thing wrong."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from companion.anchor_shift import RangeMisses
from companion.events import Event, EventFinder
from companion.log import Log, Truth
from companion.log_edit.edit import edit_log
from companion.log_edit.faults import parse_fault
from companion.pipeline import Tick
from companion.replay import config_of, replay
from companion.sim.scenario import load_scenario
from estimators.messages import FloatArray
from tests.conftest import SITE, write_log

WALK = """
[lidar] # the one with the fewest points: every log here is simulated and replayed
model = "A1"
[trajectory]
waypoints = [[1.5, 1.2], [6.0, 1.2], [6.0, 5.5]]
laps = 0
speed = 0.8
"""


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two legs in an empty room: nothing blocks a range."""
    folder = tmp_path_factory.mktemp("walk")
    (folder / "walk.toml").write_text(f'site = "{SITE}"\n{WALK}', encoding="utf-8")
    return write_log(load_scenario(folder / "walk.toml", 5, []), folder / "walk.mcap")


def events_of(path: Path) -> list[tuple[float, Event]]:
    """Events of a log with their seconds."""
    log = Log(path)
    config = config_of(log, [])
    finder = EventFinder(config, "ekf")
    found: list[Event] = []

    def take(tick: Tick, _: Truth | None) -> None:
        found.extend(finder.tick(tick))

    replay(log, config, ["ekf"], take)
    found += finder.close()
    return [
        ((event.stamp_ns - log.start_ns) * 1e-9, event)
        for event in sorted(found, key=lambda event: event.stamp_ns)
    ]


def edited(walk: Path, tmp_path: Path, *faults: str) -> list[tuple[float, Event]]:
    log = Log(walk)
    config = config_of(log, [])
    edit_log(log, config, [parse_fault(fault, config) for fault in faults], 3, tmp_path / "edited.mcap")
    return events_of(tmp_path / "edited.mcap")


def titles(events: list[tuple[float, Event]]) -> list[str]:
    return [event.title for _, event in events]


def test_nothing_happens_in_an_empty_room(walk: Path) -> None:
    assert titles(events_of(walk)) == []


def test_three_faults_of_one_run_are_named_each_with_its_time_and_reason(walk: Path, tmp_path: Path) -> None:
    faults = ("nlos:anchor=2,at=4,for=3", "silent:sensor=lidar,at=9,for=3", "drop:anchor=3,at=15")
    found = {event.title: (seconds, event.text) for seconds, event in edited(walk, tmp_path, *faults)}
    assert [title for title in found if title[0] == "A"] == ["A2 blocked (first NLOS)", "A3 lost"]
    seconds, text = found["A2 blocked (first NLOS)"]
    assert seconds == pytest.approx(4.0, abs=0.2)
    assert text.startswith("NLOS: longer than predicted")
    seconds, text = found["LiDAR blackout"]
    assert seconds == pytest.approx(9.0, abs=0.3)
    assert "no scan for 3." in text
    seconds, text = found["A3 lost"]
    assert seconds == pytest.approx(15.0, abs=0.1)
    assert text.count("until the end") == 1


@pytest.mark.parametrize(("anchor", "x", "y", "at"), [(3, -0.4, 0.3, 0.0), (1, 0.5, 0.0, 6.0)])
def test_an_anchor_moved_by_half_a_metre_is_named(
    walk: Path, tmp_path: Path, anchor: int, x: float, y: float, at: float
) -> None:
    events = edited(walk, tmp_path, f"moved:anchor={anchor},x={x},y={y},at={at}")
    ((seconds, moved),) = [found for found in events if "moved" in found[1].title]
    assert moved.title.startswith(f"A{anchor} moved")
    assert seconds == pytest.approx(at, abs=1.5)
    words = moved.text.split()
    found = float(words[words.index("x") + 1]), float(words[words.index("y") + 1])
    assert found == pytest.approx((x, y), abs=0.15)


def test_a_kidnapped_robot_is_named(tmp_path: Path) -> None:
    kidnap = "[[kidnap]]\nat = 3.0\nto = [5.5, 4.5, 120.0]\n"
    (tmp_path / "kidnap.toml").write_text(f'site = "{SITE}"\n{WALK}{kidnap}', encoding="utf-8")
    scenario = load_scenario(tmp_path / "kidnap.toml", 1, [])
    events = events_of(write_log(scenario, tmp_path / "kidnapped.mcap"))
    kidnapped = next(at for at, event in events if event.title == "most ranges contradict the pose")
    at, reset = next(found for found in events if found[1].title == "reset 1")
    assert kidnapped < at
    assert reset.text.endswith("m away")


def misses(
    residual: Callable[[int, FloatArray, int], float], seconds: int = 20, side: float = 4.0
) -> RangeMisses:
    """Residuals with noise of 5 cm at 10 Hz on a circle among four anchors; the pose errs by up to 0.3 m."""
    rng, found = np.random.default_rng(4), RangeMisses()
    corners = np.array([[0.0, 0.0], [0.0, 4.0], [4.0, 4.0], [4.0, 0.0]])
    for k in range(10 * seconds):
        angle = 2.0 * np.pi * k / (10 * seconds)
        tag = 2.0 + 0.25 * side * np.array([np.cos(angle), np.sin(angle)])
        error = 0.3 * np.array([np.sin(k / 50), np.cos(k / 30)])
        for i, corner in enumerate(corners):
            u = (tag - corner) / np.linalg.norm(tag - corner)
            noisy = residual(i, u, k) - float(u @ error) + rng.normal(0.0, 0.05)
            found.add(k * 100_000_000, i, noisy, *(tag - corner).tolist())
    return found


def shifted(x: float, y: float, since: int = 0) -> Callable[[int, FloatArray, int], float]:
    return lambda i, u, k: float(-u @ np.array([x, y])) * (i == 2 and k >= since)


def test_a_shift_is_found_with_its_beginning_though_the_pose_errs_and_ranges_are_blocked() -> None:
    clean = shifted(0.4, -0.3, since=60)
    found = misses(lambda i, u, k: clean(i, u, k) + 2.0 * (i == 0 and k % 11 == 0)).shift()
    assert found is not None
    assert (found.anchor_id, found.bias) == (2, None)
    assert found.shift == pytest.approx(np.array([0.4, -0.3]), abs=0.1)
    assert found.stamp_ns == pytest.approx(60 * 100_000_000, abs=2_000_000_000)


def test_a_bias_is_offered_where_it_explains_as_much() -> None:
    found = misses(lambda i, _u, _k: 0.5 * (i == 2)).shift()
    assert found is None or found.bias == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize(
    "residual",
    [shifted(0.0, 0.0), shifted(0.1, 0.0), lambda i, _u, k: 0.6 * (i == 1 and 60 <= k < 150)],
    ids=["noise", "too small", "blocked for a while"],
)
def test_what_is_no_shift_is_not_called_one(residual: Callable[[int, FloatArray, int], float]) -> None:
    assert misses(residual).shift() is None


def test_ranges_that_scatter_are_blocked_not_moved() -> None:
    """Blocked ranges that happen to fit a shift, as behind a box on the way round."""
    rng = np.random.default_rng(8)
    moved = shifted(0.5, -0.4)
    scattered = misses(lambda i, u, k: moved(i, u, k) + (i == 2) * rng.exponential(0.3)).shift()
    assert misses(moved).shift() is not None
    assert scattered is None


def test_seen_from_one_place_no_shift_is_told() -> None:
    assert misses(shifted(0.4, -0.3), side=0.01).shift() is None


def test_a_short_look_shows_no_shift() -> None:
    assert misses(shifted(0.4, -0.3), seconds=3).shift() is None
