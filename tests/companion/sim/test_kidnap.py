"""A robot that is carried off: the truth jumps once, everything else goes on."""

from pathlib import Path

import numpy as np
import pytest

from companion.sim.measurements import measure
from companion.sim.scenario import Scenario, load_scenario
from companion.sim.simulate import START_NS
from estimators.geometry import between
from tests.conftest import write_scenario

INCREMENTS = "[increments]\nrate = 10\nsigma_x = 1e-6\nsigma_y = 1e-6\nsigma_yaw_deg = 1e-4\n"
AT = 4.05


def scenario(folder: Path, kidnap: str, seed: int = 1) -> Scenario:
    more = f"[[kidnap]]\nat = {AT}\n{kidnap}\n{INCREMENTS}"
    return load_scenario(write_scenario(folder, more=more), seed, [])


def test_it_is_set_down_where_the_table_says_and_walks_on_as_it_would_have(tmp_path: Path) -> None:
    plain = load_scenario(write_scenario(tmp_path, more=INCREMENTS), 1, []).trajectory
    carried = scenario(tmp_path, "to = [6.0, 5.0, 90.0]").trajectory
    before, after = np.linspace(0.0, AT - 1e-6, 30), np.linspace(AT, plain.duration, 50)
    np.testing.assert_array_equal(carried.at(before).pose, plain.at(before).pose)
    np.testing.assert_allclose(carried.at(np.array([AT])).pose[0], [6.0, 5.0, np.pi / 2], atol=1e-12)
    moved, would_have = carried.at(after).pose, plain.at(after).pose
    for one, other in zip(moved, would_have, strict=True):
        np.testing.assert_allclose(between(moved[0], one), between(would_have[0], other), atol=1e-9)


def test_without_a_place_every_seed_finds_another_within_the_limits(tmp_path: Path) -> None:
    places = []
    for seed in range(20):
        walk = scenario(tmp_path, "x = [1.0, 7.0]\ny = [1.0, 6.0]", seed).trajectory
        rest = walk.at(np.linspace(AT, walk.duration, 100)).pose
        assert (rest[:, :2] > 0.9).all()
        assert (rest[:, :2] < [7.1, 6.1]).all()
        places.append(rest[0])
    assert (np.std(places, axis=0) > [0.5, 0.5, 1.0]).all()


@pytest.mark.parametrize("noticed", [True, False])
def test_odometry_begins_anew_or_sees_nothing(tmp_path: Path, noticed: bool) -> None:
    walk = measure(scenario(tmp_path, f"to = [6.0, 5.0, 90.0]\nnoticed = {str(noticed).lower()}"))
    jump = int(np.argmax(walk.stamps_ns > START_NS + round(AT * 1e9)))
    founding = [k for k, i in enumerate(walk.increments) if i.from_stamp_ns == i.stamp_ns]
    assert founding == ([0, jump] if noticed else [0])
    assert max(np.abs(increment.increment[:2]).max() for increment in walk.increments) < 0.1
    assert [i.stamp_ns for i in walk.increments] == walk.stamps_ns.tolist()
    # Ranges and truth are those of the new place.
    np.testing.assert_allclose(walk.poses[jump, :2], [6.0, 5.0], atol=0.1)
