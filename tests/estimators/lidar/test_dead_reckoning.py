"""Increments added up: the path, its covariance, and what is refused."""

import numpy as np
import pytest
from scipy.stats import chi2

from estimators.base import Verdict
from estimators.geometry import between, compose, wrap_angle
from estimators.lidar.dead_reckoning import DeadReckoning
from estimators.messages import FloatArray, PoseIncrement
from tests.strategies import SETUP, range_frame

START = np.array([1.0, -2.0, 2.5])
COV = np.diag([4e-4, 1e-4, 1e-4])
STEP_NS = 10**8


def path(count: int) -> list[FloatArray]:
    poses = [START]
    for k in range(count):
        poses.append(compose(poses[-1], np.array([0.1, 0.0, 0.05 * (k % 7)])))
    return poses


def increments(poses: list[FloatArray], noise: FloatArray, keyframe_every: int = 1) -> list[PoseIncrement]:
    """Founding increment, then one to every pose; `noise` (N, 3) is added."""
    taken = [PoseIncrement(0, 0, np.zeros(3), np.zeros((3, 3)), is_keyframe=True)]
    keyframe = 0
    for k in range(1, len(poses)):
        value = between(poses[keyframe], poses[k]) + noise[k - 1]
        is_keyframe = k % keyframe_every == 0
        taken.append(PoseIncrement(keyframe * STEP_NS, k * STEP_NS, value, COV, is_keyframe))
        keyframe = k if is_keyframe else keyframe
    return taken


def error(estimator: DeadReckoning, stamp_ns: int, truth: FloatArray) -> FloatArray:
    pose = estimator.pose_at(stamp_ns)
    assert pose is not None
    return np.array([*(pose.xy - truth[:2]), wrap_angle(pose.yaw - truth[2])])


@pytest.mark.parametrize("keyframe_every", [1, 4])
def test_exact_increments_give_the_path_from_the_true_start(keyframe_every: int) -> None:
    poses = path(30)
    estimator = DeadReckoning(SETUP, START)
    assert estimator.pose_at(0) is None
    for k, measured in enumerate(increments(poses, np.zeros((30, 3)), keyframe_every)):
        assert estimator.update(measured).verdicts == (Verdict.ACCEPTED,)
        np.testing.assert_allclose(error(estimator, k * STEP_NS, poses[k]), 0.0, atol=1e-12)
    estimator.reset()
    assert estimator.pose_at(0) is None


@pytest.mark.parametrize("keyframe_every", [1, 4])
def test_covariance_is_that_of_the_sum(keyframe_every: int) -> None:
    rng = np.random.default_rng(0)
    poses = path(20)
    nees = []
    for _ in range(200):
        estimator = DeadReckoning(SETUP, START)
        noise = rng.standard_normal((20, 3)) * np.sqrt(np.diag(COV))
        for measured in increments(poses, noise, keyframe_every):
            estimator.update(measured)
        pose = estimator.pose_at(20 * STEP_NS)
        assert pose is not None
        off = error(estimator, 20 * STEP_NS, poses[-1])
        nees.append(float(off @ np.linalg.solve(pose.planar_cov, off)))
    assert chi2.ppf(0.001, 600) < np.sum(nees) < chi2.ppf(0.999, 600)


def test_it_goes_on_with_the_last_velocity() -> None:
    steady = [START]
    for _ in range(6):
        steady.append(compose(steady[-1], np.array([0.1, 0.0, 0.2])))
    estimator = DeadReckoning(SETUP, START)
    for measured in increments(steady[:5], np.zeros((4, 3)), keyframe_every=3):
        estimator.update(measured)
    np.testing.assert_allclose(error(estimator, 5 * STEP_NS, steady[5]), 0.0, atol=1e-9)


def test_a_new_reference_is_founded_where_the_robot_is_by_now() -> None:
    poses = path(3)
    estimator = DeadReckoning(SETUP, START)
    for measured in increments(poses, np.zeros((3, 3)))[:3]:
        estimator.update(measured)
    before = estimator.pose_at(3 * STEP_NS)
    founding = PoseIncrement(3 * STEP_NS, 3 * STEP_NS, np.zeros(3), np.zeros((3, 3)), is_keyframe=True)
    assert estimator.update(founding).verdicts == (Verdict.ACCEPTED,)
    after = estimator.pose_at(3 * STEP_NS)
    assert before is not None
    assert after is not None
    np.testing.assert_allclose(after.T_map_body, before.T_map_body)
    onward = PoseIncrement(3 * STEP_NS, 4 * STEP_NS, np.array([1.0, 0.0, 0.0]), COV, is_keyframe=False)
    estimator.update(onward)
    moved = estimator.pose_at(4 * STEP_NS)
    assert moved is not None
    assert float(np.hypot(*(moved.xy - after.xy))) == pytest.approx(1.0)


def test_what_cannot_be_added_gets_a_verdict_and_changes_nothing() -> None:
    poses = path(5)
    estimator = DeadReckoning(SETUP, START)
    for measured in increments(poses, np.zeros((5, 3))):
        estimator.update(measured)
    before = estimator.pose_at(5 * STEP_NS)
    nan = np.array([np.nan, 0.0, 0.0])
    cases = [
        (PoseIncrement(0, 6 * STEP_NS, np.zeros(3), COV, is_keyframe=True), Verdict.NO_REFERENCE),
        (PoseIncrement(4 * STEP_NS, 4 * STEP_NS, np.zeros(3), COV, is_keyframe=True), Verdict.LATE),
        (PoseIncrement(5 * STEP_NS, 6 * STEP_NS, nan, COV, is_keyframe=True), Verdict.IMPOSSIBLE),
        (
            PoseIncrement(5 * STEP_NS, 6 * STEP_NS, np.zeros(3), np.full((3, 3), np.inf), is_keyframe=True),
            Verdict.IMPOSSIBLE,
        ),
    ]
    for measured, verdict in cases:
        assert estimator.update(measured).verdicts == (verdict,)
    frame = range_frame(6 * STEP_NS, [1, 2], [1.0, 2.0])
    assert estimator.update(frame).verdicts == (Verdict.NOT_USED,) * 2
    after = estimator.pose_at(5 * STEP_NS)
    assert before is not None
    assert after is not None
    np.testing.assert_array_equal(after.T_map_body, before.T_map_body)
    np.testing.assert_array_equal(after.cov, before.cov)
