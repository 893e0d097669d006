"""The sway of a gait: there while the robot walks, gone while it stands, told to the inertial sensor."""

import numpy as np
import pytest

from companion.sim.gait import FADE, GaitTrajectory
from companion.sim.scenario_tables import GaitTable
from companion.sim.trajectory import Trajectory
from estimators.geometry import rotation, wrap_angles
from estimators.messages import FloatArray

REST = 2.0
SWAY, YAW_DEG = 0.03, 2.0
STRAIGHT = Trajectory([(0.0, 0.0), (4.0, 0.0), (4.0, 3.0)], 0, 0.5, 0.4, 1.0, REST, np.zeros(3))


def swaying(seed: int = 1) -> GaitTrajectory:
    table = GaitTable(frequency=2.0, sway=SWAY, yaw_deg=YAW_DEG)
    return GaitTrajectory(STRAIGHT, REST, table, np.random.default_rng(seed))


def offsets(trajectory: GaitTrajectory, times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Forward and left offset (2, N) [m], and of the heading (N,) [rad], from the straight way."""
    straight, swayed = STRAIGHT.at(times).pose, trajectory.at(times).pose
    moved = [rotation(a[2]).T @ (b - a)[:2] for a, b in zip(straight, swayed, strict=True)]
    return np.array(moved).T, wrap_angles(swayed[:, 2] - straight[:, 2])


def test_it_stands_still_before_and_after_the_walk() -> None:
    trajectory = swaying()
    times = np.array([0.0, 1.0, REST, STRAIGHT.duration - REST, STRAIGHT.duration, 1e3])
    np.testing.assert_allclose(trajectory.at(times).pose, STRAIGHT.at(times).pose, atol=1e-12)
    np.testing.assert_array_equal(trajectory.start, STRAIGHT.start)
    assert trajectory.duration == STRAIGHT.duration


def test_it_sways_sideways_with_its_amplitude_and_frequency() -> None:
    times = np.linspace(REST + FADE, STRAIGHT.duration - REST - FADE, 20_000)
    (forward, left), turned = offsets(swaying(), times)
    np.testing.assert_allclose(forward, 0.0, atol=1e-12)
    assert np.abs(left).max() == pytest.approx(SWAY, rel=1e-3)
    assert np.rad2deg(np.abs(turned)).max() == pytest.approx(YAW_DEG, rel=1e-3)
    crossings = np.count_nonzero(np.diff(np.sign(left)))
    assert crossings == pytest.approx(2.0 * 2.0 * (times[-1] - times[0]), abs=2)


def test_turn_rate_agrees_with_the_headings() -> None:
    trajectory, dt = swaying(), 1e-3
    times = np.arange(0.0, STRAIGHT.duration, dt)
    motion = trajectory.at(times)
    rate = np.diff(np.unwrap(motion.pose[:, 2])) / dt
    between = (motion.yaw_rate[1:] + motion.yaw_rate[:-1]) / 2.0
    np.testing.assert_allclose(rate, between, atol=0.03)


def test_phase_comes_from_the_generator() -> None:
    times = np.array([5.0])
    np.testing.assert_array_equal(swaying(3).at(times).pose, swaying(3).at(times).pose)
    assert np.abs(swaying(3).at(times).pose - swaying(4).at(times).pose).max() > 1e-3
