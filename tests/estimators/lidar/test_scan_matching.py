"""Scan matching in rooms whose truth is known: accuracy, covariance, and what it does with bad scans."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimators.geometry import compose
from estimators.lidar.line_map import surface
from estimators.lidar.scan_matching import ScanMatcher
from estimators.messages import FloatArray, PoseIncrement, Scan
from tests.estimators.lidar.room_scans import (
    BEAMS,
    CORRIDOR,
    OTHER_ROOM,
    PERIOD,
    ROOM,
    Arc,
    Loop,
    scan_while_moving,
    true_increment,
)

MM = 1e-3
DEG = np.pi / 180
START = np.array([2.2, 1.6, 0.3])
RANGE_SIGMA = 0.015


def standing_at(pose: FloatArray) -> Arc:
    return Arc(pose, np.zeros(3))


def matcher(**settings: float) -> ScanMatcher:
    """With the lidar at the body's origin."""
    return ScanMatcher(ScanMatcher.Config.model_validate(settings), np.zeros(3))


def error_of(increment: PoseIncrement, path: Arc | Loop) -> FloatArray:
    error = increment.increment - true_increment(path, increment.from_stamp_ns, increment.stamp_ns)
    error[2] = np.angle(np.exp(1j * error[2]))
    return error


def match_two(first: FloatArray, second: FloatArray, walls: FloatArray = ROOM) -> PoseIncrement | None:
    """Match noiseless scans from two standpoints, the second until the jump's velocity is forgotten."""
    odometry = matcher(keyframe_distance=5.0, keyframe_angle_deg=180.0)
    for k in (-1, 0):
        odometry.update(scan_while_moving(walls, standing_at(first), k * PERIOD))
    for k in range(1, 12):
        matched = odometry.update(scan_while_moving(walls, standing_at(second), k * PERIOD))
    return matched


def increments_along(
    path: Arc | Loop, scans: int, seed: int | None = None, lidar_in_body: FloatArray | None = None
) -> tuple[list[PoseIncrement], ScanMatcher]:
    """All increments of a path in the room, with range noise when there is a seed."""
    mounting = np.zeros(3) if lidar_in_body is None else lidar_in_body
    odometry = ScanMatcher(ScanMatcher.Config(), mounting)
    rng = None if seed is None else np.random.default_rng(seed)
    found = [
        odometry.update(scan_while_moving(ROOM, path, k * PERIOD, rng, RANGE_SIGMA, mounting))
        for k in range(scans)
    ]
    increments = [increment for increment in found if increment is not None]
    assert len(increments) == scans
    return increments, odometry


@cache
def noisy_loop(seed: int) -> list[PoseIncrement]:
    increments, _ = increments_along(Loop(), 120, seed)
    return increments


@pytest.mark.parametrize(
    "motion",
    [(0.0, 0.0, 0.0), (0.15, 0.0, 0.0), (0.0, -0.12, 0.0), (0.0, 0.0, 0.1), (0.1, 0.08, -0.08)],
)
def test_known_motion_is_recovered_from_noiseless_scans(motion: tuple[float, float, float]) -> None:
    step = np.array(motion)
    matched = match_two(START, compose(START, step))
    assert matched is not None
    assert matched.from_stamp_ns < matched.stamp_ns
    np.testing.assert_array_less(np.abs(matched.increment - step), [2 * MM, 2 * MM, 0.1 * DEG])


@pytest.mark.parametrize(
    "twist", [(0.8, 0.0, 0.0), (0.0, -0.5, 0.0), (0.0, 0.0, 0.9), (0.4, 0.0, 0.3), (0.3, 0.2, -0.5)]
)
def test_scans_distorted_by_motion_are_matched_as_well_as_those_at_rest(
    twist: tuple[float, float, float],
) -> None:
    # The first scan knows no velocity yet, so the robot rests for it and then drives at once.
    path = Arc(START, np.array(twist))
    rest = standing_at(path.poses(np.array([PERIOD]))[0])
    odometry = matcher(keyframe_distance=5.0, keyframe_angle_deg=180.0)
    odometry.update(scan_while_moving(ROOM, rest, 0.0))
    scans = [scan_while_moving(ROOM, path, k * PERIOD) for k in range(1, 6)]
    matched = [odometry.update(scan) for scan in scans][-1]
    assert matched is not None
    np.testing.assert_array_less(np.abs(error_of(matched, path)), [5 * MM, 5 * MM, 0.1 * DEG])


@pytest.mark.parametrize(
    "mounting", [(0.0, 0.0, 0.0), (0.2, -0.1, 0.5), (-0.1, 0.15, np.pi)], ids=["centre", "turned", "back"]
)
def test_increments_from_keyframes_compose_to_the_true_path(mounting: tuple[float, float, float]) -> None:
    path = Loop(0.7)
    increments, odometry = increments_along(path, 150, lidar_in_body=np.array(mounting))
    assert odometry.refused == 0
    keyframe_ns, keyframe = increments[0].stamp_ns, np.zeros(3)
    keyframes = 1
    for increment in increments[1:]:
        assert increment.from_stamp_ns == keyframe_ns
        if increment.is_keyframe:
            keyframe, keyframe_ns = compose(keyframe, increment.increment), increment.stamp_ns
            keyframes += 1
    # Some 7 m of way, so every keyframe but the first is half a metre or 20 degrees on.
    assert keyframes > 10
    drift = keyframe - true_increment(path, increments[0].stamp_ns, keyframe_ns)
    drift[2] = np.angle(np.exp(1j * drift[2]))
    np.testing.assert_array_less(np.abs(drift), [30 * MM, 30 * MM, 1.5 * DEG])


def test_noisy_increments_err_by_millimetres() -> None:
    errors = np.array(
        [error_of(increment, Loop()) for seed in range(3) for increment in noisy_loop(seed)[1:]]
    )
    assert len(errors) >= 200
    rms = np.sqrt((errors**2).mean(axis=0))
    np.testing.assert_array_less(rms, [5 * MM, 5 * MM, 0.2 * DEG])
    np.testing.assert_array_less(np.abs(errors.mean(axis=0)), [2 * MM, 2 * MM, 0.05 * DEG])


@pytest.mark.parametrize("speed", [0.3, 0.7, 1.0])
def test_covariance_of_increments_is_of_the_size_of_their_errors(speed: float) -> None:
    nees = []
    for seed in range(3):
        increments, _ = increments_along(Loop(speed), 200, seed)
        for increment in increments[1:]:
            error = error_of(increment, Loop(speed))
            nees.append(error @ np.linalg.solve(increment.cov, error))
    # Errors of consecutive increments are correlated: their mean is not chi-square. It claims too little
    # rather than too much: the keyframe's own end is in the covariance, without which this is 3.4 to 4.1.
    assert 3.0 / 2.0 < np.mean(nees) < 3.2


@pytest.mark.parametrize("late_by", [0.0, 0.05, 1.0])
def test_a_scan_that_is_not_newer_gives_nothing_and_changes_nothing(late_by: float) -> None:
    path = Loop()
    scans = [scan_while_moving(ROOM, path, k * PERIOD) for k in range(4)]
    plain, disturbed = matcher(), matcher()
    for scan in scans[:3]:
        plain.update(scan)
        disturbed.update(scan)
    late_ns = scans[2].stamp_ns - round(late_by * 1e9)
    assert disturbed.update(replace(scans[2], stamp_ns=late_ns)) is None
    expected, given_out = plain.update(scans[3]), disturbed.update(scans[3])
    assert expected is not None
    assert given_out is not None
    np.testing.assert_array_equal(given_out.increment, expected.increment)


def test_covariances_are_symmetric_and_positive() -> None:
    for increment in noisy_loop(0)[1:]:
        np.testing.assert_allclose(increment.cov, increment.cov.T, rtol=1e-9, atol=1e-15)
        assert np.linalg.eigvalsh(increment.cov)[0] > 0.0


def test_a_corridor_is_uncertain_along_and_certain_across() -> None:
    matched = match_two(np.array([0.0, 0.9, 0.0]), np.array([0.0, 0.9, 0.0]), CORRIDOR)
    assert matched is not None
    along, across, yaw = np.sqrt(np.diag(matched.cov))
    assert along > 0.3
    assert across < 0.02
    assert yaw < 0.5 * DEG


def test_a_turned_corridor_is_uncertain_in_its_own_direction() -> None:
    matched = match_two(np.array([0.0, 0.9, -0.7]), np.array([0.0, 0.9, -0.7]), CORRIDOR)
    assert matched is not None
    values, vectors = np.linalg.eigh(matched.cov)
    assert np.sqrt(values[-1]) > 0.3
    assert abs(vectors[:2, -1] @ [np.cos(0.7), np.sin(0.7)]) > 0.99


def with_returns(scan: Scan, count: int, missing: float) -> Scan:
    """All but `count` returns, evenly spread, replaced."""
    keep = np.zeros(BEAMS, dtype=bool)
    keep[np.linspace(0, BEAMS - 1, count).astype(int)] = True
    return replace(scan, ranges=np.where(keep, scan.ranges, missing))


@pytest.mark.parametrize("missing", [0.0, float("nan"), float("inf"), -1.0])
def test_too_few_returns_give_nothing(missing: float) -> None:
    scan = scan_while_moving(ROOM, standing_at(START), 0.0)
    assert matcher().update(with_returns(scan, 39, missing)) is None
    assert matcher().update(with_returns(scan, 40, missing)) is not None


def test_an_empty_scan_gives_nothing() -> None:
    empty = np.zeros(0)
    assert matcher().update(Scan(0, empty, empty, empty, empty)) is None


def test_a_scan_with_too_few_returns_changes_nothing() -> None:
    scans = [scan_while_moving(ROOM, Loop(), k * PERIOD) for k in range(4)]
    disturbed, undisturbed = matcher(), matcher()
    for scan in (scans[0], scans[1], with_returns(scans[2], 10, 0.0), scans[3]):
        last = disturbed.update(scan)
    for scan in (scans[0], scans[1], scans[3]):
        expected = undisturbed.update(scan)
    assert last is not None
    assert expected is not None
    np.testing.assert_array_equal(last.increment, expected.increment)


def test_missing_returns_are_as_if_they_had_never_been_sent() -> None:
    marked, shortened = matcher(), matcher()
    rng = np.random.default_rng(0)
    for k in range(5):
        scan = scan_while_moving(ROOM, Loop(), k * PERIOD)
        gone = rng.random(BEAMS) < 0.2
        gone[-1] = False  # the last beam says when the scan ended
        bad = rng.choice([0.0, float("nan"), float("inf"), -float("inf"), -2.0], BEAMS)
        a = marked.update(replace(scan, ranges=np.where(gone, bad, scan.ranges)))
        keep = ~gone
        kept = [column[keep] for column in (scan.angles, scan.ranges, scan.beam_times, scan.quality)]
        b = shortened.update(Scan(scan.stamp_ns, *kept))
        assert a is not None
        assert b is not None
        np.testing.assert_array_equal(a.increment, b.increment)
        np.testing.assert_array_equal(a.cov, b.cov)


def test_the_first_scan_founds_a_keyframe() -> None:
    scan = scan_while_moving(ROOM, standing_at(START), 3.0)
    first = matcher().update(scan)
    assert first is not None
    assert first.from_stamp_ns == first.stamp_ns == scan.end_stamp_ns
    assert first.is_keyframe
    np.testing.assert_array_equal(first.increment, np.zeros(3))


def test_a_keyframe_comes_after_the_configured_way_or_turn() -> None:
    walk, _ = increments_along(Arc(np.array([1.0, 1.2, 0.0]), np.array([0.4, 0.0, 0.0])), 30)
    # The first keyframe was taken without knowing the speed: the second scan replaces it.
    assert walk[1].is_keyframe
    for increment in walk[2:]:
        # Within the matcher's own error of the limit either answer would do.
        distance = np.hypot(increment.increment[0], increment.increment[1])
        assert increment.is_keyframe == (distance > 0.5)
    turn, _ = increments_along(Arc(START, np.array([0.0, 0.0, 0.8])), 30)
    for increment in turn[2:]:
        assert increment.is_keyframe == (abs(increment.increment[2]) > 20 * DEG)
    assert sum(increment.is_keyframe for increment in walk + turn) > 4


def test_another_room_is_refused_and_founds_a_new_keyframe() -> None:
    odometry = matcher()
    here, elsewhere = standing_at(START), standing_at(np.array([0.5, 1.0, 0.2]))
    odometry.update(scan_while_moving(ROOM, here, 0.0))
    odometry.update(scan_while_moving(ROOM, here, PERIOD))
    assert odometry.refused == 0
    lost = odometry.update(scan_while_moving(OTHER_ROOM, elsewhere, 2 * PERIOD))
    assert odometry.refused == 1
    assert lost is not None
    assert lost.is_keyframe
    assert lost.from_stamp_ns == lost.stamp_ns
    found = odometry.update(scan_while_moving(OTHER_ROOM, elsewhere, 3 * PERIOD))
    assert odometry.refused == 1
    assert found is not None
    assert found.from_stamp_ns == lost.stamp_ns


def test_same_scans_give_the_same_increments() -> None:
    again, _ = increments_along(Loop(), 120, 0)
    for first, second in zip(noisy_loop(0), again, strict=True):
        assert first.stamp_ns == second.stamp_ns
        np.testing.assert_array_equal(first.increment, second.increment)
        np.testing.assert_array_equal(first.cov, second.cov)


@given(st.floats(-np.pi, np.pi), st.floats(0.5, 5.0))
def test_normals_of_a_wall_are_square_to_it(direction: float, distance: float) -> None:
    along = np.linspace(-1.0, 1.0, 40) + 1j * distance
    turned = along * np.exp(1j * direction)
    found = surface(np.column_stack([turned.real, turned.imag]), RANGE_SIGMA)
    assert len(found.own) > 30
    wall = np.array([np.cos(direction), np.sin(direction)])
    np.testing.assert_allclose(found.normals @ wall, 0.0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1.0)


def test_corners_and_gaps_have_no_normals() -> None:
    edge = np.linspace(0.0, 1.0, 21)
    corner = np.vstack([np.column_stack([edge, np.zeros(21)]), np.column_stack([np.ones(20), edge[1:]])])
    assert 20 not in surface(corner, RANGE_SIGMA).own
    behind = np.column_stack([edge + 1.05, np.full(21, 1.0)])
    found = surface(np.vstack([corner[:21], behind]), RANGE_SIGMA)
    assert not {19, 20, 21, 22} & set(found.own.tolist())
    assert {10, 31} <= set(found.own.tolist())
    assert len(surface(corner[:3], RANGE_SIGMA).own) == 0
