"""Scans and an odometry from outside: rare scans, swaying bodies, directions without walls, a blind LiDAR."""

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimators.geometry import between, compose, wrap_angle
from estimators.lidar.fused_odometry import FusedOdometry
from estimators.lidar.known_motion import OdometryTrack
from estimators.lidar.scan_matching import ScanMatcher
from estimators.messages import FloatArray, PoseIncrement, Scan
from estimators.models.motion import chained
from tests.estimators.lidar.room_scans import (
    CORRIDOR,
    ROOM,
    Arc,
    Loop,
    scan_while_moving,
    true_increment,
)

SIGMA = 0.015
STEP = 0.04
"""Odometry comes at 25 Hz."""
SHARE, LEAST = 0.05, 1e-3
"""What a step errs by: this much of its length and turn, and so much [m, rad] beside it."""


def odometry(path: Arc | Loop, seconds: float, seed: int) -> list[PoseIncrement]:
    """Steps of an odometry along a path."""
    rng = np.random.default_rng(seed)
    times = (STEP * np.arange(round(seconds / STEP) + 1)).astype(np.float64)
    poses = path.poses(times)
    steps = [PoseIncrement(0, 0, np.zeros(3), np.zeros((3, 3)), is_keyframe=True)]
    for before, after in pairwise(poses):
        step = between(before, after)
        along, about = SHARE * np.hypot(step[0], step[1]) + LEAST, SHARE * abs(step[2]) + LEAST
        sigmas = np.array([along, along, about])
        end_ns = steps[-1].stamp_ns + round(STEP * 1e9)
        noisy = step + rng.normal(0.0, sigmas)
        steps.append(PoseIncrement(steps[-1].stamp_ns, end_ns, noisy, np.diag(sigmas**2), is_keyframe=True))
    return steps


def scans(path: Arc | Loop, seconds: float, period: float, walls: FloatArray = ROOM) -> list[Scan]:
    rng = np.random.default_rng(7)
    count = round(seconds / period)
    return [scan_while_moving(walls, path, k * period, rng, SIGMA, period=period) for k in range(count)]


def increments(measured: Iterable[Scan | PoseIncrement]) -> list[PoseIncrement]:
    """What comes of measurements in the order of their stamps."""
    front_end = FusedOdometry(ScanMatcher(ScanMatcher.Config(), np.zeros(3)))

    def complete(m: Scan | PoseIncrement) -> int:
        return m.end_stamp_ns if isinstance(m, Scan) else m.stamp_ns

    found = (front_end.update(m) for m in sorted(measured, key=complete))
    return [increment for increment in found if increment is not None]


def chain(found: Iterable[PoseIncrement], path: Arc | Loop) -> tuple[FloatArray, FloatArray]:
    """Chained poses (K, 3) from the true first one, and true ones (K, 3); every reference must be held."""
    first, *rest = found
    assert first.from_stamp_ns == first.stamp_ns
    pose = reference = path.poses(np.array([first.stamp_ns * 1e-9]))[0]
    reference_ns, poses, stamps = first.stamp_ns, [pose], [first.stamp_ns]
    for increment in rest:
        assert increment.from_stamp_ns == reference_ns < increment.stamp_ns
        pose = compose(reference, increment.increment)
        poses.append(pose)
        stamps.append(increment.stamp_ns)
        if increment.is_keyframe:
            reference, reference_ns = pose, increment.stamp_ns
    return np.array(poses), path.poses(np.array(stamps) * 1e-9)


def errors(found: list[PoseIncrement], path: Arc | Loop) -> FloatArray:
    """Errors (K, 3) of the increments themselves, the first ones left out."""
    off = []
    for increment in found:
        if increment.from_stamp_ns < increment.stamp_ns:
            error = increment.increment - true_increment(path, increment.from_stamp_ns, increment.stamp_ns)
            error[2] = wrap_angle(error[2])
            off.append(error)
    return np.array(off)


def nees(found: list[PoseIncrement], path: Arc | Loop) -> FloatArray:
    covs = [m.cov for m in found if m.from_stamp_ns < m.stamp_ns]
    off = errors(found, path)
    return np.array([e @ np.linalg.solve(cov, e) for e, cov in zip(off, covs, strict=True)])


@pytest.mark.parametrize("period", [1.0, 0.1])
def test_scans_take_the_drift_off_odometry_however_rare_they_are(period: float) -> None:
    path, seconds = Loop(speed=2.0), 24.0
    steps = odometry(path, seconds, seed=1)
    seen = scans(path, seconds, period)
    found = increments([*seen, *steps])
    poses, truth = chain(found, path)
    dead, dead_truth = chain(steps, path)
    drift, dead_drift = (
        np.hypot(*(p - t)[:, :2].T)[-20:].mean() for p, t in [(poses, truth), (dead, dead_truth)]
    )
    assert drift < 0.12
    assert dead_drift > 2.0 * drift
    ends = {scan.end_stamp_ns for scan in seen}
    of_scans = [m for m in found if m.stamp_ns in ends]
    assert len(of_scans) == len(seen)
    assert sum(m.from_stamp_ns == m.stamp_ns for m in found) == 1
    # Beams of a second are bent by what odometry errs within it, which is told in part only.
    assert 1.0 < nees(of_scans, path).mean() < 6.0


def test_one_scan_a_second_without_odometry_begins_anew_again_and_again() -> None:
    alone = increments(scans(Loop(speed=2.0), 24.0, period=1.0))
    assert sum(m.from_stamp_ns == m.stamp_ns for m in alone) > 5


def test_odometry_holds_the_direction_that_a_corridor_does_not() -> None:
    path = Arc(np.array([0.0, 0.9, 0.0]), np.array([0.5, 0.0, 0.0]))
    found = increments([*scans(path, 6.0, 0.1, CORRIDOR), *odometry(path, 6.0, seed=2)])
    between_keyframes = [m for m in found[5:] if not m.is_keyframe]
    keyframes = [m for m in found[5:] if m.is_keyframe]
    # What odometry says is said once, where the next keyframe begins.
    assert min(np.sqrt(m.cov[0, 0]) for m in between_keyframes) > 0.5
    assert max(np.sqrt(m.cov[0, 0]) for m in keyframes) < 0.06
    assert nees(keyframes, path).mean() < 6.0
    poses, truth = chain([m for m in found if m.is_keyframe], path)
    assert np.abs(poses[-1] - truth[-1])[:2].max() < 0.1


def test_a_keyframe_knows_as_much_as_scan_and_odometry_together() -> None:
    path = Arc(np.array([0.0, 0.9, 0.0]), np.array([0.5, 0.0, 0.0]))
    steps = odometry(path, 4.0, seed=2)
    last = [m for m in increments([*scans(path, 4.0, 0.1, CORRIDOR), *steps]) if m.is_keyframe][-1]
    track = OdometryTrack((0.5, 1.5))
    for step in steps:
        track.add(step)
    known = track.motion(last.from_stamp_ns, last.stamp_ns)
    assert known is not None
    # Along the corridor odometry alone tells, across it the walls tell more.
    assert last.cov[0, 0] == pytest.approx(known[1][0, 0], rel=0.05)
    assert last.increment[0] == pytest.approx(known[0][0], abs=0.01)
    assert last.cov[1, 1] < 0.5 * known[1][1, 1]


def test_odometry_goes_on_where_scans_fail_and_scans_take_over_again() -> None:
    path, seconds = Loop(), 15.0
    seen = [s for s in scans(path, seconds, 0.1) if not 5e9 < s.stamp_ns < 9e9]
    found = increments([*seen, *odometry(path, seconds, seed=3)])
    poses, truth = chain(found, path)
    assert sum(m.from_stamp_ns == m.stamp_ns for m in found) == 1
    blind = [m for m in found if 5.7e9 < m.stamp_ns < 9e9]
    assert len(blind) > 70
    assert all(m.is_keyframe for m in blind)
    assert np.hypot(*(poses - truth)[-1, :2]) < 0.1
    assert found[-1].stamp_ns == seen[-1].end_stamp_ns


def test_without_scans_odometry_passes_as_it_came() -> None:
    steps = odometry(Loop(), 2.0, seed=4)
    for ours, theirs in zip(increments(steps), steps, strict=True):
        assert (ours.from_stamp_ns, ours.stamp_ns) == (theirs.from_stamp_ns, theirs.stamp_ns)
        np.testing.assert_allclose(ours.increment, theirs.increment, atol=1e-12)
        np.testing.assert_allclose(ours.cov, theirs.cov, atol=1e-15)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
def test_a_bad_step_is_a_gap(bad: float) -> None:
    path = Loop()
    steps = odometry(path, 6.0, seed=5)
    cov = np.full((3, 3), bad) if bad < 0.0 else steps[60].cov
    step = np.full(3, bad)
    steps[60] = PoseIncrement(steps[60].from_stamp_ns, steps[60].stamp_ns, step, cov, is_keyframe=True)
    for found in (increments(steps), increments([*scans(path, 6.0, 0.1), *steps])):
        assert np.isfinite([m.increment for m in found]).all()
        assert np.isfinite([m.cov for m in found]).all()
        assert len(found) >= 60


def test_a_gap_of_the_odometry_begins_anew() -> None:
    steps = odometry(Loop(), 4.0, seed=6)
    found = increments([*steps[:30], *steps[40:]])
    assert [m.stamp_ns for m in found if m.from_stamp_ns == m.stamp_ns] == [0, steps[40].stamp_ns]


@settings(max_examples=30)
@given(
    st.lists(st.tuples(*[st.floats(-0.3, 0.3)] * 3), min_size=2, max_size=20),
    st.floats(0.0, 1.0),
    st.floats(0.0, 1.0),
)
def test_motion_between_any_instants_is_motion_there_and_on(
    moves: list[tuple[float, float, float]], first: float, second: float
) -> None:
    track, step_ns = OdometryTrack((0.5, 1.5)), 40_000_000
    for k, move in enumerate(moves):
        cov = 1e-4 * np.eye(3)
        track.add(PoseIncrement(k * step_ns, (k + 1) * step_ns, np.array(move), cov, is_keyframe=True))
    end_ns = len(moves) * step_ns
    a_ns, b_ns = sorted(round(share * end_ns) for share in (first, second))
    whole, to_a, a_to_b, to_b = (
        track.motion(*pair) for pair in [(0, end_ns), (0, a_ns), (a_ns, b_ns), (0, b_ns)]
    )
    assert whole is not None
    assert to_a is not None
    assert a_to_b is not None
    assert to_b is not None
    joined, cov = chained(*to_a, *a_to_b)
    np.testing.assert_allclose(joined, to_b[0], atol=1e-9)
    # A step is divided as a straight walk's: what its halves err by sideways is neglected.
    np.testing.assert_allclose(cov, to_b[1], atol=2e-5)
    product = np.zeros(3)
    for move in moves:
        product = compose(product, np.array(move))
    np.testing.assert_allclose(whole[0], product, atol=1e-9)


def test_the_covariance_of_a_chain_is_that_of_drawn_steps() -> None:
    rng = np.random.default_rng(1)
    step, sigmas = np.array([0.1, 0.02, 0.1]), np.array([0.01, 0.02, 0.03])
    moved, cov = np.zeros(3), np.zeros((3, 3))
    for _ in range(10):
        moved, cov = chained(moved, cov, step, np.diag(sigmas**2))
    ends = np.zeros((20_000, 3))
    for _ in range(10):
        noisy = step + sigmas * rng.standard_normal(ends.shape)
        c, s = np.cos(ends[:, 2]), np.sin(ends[:, 2])
        ends[:, 0] += c * noisy[:, 0] - s * noisy[:, 1]
        ends[:, 1] += s * noisy[:, 0] + c * noisy[:, 1]
        ends[:, 2] += noisy[:, 2]
    np.testing.assert_allclose(np.cov(ends.T), cov, rtol=0.08, atol=2e-5)
