"""Loop closures while the robot moves: at places that stay in the window, or not at all."""

from dataclasses import replace

import numpy as np
import pytest

from estimators import ESTIMATORS, estimator_config_class, make_estimator, uses_closures
from estimators.base import Verdict
from estimators.geometry import between, wrap_angle
from estimators.graph.batch import smooth
from estimators.graph.recording import Noise, Recording
from estimators.graph.smoother import GraphSmoother
from estimators.messages import FloatArray, LoopClosure, PoseIncrement
from tests.estimators.matched_world import HALL, true_ranges

STEP_NS = 500_000_000
LAP = 40
"""Steps of a round; every step ends at a keyframe."""
SIGMAS = np.array([0.01, 0.01, 0.01])
CLOSURE_SIGMAS = np.array([0.01, 0.01, 0.005])
ON_THE_MARK = replace(HALL, start=replace(HALL.start, sigma=np.full(3, 1e-3)))


def rounds(count: int) -> FloatArray:
    """Poses (N, 3) of rounds with 3 m radius, from the start of the hall."""
    angles = 2.0 * np.pi / LAP * np.arange(count)
    x, y, yaw = HALL.start.pose
    c, s = np.cos(yaw), np.sin(yaw)
    ahead, left = 3.0 * np.sin(angles), 3.0 * (1.0 - np.cos(angles))
    return np.column_stack([x + c * ahead - s * left, y + s * ahead + c * left, yaw + angles])


def drive(truth: FloatArray, seed: int, every: int = 4) -> list[PoseIncrement | LoopClosure]:
    """Increments from keyframe to keyframe, places in the first round, closures on them in those after it."""
    rng = np.random.default_rng(seed)
    measured: list[PoseIncrement | LoopClosure] = [
        PoseIncrement(0, 0, np.zeros(3), np.zeros((3, 3)), is_keyframe=True)
    ]
    for k, pose in enumerate(truth):
        now_ns = k * STEP_NS
        if k:
            step = between(truth[k - 1], pose) + SIGMAS * rng.standard_normal(3)
            measured.append(
                PoseIncrement(now_ns - STEP_NS, now_ns, step, np.diag(SIGMAS**2), is_keyframe=True)
            )
        if k % every == 0:
            place = k if k < LAP else k - LAP
            seen = between(truth[place], pose) + (k >= LAP) * CLOSURE_SIGMAS * rng.standard_normal(3)
            measured.append(LoopClosure(place * STEP_NS, now_ns, seen, np.diag(CLOSURE_SIGMAS**2)))
    return measured


def smoother(places: int = 20) -> GraphSmoother:
    config = GraphSmoother.Config(accel_noise=0.5, yaw_accel_noise=0.5, lag=2.0, places=places)
    return GraphSmoother(config, ON_THE_MARK)


def error_of(estimator: GraphSmoother, truth: FloatArray) -> FloatArray:
    error = estimator.state[0][:3] - truth
    error[2] = wrap_angle(error[2])
    return error


def test_closures_take_the_drift_of_a_round_off() -> None:
    truth, closed, open_ = rounds(2 * LAP), [], []
    for seed in range(5):
        with_places, without = smoother(), smoother(places=0)
        for measurement in drive(truth, seed):
            with_places.update(measurement)
            without.update(measurement)
        closed.append(error_of(with_places, truth[-1])[:2])
        open_.append(error_of(without, truth[-1])[:2])
    assert np.sqrt(np.square(closed).sum(axis=1).mean()) < 0.6 * np.sqrt(np.square(open_).sum(axis=1).mean())


def test_the_covariance_after_closures_is_that_of_the_errors() -> None:
    truth, squares = rounds(2 * LAP + 5), []
    for seed in range(20):
        estimator = smoother()
        for measurement in drive(truth, seed):
            estimator.update(measurement)
        error = error_of(estimator, truth[-1])
        squares.append(error @ np.linalg.solve(estimator.state[1][:3, :3], error))
    # 95 % of honest means of 20 trials are between 2.0 and 4.2.
    assert 2.0 < np.mean(squares) < 4.2


def test_a_window_with_places_says_what_the_whole_graph_says() -> None:
    truth = rounds(2 * LAP)
    measured = drive(truth, seed=3)
    online = smoother()
    for measurement in measured:
        assert online.update(measurement).verdicts == (Verdict.ACCEPTED,)
    noise = Noise(range_sigma=0.1, accel=0.5, yaw_accel=0.5)
    whole = smooth(Recording(measured, ON_THE_MARK, noise), lambda _: truth)
    assert (whole.closures, whole.false_closures) == (LAP // 4, 0)
    mean, cov = online.state
    sigma = np.sqrt(np.diag(whole.covs[-1]))
    np.testing.assert_array_less(np.abs(mean[:3] - whole.poses[-1]), 0.2 * sigma)
    np.testing.assert_allclose(np.sqrt(np.diag(cov)[:3]), sigma, rtol=0.1)


def test_false_closures_are_refused_online_and_in_the_whole_graph() -> None:
    truth = rounds(2 * LAP)
    measured = drive(truth, seed=4)
    wrong = [i for i, m in enumerate(measured) if isinstance(m, LoopClosure) and m.from_stamp_ns < m.stamp_ns]
    for i in wrong[1::3]:
        closure = measured[i]
        assert isinstance(closure, LoopClosure)
        measured[i] = replace(closure, increment=closure.increment + np.array([0.8, -0.6, 0.3]))
    online = smoother()
    verdicts = [online.update(m).verdicts[0] for m in measured]
    refused = [i for i, verdict in enumerate(verdicts) if verdict is Verdict.GATED]
    assert refused == wrong[1::3]
    noise = Noise(range_sigma=0.1, accel=0.5, yaw_accel=0.5)
    whole = smooth(Recording(measured, ON_THE_MARK, noise), lambda _: truth)
    assert whole.false_closures == len(wrong[1::3])
    assert np.hypot(*(whole.poses[-1] - truth[-1])[:2]) < 0.1


def test_places_are_few_and_the_oldest_is_forgotten() -> None:
    truth, estimator = rounds(2 * LAP), smoother(places=5)
    verdicts = {}
    for measurement in drive(truth, seed=5):
        report = estimator.update(measurement)
        if isinstance(measurement, LoopClosure) and measurement.from_stamp_ns < measurement.stamp_ns:
            verdicts[measurement.from_stamp_ns // STEP_NS] = report.verdicts[0]
    forgotten = [place for place, verdict in verdicts.items() if verdict is Verdict.NO_REFERENCE]
    assert forgotten == [0, 4, 8, 12, 16]
    assert [p for p, verdict in verdicts.items() if verdict is Verdict.ACCEPTED] == [20, 24, 28, 32, 36]


def test_a_place_where_the_robot_stood_at_first_is_known_again() -> None:
    truth = rounds(LAP + 1)
    start = replace(HALL.start, sigma=np.full(3, 1e-3), still_for=60.0)
    estimator = GraphSmoother(GraphSmoother.Config(lag=2.0), replace(HALL, start=start))
    steps = [m for m in drive(truth, seed=6) if m.stamp_ns > 0]
    estimator.update(PoseIncrement(0, 0, np.zeros(3), np.zeros((3, 3)), is_keyframe=True))
    assert estimator.update(LoopClosure(0, 0, np.zeros(3), np.zeros((3, 3)))).verdicts == (Verdict.ACCEPTED,)
    for k in range(1, 5):
        # What it hears while it stands goes to the one pose there is.
        estimator.update(true_ranges(k * STEP_NS // 10, truth[0], HALL))
    verdicts = [estimator.update(m).verdicts[0] for m in steps]
    assert verdicts[-1] is Verdict.ACCEPTED


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
def test_a_bad_closure_changes_nothing(bad: float) -> None:
    truth, estimator = rounds(LAP + 1), smoother()
    measured = drive(truth, seed=7)
    *before, last = measured
    for measurement in before:
        estimator.update(measurement)
    mean, _ = estimator.state
    assert isinstance(last, LoopClosure)
    cov = -np.eye(3) if bad == -1.0 else last.cov
    odd = replace(last, increment=np.full(3, bad), cov=cov)
    assert estimator.update(odd).verdicts == (Verdict.IMPOSSIBLE,)
    np.testing.assert_array_equal(estimator.state[0], mean)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_who_has_no_use_for_closures_says_so(name: str) -> None:
    estimator = make_estimator(name, estimator_config_class(name)(), ON_THE_MARK)
    estimator.update(PoseIncrement(0, 0, np.zeros(3), np.zeros((3, 3)), is_keyframe=True))
    report = estimator.update(LoopClosure(0, 0, np.zeros(3), np.zeros((3, 3))))
    assert report.verdicts == (Verdict.ACCEPTED if uses_closures(name) else Verdict.NOT_USED,)
