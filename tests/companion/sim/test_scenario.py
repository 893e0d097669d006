"""Scenario files: seeds, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from companion.errors import UserError
from companion.log import Log, Truth
from companion.shipped_files import params_dir
from companion.sim.scenario import load_scenario
from tests.conftest import SCENARIO, write_log, write_scenario

STANDING = "[trajectory]\nwaypoints = [[1.5, 1.2], [1.6, 1.2]]\nlaps = 0\nrest = 0.5\n"
RANDOM = "[trajectory]\nrandom = { count = 4, x = [1.0, 5.0], y = [1.0, 6.0] }\nlaps = 0\n"


def test_every_shipped_scenario_loads() -> None:
    for path in (params_dir() / "scenarios").glob("*.toml"):
        load_scenario(path, None, [])


def test_same_seed_same_bytes_other_seed_other_bytes(tmp_path: Path) -> None:
    path = write_scenario(tmp_path, STANDING)
    logs = [
        write_log(load_scenario(path, seed, []), tmp_path / f"{i}.mcap").read_bytes()
        for i, seed in enumerate([1, 1, 2])
    ]
    assert logs[0] == logs[1]
    assert logs[0] != logs[2]


def test_the_robot_is_set_down_as_badly_as_the_site_says(tmp_path: Path) -> None:
    path = write_scenario(tmp_path, STANDING)
    starts = []
    for seed in range(200):
        scenario = load_scenario(path, seed, [])
        starts.append(scenario.trajectory.at(np.zeros(1)).pose[0] - scenario.trajectory.start)
    sigma = load_scenario(path, 0, []).config.setup().start.sigma
    # 200 draws: the sample deviation is within 5 standard errors of a quarter.
    assert np.std(starts, axis=0) == pytest.approx(sigma, rel=0.25)


def test_random_waypoints_start_elsewhere_in_every_trial_and_keep_their_limits(tmp_path: Path) -> None:
    path = write_scenario(tmp_path, RANDOM)
    starts, headings = [], []
    for seed in range(40):
        walk = load_scenario(path, seed, ["start.known=false"]).trajectory
        poses = walk.at(np.linspace(0.0, walk.duration, 200)).pose
        assert (poses[:, :2] >= 0.999).all()
        assert (poses[:, :2] <= [5.001, 6.001]).all()
        starts.append(poses[0, :2])
        headings.append(np.exp(1j * poses[0, 2]))
    assert (np.std(starts, axis=0) > 0.7).all()
    assert abs(np.mean(headings)) < 0.5


def test_truth_is_in_the_log(short_log: Path) -> None:
    truths = [record for record in Log(short_log) if isinstance(record, Truth)]
    assert len(truths) == pytest.approx(50 * (truths[-1].stamp_ns - truths[0].stamp_ns) * 1e-9, abs=2)
    travelled = np.hypot(*np.diff([truth.pose[:2] for truth in truths], axis=0).T).sum()
    assert travelled == pytest.approx(3.2, abs=0.01)


@pytest.mark.parametrize(
    ("trajectory", "said"),
    [
        ("[trajectory]\nwaypoints = [[0, 0]]\n", "trajectory: waypoints: at least 2 are needed, got 1"),
        ("[trajectory]\nwaypoints = [[9, 9], [1, 1]]\n", r"the walk begins at \(9, 9\)"),
        (STANDING + "[uwb]\nrate = 0\n", "uwb.rate: Input should be greater than or equal to 1, got 0"),
        (STANDING + "[radar]\n", "radar: unknown key"),
        (RANDOM + "waypoints = [[1, 1], [2, 2]]\n", "trajectory: random: waypoints are given, too"),
        (RANDOM, r"random waypoints start anywhere: the site needs start.known = false"),
        (RANDOM.replace("5.0]", "1.2]", 1).replace("6.0]", "1.2]"), "least_leg: x and y must leave room"),
        (STANDING + "[[kidnap]]\nat = 1\n", "kidnap.0: to: give a pose, or x and y"),
        (STANDING + "[[kidnap]]\nat = 0\nto = [1, 1, 0]\n", "kidnap.0.at: Input should be greater than 0"),
        (
            STANDING + "[[kidnap]]\nat = 0.6\nx = [1.0, 1.01]\ny = [1.0, 1.01]\n",
            "kidnap.0: x, y: the rest of the walk fits nowhere, tried 10000 places",
        ),
    ],
)
def test_a_wrong_scenario_is_refused(tmp_path: Path, trajectory: str, said: str) -> None:
    with pytest.raises(UserError, match=said):
        load_scenario(write_scenario(tmp_path, trajectory), None, [])


def test_a_missing_site_is_named(tmp_path: Path) -> None:
    path = tmp_path / "scenario.toml"
    path.write_text(SCENARIO.read_text().replace("demo_room.toml", "no_room.toml"))
    with pytest.raises(UserError, match=r"cannot read .*no_room\.toml"):
        load_scenario(path, None, [])
