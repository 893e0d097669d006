"""A robot that stands at first: nothing it knows at the start fades until it may have moved."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.ekf import Ekf
from estimators.messages import FloatArray, PoseIncrement
from tests.estimators.matched_world import HALL, true_ranges
from tests.strategies import range_frame

TENTH_NS = 10**8
STILL_FOR = 2.0
TIGHT = np.diag([1e-6, 1e-6, 1e-7])


def standing_since_zero(until_tenth: int) -> Ekf:
    """Filter that saw exact ranges at the start pose ten times a second."""
    ekf = Ekf(Ekf.Config(), replace(HALL, start=replace(HALL.start, still_for=STILL_FOR)))
    for tenth in range(until_tenth + 1):
        ekf.update(true_ranges(tenth * TENTH_NS, HALL.start.pose, HALL))
    return ekf


def sigmas(ekf: Ekf) -> FloatArray:
    """Standard deviations of pose and velocity, (6,)."""
    return np.asarray(np.sqrt(np.diag(ekf.state[1])[:6]), dtype=np.float64)


def test_ranges_to_a_standing_robot_only_add_knowledge() -> None:
    ekf = standing_since_zero(20)
    sigma = sigmas(ekf)
    assert (sigma[:2] < 0.5 * HALL.start.sigma[:2]).all()
    assert sigma[2] <= HALL.start.sigma[2]
    np.testing.assert_array_equal(sigma[3:], np.zeros(3))
    now, ahead = ekf.pose_at(20 * TENTH_NS), ekf.pose_at(21 * TENTH_NS)
    assert now is not None
    assert ahead is not None
    np.testing.assert_array_equal(now.cov, ahead.cov)


@pytest.mark.parametrize("tenth", [21, 30])
def test_it_may_move_when_the_time_is_over(tenth: int) -> None:
    ekf = standing_since_zero(20)
    before = sigmas(ekf)
    ekf.update(range_frame(tenth * TENTH_NS, [], []))
    assert (sigmas(ekf) > before).all()


def test_it_may_move_from_the_first_increment_on() -> None:
    ekf = standing_since_zero(5)
    ekf.update(PoseIncrement(5 * TENTH_NS, 5 * TENTH_NS, np.zeros(3), TIGHT, is_keyframe=True))
    np.testing.assert_array_equal(sigmas(ekf)[3:], np.zeros(3))
    ekf.update(PoseIncrement(5 * TENTH_NS, 6 * TENTH_NS, np.zeros(3), TIGHT, is_keyframe=False))
    assert (sigmas(ekf)[3:] > 0.0).all()
    ekf.reset()
    np.testing.assert_array_equal(sigmas(ekf)[3:], np.zeros(3))
    ekf.update(range_frame(0, [], []))
    ekf.update(range_frame(TENTH_NS, [], []))
    np.testing.assert_array_equal(sigmas(ekf)[3:], np.zeros(3))


@pytest.mark.parametrize(
    "increment",
    [
        PoseIncrement(2 * TENTH_NS, 4 * TENTH_NS, np.zeros(3), TIGHT, is_keyframe=False),
        PoseIncrement(2 * TENTH_NS, 6 * TENTH_NS, np.zeros(3), TIGHT, is_keyframe=False),
        PoseIncrement(5 * TENTH_NS, 6 * TENTH_NS, np.full(3, np.nan), TIGHT, is_keyframe=False),
    ],
    ids=["late", "no reference", "not a number"],
)
def test_an_increment_that_is_refused_does_not_set_it_off(increment: PoseIncrement) -> None:
    ekf = standing_since_zero(5)
    ekf.update(PoseIncrement(5 * TENTH_NS, 5 * TENTH_NS, np.zeros(3), TIGHT, is_keyframe=True))
    ekf.update(increment)
    np.testing.assert_array_equal(sigmas(ekf)[3:], np.zeros(3))
