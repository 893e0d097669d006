"""LiDAR odometry: dead reckoning on increments, deaf to ranges."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from estimators.base import Verdict
from estimators.ekf import Ekf
from estimators.geometry import compose
from estimators.lidar.keyframes import is_covariance
from estimators.lidar.odometry import LidarOdometry
from estimators.messages import FloatArray, PoseIncrement
from tests.strategies import SETUP, range_frame

STEP = np.array([0.02, 0.005, 0.03])
COV = np.diag([1e-6, 1e-6, 1e-7])
PERIOD_NS = 100_000_000


def odometry() -> LidarOdometry:
    return LidarOdometry(LidarOdometry.Config(), SETUP)


def increments(count: int) -> list[PoseIncrement]:
    """Equal steps, every one from the keyframe before it."""
    founding = PoseIncrement(0, 0, np.zeros(3), COV, is_keyframe=True)
    return [
        founding,
        *(
            PoseIncrement((k - 1) * PERIOD_NS, k * PERIOD_NS, STEP, COV, is_keyframe=True)
            for k in range(1, count)
        ),
    ]


def reckoned(steps: int) -> FloatArray:
    pose = SETUP.start.pose
    for _ in range(steps):
        pose = compose(pose, STEP)
    return pose


@pytest.mark.parametrize("value", [3.0, 0.0, float("nan"), 50.0])
def test_ranges_are_not_used_and_change_nothing(value: float) -> None:
    listening, deaf = odometry(), odometry()
    for k, increment in enumerate(increments(20)):
        frame = range_frame(k * PERIOD_NS, [1, 2, 99], [value] * 3)
        assert listening.update(frame).verdicts == (Verdict.NOT_USED,) * 3
        assert listening.update(increment).verdicts == deaf.update(increment).verdicts
    for actual, expected in zip(listening.state, deaf.state, strict=True):
        np.testing.assert_array_equal(actual, expected)


def test_ranges_alone_give_no_pose() -> None:
    alone = odometry()
    alone.update(range_frame(0, list(SETUP.anchors), [4.0] * 4))
    assert alone.pose_at(0) is None


def test_increments_add_up_from_the_start_pose() -> None:
    reckoning = odometry()
    verdicts = [reckoning.update(increment).verdicts for increment in increments(40)]
    assert verdicts == [(Verdict.ACCEPTED,)] * 40
    pose = reckoning.pose_at(39 * PERIOD_NS)
    assert pose is not None
    expected = reckoned(39)
    np.testing.assert_allclose(pose.xy, expected[:2], atol=2e-3)
    assert pose.yaw == pytest.approx(expected[2], abs=2e-3)


def test_doubt_never_falls_below_that_of_the_start() -> None:
    reckoning = odometry()
    for increment in increments(40):
        reckoning.update(increment)
    sigma = np.sqrt(np.diag(reckoning.state[1])[:2])
    assert (sigma > 0.99 * SETUP.start.sigma[:2]).all()


def test_the_ekf_without_ranges_is_lidar_odometry() -> None:
    alone, tight = odometry(), Ekf(Ekf.Config(), SETUP)
    for increment in increments(20):
        alone.update(increment)
        tight.update(increment)
    for actual, expected in zip(alone.state, tight.state, strict=True):
        np.testing.assert_array_equal(actual, expected)


@given(
    st.lists(st.floats(-1.0, 1.0), min_size=9, max_size=9),
    st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3),
)
def test_a_covariance_is_what_has_positive_eigenvalues(entries: list[float], values: list[float]) -> None:
    axes, _ = np.linalg.qr(np.array(entries).reshape(3, 3) + 3.0 * np.eye(3))
    # Rounding tells of a matrix that is hardly regular.
    assume(min(map(abs, values)) > 1e-6)
    matrix = axes @ np.diag(values) @ axes.T
    assert is_covariance(0.5 * (matrix + matrix.T)) == (min(values) > 0.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", range(9))
def test_what_is_not_finite_is_no_covariance(place: int, bad: float) -> None:
    cov = np.eye(3) + 0.1
    assert is_covariance(cov)
    cov.flat[place] = bad
    assert not is_covariance(cov)
    cov[:] = np.eye(3)
    cov.flat[place] = bad
    assert not is_covariance(cov)
