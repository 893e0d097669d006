"""Estimators that can be told where the robot is."""

import numpy as np
import pytest

from estimators import ESTIMATORS, estimator_config_class, make_estimator
from estimators.base import Settable, Verdict
from estimators.messages import PoseIncrement
from tests.estimators.matched_world import HALL, true_increment, true_ranges

SECOND_NS = 10**9
POSE = np.array([3.0, 2.0, -3.1])
COV = np.array([[0.04, 0.01, 0.0], [0.01, 0.03, 0.002], [0.0, 0.002, 0.02]])
SETTABLE = ["ekf", "graph", "lidar_odometry", "pf", "pf_ibas", "pf_ibas_graph", "pf_ibas_printed"]
EVERY_ONE = pytest.mark.parametrize("name", SETTABLE)


def walked(name: str) -> Settable:
    """Estimator that stood at the start for a second and has a keyframe there."""
    estimator = make_estimator(name, estimator_config_class(name)(), HALL)
    assert isinstance(estimator, Settable)
    for k in range(11):
        estimator.update(true_ranges(k * SECOND_NS // 10, HALL.start.pose, HALL))
        estimator.update(PoseIncrement(0, k * SECOND_NS // 10, np.zeros(3), 1e-6 * np.eye(3), k == 0))
    return estimator


def test_all_others_say_that_they_cannot() -> None:
    others = sorted(set(ESTIMATORS) - set(SETTABLE))
    for name in others:
        assert not isinstance(make_estimator(name, estimator_config_class(name)(), HALL), Settable)


@EVERY_ONE
def test_pose_and_covariance_are_those_given_and_the_reset_is_counted(name: str) -> None:
    estimator = walked(name)
    for resets, stamp_ns in enumerate([SECOND_NS, SECOND_NS // 2], start=1):
        estimator.start_at(stamp_ns, POSE, COV)
        pose = estimator.pose_at(stamp_ns)
        assert pose is not None
        np.testing.assert_allclose(pose.xy, POSE[:2], atol=1e-9)
        assert pose.yaw == pytest.approx(POSE[2], abs=1e-9)
        np.testing.assert_allclose(pose.planar_cov, COV, atol=1e-9)
        assert pose.reset_counter == resets
    estimator.reset()
    estimator.update(PoseIncrement(0, 0, np.zeros(3), COV, is_keyframe=True))
    pose = estimator.pose_at(0)
    assert pose is not None
    assert pose.reset_counter == 0


@EVERY_ONE
def test_it_moves_freely_from_then_on(name: str) -> None:
    estimator = walked(name)
    estimator.start_at(SECOND_NS, POSE, COV)
    now, later = estimator.pose_at(SECOND_NS), estimator.pose_at(2 * SECOND_NS)
    assert now is not None
    assert later is not None
    assert (np.diag(later.planar_cov) > np.diag(now.planar_cov) + 0.05).all()


@EVERY_ONE
def test_increments_from_that_moment_are_followed_and_earlier_keyframes_forgotten(name: str) -> None:
    estimator = walked(name)
    estimator.start_at(SECOND_NS, POSE, COV)
    step, tight = np.array([0.1, 0.02, 0.05]), 1e-8 * np.eye(3)
    stamp_ns = SECOND_NS + SECOND_NS // 10
    old = PoseIncrement(0, stamp_ns, step, tight, is_keyframe=False)
    assert estimator.update(old).verdicts == (Verdict.NO_REFERENCE,)
    new = PoseIncrement(SECOND_NS, stamp_ns, step, tight, is_keyframe=False)
    assert estimator.update(new).verdicts == (Verdict.ACCEPTED,)
    pose = estimator.pose_at(stamp_ns)
    assert pose is not None
    # A cloud's mean lies inside the arc of its particles, by half the heading's variance.
    np.testing.assert_allclose(true_increment(POSE, np.array([*pose.xy, pose.yaw])), step, atol=2e-3)


@EVERY_ONE
def test_what_is_older_than_that_moment_is_late_and_ranges_after_it_count(name: str) -> None:
    estimator = walked(name)
    estimator.start_at(2 * SECOND_NS, POSE, COV)
    late = PoseIncrement(0, 2 * SECOND_NS - 1, np.zeros(3), COV, is_keyframe=True)
    assert estimator.update(late).verdicts == (Verdict.LATE,)
    report = estimator.update(true_ranges(2 * SECOND_NS, POSE, HALL))
    expected = Verdict.NOT_USED if name == "lidar_odometry" else Verdict.ACCEPTED
    assert report.verdicts == (expected,) * 4


@pytest.mark.parametrize("name", ["ekf", "graph", "pf", "pf_ibas", "pf_ibas_graph"])
def test_anchors_that_were_doubted_are_trusted_again(name: str) -> None:
    estimator = walked(name)
    far = HALL.start.pose + np.array([3.0, 0.0, 0.0])
    assert Verdict.GATED in estimator.update(true_ranges(SECOND_NS, far, HALL)).verdicts
    estimator.start_at(SECOND_NS, far, COV)
    assert estimator.update(true_ranges(SECOND_NS, far, HALL)).verdicts == (Verdict.ACCEPTED,) * 4
