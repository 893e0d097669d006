"""Where walls do not tell everything: what nothing holds comes out wide, and what is held stays sharp."""

import numpy as np
import pytest

from estimators.lidar.scan_matching import ScanMatcher
from estimators.messages import FloatArray
from tests.estimators.lidar.room_scans import CORRIDOR, PERIOD, ROOM, Arc, scan_while_moving, true_increment

DEG = np.pi / 180
RANGE_SIGMA = 0.015


def round_hall(radius: float) -> FloatArray:
    """A wall so finely divided that no corner tells the heading."""
    angle = np.linspace(0.0, 2.0 * np.pi, 1441)
    corners = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.stack([corners[:-1], corners[1:]], axis=1)


ONE_WALL = np.array([[[-50.0, 3.0], [50.0, 3.0]]])


def walk(
    walls: FloatArray, path: Arc, seed: int, scans: int = 25
) -> tuple[FloatArray, FloatArray, ScanMatcher]:
    """Errors (N, 3) and covariances (N, 3, 3) of all increments from a robot that first stands."""
    rng = np.random.default_rng(seed)
    matcher = ScanMatcher(ScanMatcher.Config(), np.zeros(3))
    errors, covs = [], []
    for k in range(scans):
        found = matcher.update(scan_while_moving(walls, path, k * PERIOD, rng, RANGE_SIGMA))
        assert found is not None
        if found.from_stamp_ns < found.stamp_ns:
            error = found.increment - true_increment(path, found.from_stamp_ns, found.stamp_ns)
            errors.append(error)
            covs.append(found.cov)
    return np.array(errors), np.array(covs), matcher


@pytest.mark.parametrize("heading", [0.0, -0.7, 2.0])
@pytest.mark.parametrize("speed", [0.0, 0.3])
def test_noise_does_not_feign_structure_along_a_corridor(heading: float, speed: float) -> None:
    along = np.array([np.cos(heading), -np.sin(heading)])
    path = Arc(np.array([0.0, 0.9, heading]), np.array([*(speed * along), 0.0]))
    errors, covs, matcher = walk(CORRIDOR, path, seed=1)
    assert matcher.refused == 0
    for error, cov in zip(errors[2:], covs[2:], strict=True):
        values, vectors = np.linalg.eigh(cov[:2, :2])
        assert np.sqrt(values[1]) > 0.3
        assert abs(vectors[:, 1] @ along) > 0.99
        assert np.sqrt(values[0]) < 0.015
        assert np.sqrt(cov[2, 2]) < 0.5 * DEG
        assert error @ np.linalg.solve(cov, error) < 25.0
        assert abs(error @ [along[1], -along[0], 0.0]) < 0.02


def test_a_robot_that_stands_in_a_corridor_is_not_moved_along_it() -> None:
    errors, _, _ = walk(CORRIDOR, Arc(np.array([0.0, 0.9, 0.3]), np.zeros(3)), seed=2)
    assert np.abs(errors[:, :2]).max() < 0.02


def test_a_round_hall_does_not_tell_the_heading() -> None:
    errors, covs, _ = walk(round_hall(5.0), Arc(np.zeros(3), np.array([0.3, 0.0, 0.2])), seed=1)
    for error, cov in zip(errors[2:8], covs[2:8], strict=True):
        assert np.sqrt(cov[2, 2]) > 10 * DEG
        assert error @ np.linalg.solve(cov, error) < 25.0


def test_one_wall_tells_distance_and_heading_alone() -> None:
    _, covs, _ = walk(ONE_WALL, Arc(np.zeros(3), np.zeros(3)), seed=1)
    sigma = np.sqrt(np.diagonal(covs[2:], axis1=1, axis2=2))
    assert (sigma[:, 0] > 0.5).all()
    assert (sigma[:, 1] < 0.05).all()
    assert (sigma[:, 2] < 2 * DEG).all()


def test_after_a_long_gap_a_bare_wall_is_not_taken_for_the_one_before() -> None:
    path = Arc(np.array([0.0, 0.9, 0.0]), np.zeros(3))
    matcher = ScanMatcher(ScanMatcher.Config(), np.zeros(3))
    room = ScanMatcher(ScanMatcher.Config(), np.zeros(3))
    in_room = Arc(np.array([2.2, 1.6, 0.3]), np.zeros(3))
    for k in range(5):
        matcher.update(scan_while_moving(CORRIDOR, path, k * PERIOD))
        room.update(scan_while_moving(ROOM, in_room, k * PERIOD))
    after = matcher.update(scan_while_moving(CORRIDOR, path, 10.0))
    assert after is not None
    assert after.from_stamp_ns == after.stamp_ns
    # A room that is seen whole is known again.
    again = room.update(scan_while_moving(ROOM, in_room, 10.0))
    assert again is not None
    assert again.from_stamp_ns < again.stamp_ns
