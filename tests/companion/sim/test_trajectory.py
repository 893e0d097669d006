"""The simulated walk: continuous, within its limits, where it should be at its corners."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.sim.trajectory import Trajectory
from estimators.geometry import compose
from estimators.messages import FloatArray

SQUARE = [(0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0)]
SPEED, ACCEL, TURN = 0.5, 0.4, 1.0


def walk(laps: int = 1, placement: FloatArray | None = None) -> Trajectory:
    return Trajectory(SQUARE, laps, SPEED, ACCEL, TURN, 2.0, np.zeros(3) if placement is None else placement)


def test_visits_its_corners_and_ends_where_a_closed_path_ends() -> None:
    trajectory = walk()
    pose = trajectory.at(np.linspace(0.0, trajectory.duration, 20_000)).pose
    for corner in SQUARE:
        assert np.hypot(*(pose[:, :2] - corner).T).min() < 1e-3
    assert pose[-1, :2] == pytest.approx(SQUARE[0], abs=1e-9)
    assert trajectory.at(np.array([-5.0, 1.9])).pose == pytest.approx(np.tile(trajectory.start, (2, 1)))


@given(laps=st.integers(0, 2))
@settings(max_examples=3, deadline=None)
def test_moves_within_its_limits(laps: int) -> None:
    trajectory = walk(laps)
    dt = 1e-3
    motion = trajectory.at(np.arange(0.0, trajectory.duration, dt))
    velocity = np.diff(motion.pose[:, :2], axis=0) / dt
    yaw_rate = np.diff(np.unwrap(motion.pose[:, 2])) / dt
    assert np.hypot(*velocity.T).max() <= SPEED * 1.001
    assert np.abs(yaw_rate).max() <= TURN * 1.001
    assert np.hypot(*(np.diff(velocity, axis=0) / dt).T).max() <= ACCEL * 1.5
    # What the inertial sensor is told agrees with the poses.
    assert yaw_rate == pytest.approx(motion.yaw_rate[1:], abs=0.01)
    forward = np.cumsum(motion.accel) * dt
    assert np.hypot(*velocity.T) == pytest.approx(forward[1:], abs=0.01)


def test_a_misplaced_start_moves_the_whole_walk_rigidly() -> None:
    placement = np.array([0.1, -0.05, 0.2])
    right, wrong = walk(), walk(placement=placement)
    times = np.linspace(0.0, right.duration, 50)
    for a, b in zip(right.at(times).pose, wrong.at(times).pose, strict=True):
        # Seen from their starts, both are the same walk; the start's frame is that of the map here.
        moved = compose(placement, a)
        assert b[:2] == pytest.approx(moved[:2])
        assert np.cos(b[2] - moved[2]) == pytest.approx(1.0)
