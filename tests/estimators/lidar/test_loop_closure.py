"""Old places known again, and places that only look alike refused."""

import numpy as np
import pytest

from estimators.geometry import compose, wrap_angle
from estimators.lidar.loop_closure import LoopCloser
from estimators.lidar.scan_matching import ScanMatcher
from estimators.messages import FloatArray, LoopClosure
from tests.estimators.lidar.room_scans import (
    CORRIDOR,
    OTHER_ROOM,
    PERIOD,
    ROOM,
    Arc,
    Loop,
    rectangle,
    scan_while_moving,
    true_increment,
)

SIGMA = 0.015
STILL = np.zeros((3, 3))


def closures_of_laps(scans: int, drift: FloatArray) -> list[LoopClosure]:
    """Closures on a path round the room, believed to be at the true pose plus a drift that grows."""
    path, rng = Loop(), np.random.default_rng(1)
    matcher, closer = (
        ScanMatcher(ScanMatcher.Config(), np.zeros(3)),
        LoopCloser(LoopCloser.Config(spacing=1.0)),
    )
    found = []
    for k in range(scans):
        increment = matcher.update(scan_while_moving(ROOM, path, k * PERIOD, rng, SIGMA))
        assert increment is not None
        if increment.is_keyframe:
            truth = path.poses(np.array([increment.stamp_ns * 1e-9]))[0]
            believed = compose(truth, drift * k / scans)
            closure = closer.add(increment.stamp_ns, believed, matcher.points, matcher.points_cov)
            found += [closure] if closure is not None and closure.from_stamp_ns != closure.stamp_ns else []
    return found


def still(walls: FloatArray, pose: FloatArray, seed: int) -> FloatArray:
    """Points seen by a robot that stands."""
    scan = scan_while_moving(walls, Arc(pose, np.zeros(3)), 0.0, np.random.default_rng(seed), SIGMA)
    seen = scan.ranges > 0.0
    angles, ranges = scan.angles[seen], scan.ranges[seen]
    return np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])


def compared(walls: FloatArray, others: FloatArray, pose: FloatArray, believed: FloatArray) -> LoopCloser:
    closer = LoopCloser(LoopCloser.Config(keyframes_between=1))
    closer.add(0, pose, still(walls, pose, 1), STILL)
    closer.add(10**9, np.array([100.0, 0.0, 0.0]), still(walls, pose, 2), STILL)
    assert closer.add(2 * 10**9, believed, still(others, believed, 3), STILL) is None
    return closer


@pytest.mark.parametrize("drift", [np.zeros(3), np.array([0.4, -0.3, 0.1])], ids=["exact", "drifted"])
def test_a_second_lap_is_closed_on_the_first(drift: FloatArray) -> None:
    closures = closures_of_laps(240, drift)
    assert len(closures) >= 5
    nees = []
    for closure in closures:
        truth = true_increment(Loop(), closure.from_stamp_ns, closure.stamp_ns)
        error = closure.increment - truth
        error[2] = wrap_angle(error[2])
        assert np.hypot(error[0], error[1]) < 0.03
        assert abs(np.rad2deg(error[2])) < 1.0
        nees.append(error @ np.linalg.solve(closure.cov, error))
    assert np.mean(nees) < 9.0


def test_keyframes_just_before_are_no_closure() -> None:
    closer = LoopCloser(LoopCloser.Config(keyframes_between=3))
    pose = np.array([2.2, 1.6, 0.3])
    found = [closer.add(k, pose, still(ROOM, pose, k), STILL) for k in range(9)]
    assert [closure and (closure.from_stamp_ns, closure.stamp_ns) for closure in found] == [
        (0, 0),
        None,
        None,
        None,
        (0, 4),
        # The same passage.
        None,
        None,
        None,
        (0, 8),
    ]
    assert closer.refused == 0


def test_another_room_at_the_same_place_is_refused() -> None:
    pose = np.array([2.2, 1.6, 0.3])
    assert compared(ROOM, OTHER_ROOM, pose, pose).refused == 1


def test_a_corridor_closes_no_loop() -> None:
    pose = np.array([0.0, 0.9, 0.0])
    assert compared(CORRIDOR, CORRIDOR, pose, pose + np.array([0.3, 0.0, 0.0])).refused == 1


def test_two_fits_side_by_side_are_refused() -> None:
    # Equal niches 0.6 m apart: the scan fits one as well as the other.
    niches = np.vstack([rectangle(0.6 * k, 0.0, 0.6 * k + 0.3, 0.3) for k in range(-20, 20)])
    walls = np.vstack([niches, [[[-50.0, 2.0], [50.0, 2.0]]]])
    pose = np.array([0.15, 1.1, 0.0])
    assert compared(walls, walls, pose, pose).refused == 1


def test_bad_clouds_are_refused() -> None:
    closer = LoopCloser(LoopCloser.Config(keyframes_between=1))
    for k in range(4):
        assert closer.add(k, np.zeros(3), np.empty((0, 2)), STILL) is None
