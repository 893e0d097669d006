"""Inertial samples of walks without bytes: they integrate to the walk, and err as stated."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from companion.errors import UserError
from companion.shipped_files import params_dir
from companion.sim.measurements import MeasuredWalk, measure
from companion.sim.scenario import load_scenario
from companion.sim.simulate import START_NS
from companion.trial import run_trial
from estimators.messages import Attitude, ImuSample
from tests.conftest import write_scenario

EXACT = (
    "[increments]\nrate = 10\n[inertial]\nrate = 200\naccel_sigma = 0\naccel_bias = 0\ngyro_sigma = 0\n"
    "tilt_sigma_deg = 0\nheading_walk_deg = 0\n"
)


def walked(folder: Path, more: str, seed: int = 1) -> MeasuredWalk:
    return measure(load_scenario(write_scenario(folder, more=more), seed, []))


def split(walk: MeasuredWalk) -> tuple[list[Attitude], list[ImuSample]]:
    attitudes = [each for each in walk.inertial if isinstance(each, Attitude)]
    return attitudes, [each for each in walk.inertial if isinstance(each, ImuSample)]


def test_exact_samples_integrate_to_the_walk_of_the_tag(tmp_path: Path) -> None:
    scenario = load_scenario(write_scenario(tmp_path, more=EXACT), 1, [])
    attitudes, samples = split(measure(scenario))
    start_yaw = scenario.trajectory.at(np.zeros(1)).pose[0, 2]
    R_map_level = Rotation.from_euler("z", start_yaw)
    force = [
        (R_map_level * Rotation.from_quat(a.quat_wxyz, scalar_first=True)).apply(s.accel)
        for a, s in zip(attitudes, samples, strict=True)
    ]
    travelled = np.cumsum(np.cumsum(np.array(force)[:, :2], axis=0), axis=0)[-1] / 200.0**2
    ends = scenario.trajectory.at(np.array([0.0, scenario.trajectory.duration])).pose
    arm = np.array(scenario.config.body.tag[:2])
    tags = [p[:2] + Rotation.from_euler("z", p[2]).as_matrix()[:2, :2] @ arm for p in ends]
    np.testing.assert_allclose(travelled, tags[1] - tags[0], atol=0.05)
    turned = np.sum([s.gyro[2] for s in samples]) / 200.0
    assert np.exp(1j * turned) == pytest.approx(np.exp(1j * (ends[1, 2] - ends[0, 2])), abs=0.01)


def test_at_rest_gravity_bias_and_noise_are_what_is_stated(tmp_path: Path) -> None:
    table = "[increments]\nrate = 10\n[inertial]\nrate = 500\naccel_sigma = 0.2\naccel_bias = 0.1\n"
    means, sigmas = [], []
    for seed in range(12):
        _, samples = split(walked(tmp_path, table, seed))
        still = np.array([s.accel for s in samples if s.stamp_ns < START_NS + 0.95e9])
        means.append(still.mean(axis=0) - [0.0, 0.0, 9.80665])
        sigmas.append(still.std(axis=0))
    assert np.mean(sigmas) == pytest.approx(0.2, rel=0.03)
    assert np.std(means) == pytest.approx(0.1, rel=0.4)


def test_an_inertial_table_leaves_the_other_sensors_as_they_were(tmp_path: Path) -> None:
    table = "[increments]\nrate = 10\n"
    without, with_it = walked(tmp_path, table), walked(tmp_path, table + "[inertial]\nrate = 20\n")
    for a, b in zip(without.range_frames, with_it.range_frames, strict=True):
        np.testing.assert_array_equal(a.ranges, b.ranges)
    assert not without.inertial


def test_a_scenario_with_bytes_has_no_inertial_table(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="inertial"):
        walked(tmp_path, "[inertial]\nrate = 20\n")


@pytest.mark.parametrize(("name", "positions"), [("li2022_path1", 343), ("li2022_path2", 283)])
def test_the_paths_of_li2022_have_as_many_positions_as_the_paper(name: str, positions: int) -> None:
    walk = measure(load_scenario(params_dir() / "scenarios" / f"{name}.toml", None, []))
    assert len(walk.range_frames) == positions
    blocked = sum(len(unblocked) < 4 for unblocked in walk.unblocked)
    assert 0.1 * positions < blocked < 0.6 * positions


def test_chen2019_is_measured_leg_by_leg() -> None:
    figures = run_trial(params_dir() / "scenarios" / "chen2019.toml", 1, [], ["uwb_ls", "lidar", "ekf"])
    legs = {name: each.legs for name, each in figures.items() if each is not None}
    assert list(legs["ekf"]) == ["AB", "BC", "CD", "DA"]
    # Ranges are blocked on AB alone, the odometry diverges on DA alone; fused, neither shows.
    assert legs["uwb_ls"]["AB"].max_m > 3.0 * legs["uwb_ls"]["CD"].max_m
    assert legs["lidar"]["DA"].max_m > 3.0 * legs["lidar"]["AB"].max_m
    assert legs["ekf"]["AB"].max_m < 0.19
    assert legs["ekf"]["DA"].max_m < 0.5 * legs["lidar"]["DA"].max_m


def test_names_of_legs_must_fit_the_walk(tmp_path: Path) -> None:
    walk = "[trajectory]\nwaypoints = [[1.5, 1.2], [3.5, 1.2]]\nlaps = 0\nleg_names = "
    with pytest.raises(UserError, match="leg_names"):
        load_scenario(write_scenario(tmp_path, walk + '["a", "b"]\n', "[increments]\n"), 1, [])
