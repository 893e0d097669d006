"""Increments that come late are held against what the window says of the two poses that they join."""

import numpy as np
import pytest
from scipy.stats import chi2

from estimators.base import Verdict
from estimators.graph.smoother import GraphSmoother
from estimators.messages import FloatArray, PoseIncrement
from tests.estimators.matched_world import (
    HALL,
    INCREMENT_SIGMA,
    STEP_NS,
    constant_velocity_truth,
    matched_config,
    measured_walk,
    pose_error,
    true_increment,
)
from tests.estimators.models.finite_differences import numerical_jacobian

GATE = 0.99
KEYFRAME_NS, LATE_NS = 20 * STEP_NS, 44 * STEP_NS
"""Ranges have made a node at either."""
COV = np.diag(INCREMENT_SIGMA**2)


def walked() -> GraphSmoother:
    """A smoother that has got everything of 1.1 s without noise, and nothing of the late increment."""
    truth = constant_velocity_truth(np.array([0.4, 0.1, 0.2]), 1.1)
    settings = {**matched_config().model_dump(), "increment_gate": GATE, "lag": 5.0}
    smoother = GraphSmoother(GraphSmoother.Config.model_validate(settings), HALL)
    for _, measurements in measured_walk(truth, np.random.default_rng(0), noise=0.0):
        for measurement in measurements:
            assert all(v is Verdict.ACCEPTED for v in smoother.update(measurement).verdicts)
    return smoother


def known_of(smoother: GraphSmoother, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
    """Pose (3,) of a node and its covariance."""
    node = smoother._window.node_at(stamp_ns)
    assert node is not None
    state, cov = smoother._window.state_of(node)
    return state[:3], cov[:3, :3]


def innovation_cov(smoother: GraphSmoother) -> FloatArray:
    """What an increment of `COV` may contradict the two poses by, (3, 3), by numeric derivatives."""
    (first, first_cov), (second, second_cov) = (known_of(smoother, s) for s in (KEYFRAME_NS, LATE_NS))
    by_first = numerical_jacobian(lambda pose: true_increment(pose, second), first)
    by_second = numerical_jacobian(lambda pose: true_increment(first, pose), second)
    cov: FloatArray = by_first @ first_cov @ by_first.T + by_second @ second_cov @ by_second.T + COV
    return cov


def motion(smoother: GraphSmoother) -> FloatArray:
    """Increment (3,) between the two poses, as the window has them."""
    return true_increment(known_of(smoother, KEYFRAME_NS)[0], known_of(smoother, LATE_NS)[0])


@pytest.mark.parametrize("direction", [*np.eye(3), *-np.eye(3), np.array([1.0, -1.0, 0.5])], ids=str)
def test_a_late_increment_is_taken_up_to_the_gate_and_refused_beyond_it(direction: FloatArray) -> None:
    smoother = walked()
    expected = motion(smoother)
    nis_of_one = direction @ np.linalg.solve(innovation_cov(smoother), direction)
    to_the_gate = direction * np.sqrt(chi2.ppf(GATE, 3) / nis_of_one)

    def late(share: float) -> PoseIncrement:
        return PoseIncrement(KEYFRAME_NS, LATE_NS, expected + share * to_the_gate, COV, is_keyframe=False)

    mean, cov = smoother.state
    window, count = smoother.sketch().window, len(smoother._window.graph.increments)
    for share in (1.005, 2.0, 100.0):
        assert smoother.update(late(share)).verdicts == (Verdict.GATED,)
    np.testing.assert_array_equal(smoother.state[0], mean)
    np.testing.assert_array_equal(smoother.state[1], cov)
    np.testing.assert_array_equal(smoother.sketch().window, window)
    assert len(smoother._window.graph.increments) == count

    assert smoother.update(late(0.995)).verdicts == (Verdict.ACCEPTED,)
    assert len(smoother._window.graph.increments) == count + 1
    moved = pose_error(motion(smoother), expected)
    assert 0.0 < moved @ to_the_gate < to_the_gate @ to_the_gate


def test_the_turn_of_a_late_increment_is_an_angle() -> None:
    smoother = walked()
    round_about = motion(smoother) + np.array([0.0, 0.0, 2.0 * np.pi])
    late = PoseIncrement(KEYFRAME_NS, LATE_NS, round_about, COV, is_keyframe=False)
    assert smoother.update(late).verdicts == (Verdict.ACCEPTED,)


def test_a_late_keyframe_is_one_to_later_increments_even_where_its_own_is_refused() -> None:
    smoother = walked()
    astray = motion(smoother) + np.array([1.0, 0.0, 0.0])
    late = PoseIncrement(KEYFRAME_NS, LATE_NS, astray, COV, is_keyframe=True)
    assert smoother.update(late).verdicts == (Verdict.GATED,)
    at, on = known_of(smoother, LATE_NS)[0], known_of(smoother, 48 * STEP_NS)[0]
    step = PoseIncrement(LATE_NS, 48 * STEP_NS, true_increment(at, on), COV, is_keyframe=False)
    assert smoother.update(step).verdicts == (Verdict.ACCEPTED,)
