"""The estimators on a graph: as sure as they may be, late measurements taken, jumps told."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from estimators.base import Estimator, Report, Verdict
from estimators.ekf import Ekf
from estimators.graph.errors import GraphError
from estimators.graph.fixed_lag import FixedLag
from estimators.graph.judging import Belief, judge_ranges
from estimators.graph.jumps import is_jump
from estimators.graph.pf_ibas_graph import PfIbasGraph
from estimators.graph.smoother import GraphSmoother
from estimators.messages import FloatArray, LandmarkFrame, Measurement, PoseIncrement, RangeFrame
from estimators.range_gate import RangeGate
from tests.estimators.matched_world import (
    HALL,
    RANGE_SIGMA,
    STEP_NS,
    constant_velocity_truth,
    matched_config,
    measured_walk,
    pose_error,
    random_truth,
    true_ranges,
)
from tests.strategies import range_frame

Taken = RangeFrame | PoseIncrement
KINDS: dict[str, type[GraphSmoother]] = {"graph": GraphSmoother, "pf_ibas_graph": PfIbasGraph}
EVERY_KIND = pytest.mark.parametrize("kind", KINDS)
TIGHT = np.diag([1e-6, 1e-6, 1e-7])
NOW_NS = 10**9


def matched(kind: str, lag: float) -> GraphSmoother:
    """Estimator with the world's own noise, nothing blocked."""
    cls = KINDS[kind]
    return cls(cls.Config.model_validate({**matched_config().model_dump(), "lag": lag}), HALL)


def plain(kind: str, **settings: object) -> GraphSmoother:
    """Estimator with its defaults, but for these settings."""
    cls = KINDS[kind]
    return cls(cls.Config.model_validate(settings), HALL)


def taken(steps: Sequence[tuple[int, list[Taken]]]) -> list[Taken]:
    return [measurement for _, measurements in steps for measurement in measurements]


def run(estimator: Estimator, measurements: Sequence[Measurement]) -> list[Report]:
    return [estimator.update(measurement) for measurement in measurements]


def nees_at_the_end(kind: str, seeds: int) -> FloatArray:
    """NEES (N,) at the end of walks of three seconds, through a window of one."""
    nees = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        truth = random_truth(rng, 3.0)
        estimator = matched(kind, 1.0)
        run(estimator, taken(measured_walk(truth, rng)))
        mean, cov = estimator.state
        error = pose_error(mean, truth[-1])
        nees.append(error @ np.linalg.solve(cov[:3, :3], error))
    return np.array(nees)


@EVERY_KIND
def test_nees_is_within_both_bounds(kind: str) -> None:
    nees = nees_at_the_end(kind, 25)
    low, high = chi2.ppf(0.005, 3 * len(nees)), chi2.ppf(0.995, 3 * len(nees))
    assert low < nees.sum() < high, f"mean NEES {nees.mean():.2f}, expected 3"


@EVERY_KIND
def test_noiseless_measurements_of_a_motion_that_fits_give_no_error(kind: str) -> None:
    truth = constant_velocity_truth(np.array([0.5, 0.2, 0.4]), 4.0)
    estimator = matched(kind, 2.0)
    run(estimator, taken(measured_walk(truth, np.random.default_rng(0), noise=0.0)))
    np.testing.assert_allclose(pose_error(estimator.state[0], truth[-1]), 0.0, atol=1e-3)


def test_where_all_is_nearly_linear_it_agrees_with_the_kalman_filter() -> None:
    rng = np.random.default_rng(3)
    truth = random_truth(rng, 2.0)
    measurements = taken(measured_walk(truth, rng))
    ekf, graph = Ekf(matched_config(), HALL), matched("graph", 5.0)
    for a, b in zip(run(ekf, measurements), run(graph, measurements), strict=True):
        assert a.verdicts == b.verdicts
    sigma = np.sqrt(np.diag(ekf.state[1]))
    assert (np.abs(pose_error(ekf.state[0], graph.state[0])) < 0.3 * sigma[:3]).all()
    np.testing.assert_allclose(np.diag(graph.state[1]), sigma**2, rtol=0.1)


def test_a_range_that_is_weighed_down_becomes_a_factor_with_a_larger_sigma() -> None:
    gate = RangeGate(RangeGate.Config(range_sigma=RANGE_SIGMA, nlos=("robust",)), HALL)
    frame = true_ranges(0, HALL.start.pose, HALL)
    frame.ranges[1] += 0.5
    belief = Belief(HALL.start.pose.copy(), 1e-4 * np.eye(3))
    report, rows = judge_ranges(gate, frame, belief, HALL.tag_in_body)
    good = Verdict.ACCEPTED
    assert report.verdicts == (good, Verdict.DOWNWEIGHTED, good, good)
    np.testing.assert_array_equal(rows[:, 1], range(4))
    assert rows[1, 3] > 5.0 * RANGE_SIGMA
    assert (rows[[0, 2, 3], 3] < 1.1 * RANGE_SIGMA).all()


@EVERY_KIND
def test_the_window_is_bounded(kind: str) -> None:
    truth = constant_velocity_truth(np.array([0.3, 0.0, 0.0]), 6.0)
    estimator = matched(kind, 0.5)
    steps = taken(measured_walk(truth, np.random.default_rng(1)))
    run(estimator, steps)
    # Half a second has 13 to 16 nodes; the keyframe before it and its successors may stay 0.4 s longer.
    assert len(estimator._window.stamps_ns) < 32


def test_late_measurements_within_the_window_end_where_those_in_time_do() -> None:
    truth = constant_velocity_truth(np.array([0.4, 0.1, 0.2]), 3.0)
    steps = taken(measured_walk(truth, np.random.default_rng(2)))
    in_time, late = matched("graph", 2.0), matched("graph", 2.0)
    run(in_time, steps)
    delayed = [m for m in steps if 2.45 < m.stamp_ns * 1e-9 < 2.7]  # between two keyframes
    assert {type(m) for m in delayed} == {RangeFrame, PoseIncrement}
    run(late, [m for m in steps if m not in delayed and m.stamp_ns < 2.75e9])
    reports = run(late, delayed)
    assert {verdict for report in reports for verdict in report.verdicts} == {Verdict.ACCEPTED}
    run(late, [m for m in steps if m.stamp_ns >= 2.75e9])
    sigma = np.sqrt(np.diag(in_time.state[1]))[:3]
    assert (np.abs(pose_error(late.state[0], in_time.state[0])) < 0.05 * sigma).all()
    np.testing.assert_allclose(late.state[1], in_time.state[1], rtol=0.05, atol=1e-5)


def test_late_outliers_are_gated_and_strays_refused() -> None:
    truth = constant_velocity_truth(np.array([0.4, 0.1, 0.2]), 2.0)
    smoother = matched("graph", 1.0)
    smoother._gate._limit = 9.0
    run(smoother, taken(measured_walk(truth, np.random.default_rng(2))))
    stamp_ns = 75 * STEP_NS
    frame = true_ranges(stamp_ns, truth[75, :3], HALL)
    long = range_frame(stamp_ns, [11], [float(frame.ranges[1]) + 2.0])
    before = smoother.state[0]
    assert smoother.update(long).verdicts == (Verdict.GATED,)
    stray = PoseIncrement(12345, stamp_ns, np.zeros(3), TIGHT, is_keyframe=False)
    assert smoother.update(stray).verdicts == (Verdict.NO_REFERENCE,)
    bad = PoseIncrement(60 * STEP_NS, stamp_ns, np.full(3, np.nan), TIGHT, is_keyframe=False)
    assert smoother.update(bad).verdicts == (Verdict.IMPOSSIBLE,)
    assert smoother.update(true_ranges(0, truth[0, :3], HALL)).verdicts == (Verdict.LATE,) * 4
    np.testing.assert_array_equal(smoother.state[0], before)


def test_late_ranges_get_a_verdict_each_when_the_window_cannot_be_solved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(*_: object) -> None:
        raise GraphError("not determined")

    smoother = matched("graph", 1.0)
    run(smoother, [true_ranges(k * 10**8, HALL.start.pose, HALL) for k in range(5)])
    monkeypatch.setattr(FixedLag, "state_of", fail)
    late = true_ranges(3 * 10**8, HALL.start.pose, HALL)
    assert smoother.update(late).verdicts == (Verdict.LATE,) * 4


def test_a_pose_that_is_set_counts_on_from_the_jumps() -> None:
    smoother = plain("graph", range_gate=1 - 1e-12)
    there = HALL.start.pose + np.array([1.2, 0.0, 0.0])
    smoother.update(true_ranges(0, there, HALL))
    smoother.start_at(NOW_NS, there, TIGHT)
    pose = smoother.pose_at(NOW_NS)
    assert pose is not None
    assert pose.reset_counter == 2


def test_a_keyframe_of_a_robot_that_stands_is_found_when_it_sets_off() -> None:
    smoother = GraphSmoother(GraphSmoother.Config(), HALL)
    smoother.update(PoseIncrement(0, 0, np.zeros(3), TIGHT, is_keyframe=True))
    smoother.update(true_ranges(0, HALL.start.pose, HALL))
    step = PoseIncrement(0, NOW_NS, np.array([0.2, 0.0, 0.1]), TIGHT, is_keyframe=False)
    assert smoother.update(step).verdicts == (Verdict.ACCEPTED,)


def test_a_robot_that_stands_for_long_keeps_a_small_window() -> None:
    setup = replace(HALL, start=replace(HALL.start, still_for=60.0))
    smoother = GraphSmoother(GraphSmoother.Config(), setup)
    run(smoother, [true_ranges(k * 10**8, HALL.start.pose, HALL) for k in range(50)])
    assert len(smoother._window.graph.ranges) == 0
    assert len(smoother._window.stamps_ns) == 1
    cov = smoother.state[1]
    # As many ranges as that, each of 0.1 m, leave some 1 cm.
    assert (np.sqrt(np.diag(cov)[:2]) < 0.02).all()
    np.testing.assert_allclose(pose_error(smoother.state[0], HALL.start.pose), 0.0, atol=1e-6)


def test_landmarks_sharpen_the_pose() -> None:
    setup = replace(HALL, landmarks={5: np.array([2.0, 1.0])})
    smoother = GraphSmoother(GraphSmoother.Config(), setup)
    x, y, yaw = HALL.start.pose
    offset = setup.landmarks[5] - [x, y]
    seen = float(np.hypot(*offset)), float(np.arctan2(offset[1], offset[0]) - yaw)

    def look(distance: float, landmark: int = 5) -> LandmarkFrame:
        return LandmarkFrame(0, np.array([landmark]), np.array([distance]), np.array([seen[1]]), 0.02, 0.01)

    before = np.diag(smoother.state[1])[:3]
    assert smoother.update(look(seen[0])).verdicts == (Verdict.ACCEPTED,)
    assert (np.diag(smoother.state[1])[:2] < 0.5 * before[:2]).any()
    np.testing.assert_allclose(pose_error(smoother.state[0], HALL.start.pose), 0.0, atol=1e-6)
    assert smoother.update(look(seen[0] + 3.0)).verdicts == (Verdict.GATED,)
    assert smoother.update(look(np.nan)).verdicts == (Verdict.IMPOSSIBLE,)
    assert smoother.update(look(seen[0], 6)).verdicts == (Verdict.NOT_USED,)


def test_after_an_hour_without_anything_it_finds_itself_again() -> None:
    smoother = GraphSmoother(GraphSmoother.Config(), HALL)
    run(smoother, [true_ranges(k * 10**8, HALL.start.pose, HALL) for k in range(10)])
    there = HALL.start.pose + np.array([2.0, -1.0, 0.0])
    hour = 3600 * 10**9
    run(smoother, [true_ranges(hour + k * 10**8, there, HALL) for k in range(30)])
    pose = smoother.pose_at(hour + 3 * 10**9)
    assert pose is not None
    # Which way it faces is unknown after an hour: the antenna is found, the body but for the lever arm.
    assert float(np.linalg.norm(pose.xy - there[:2])) < 0.4


@EVERY_KIND
def test_ranges_that_the_filter_refuses_do_not_move_the_graph(kind: str) -> None:
    disturbed, undisturbed = plain(kind), plain(kind)
    for estimator in (disturbed, undisturbed):
        run(estimator, [true_ranges(k * 10**8, HALL.start.pose, HALL) for k in range(11)])
    frame = true_ranges(NOW_NS + 1, HALL.start.pose, HALL)
    report = disturbed.update(range_frame(NOW_NS + 1, [11], [float(frame.ranges[1]) + 2.0]))
    assert report.verdicts == (Verdict.TOO_LONG,)
    np.testing.assert_array_equal(disturbed.state[0], undisturbed.state[0])


def test_ranges_that_the_particle_filter_weighs_down_do_not_move_the_graph() -> None:
    disturbed, undisturbed = (plain("pf_ibas_graph", nlos=("robust",)) for _ in range(2))
    frame = true_ranges(0, HALL.start.pose, HALL)
    report = disturbed.update(range_frame(0, [11], [float(frame.ranges[1]) + 1.0]))
    assert report.verdicts == (Verdict.DOWNWEIGHTED,)
    undisturbed.update(range_frame(0, [], []))
    np.testing.assert_array_equal(disturbed.state[0], undisturbed.state[0])


def test_a_correction_that_the_covariance_explains_is_no_jump() -> None:
    cov = np.diag([0.1, 0.1, 0.05]) ** 2
    before = np.array([1.0, 2.0, np.pi - 0.01])
    assert not is_jump(before, cov, before + np.array([0.3, 0.0, 0.0]))
    assert not is_jump(before, 1e-6 * cov, before + np.array([0.04, 0.0, 0.0]))  # too small to matter
    assert is_jump(before, 1e-6 * cov, before + np.array([0.0, 0.06, 0.0]))
    assert is_jump(before, cov, before + np.array([0.6, 0.0, 0.0]))
    assert is_jump(before, cov, before + np.array([0.0, 0.0, 0.4]))
    assert not is_jump(before, cov, np.array([1.0, 2.0, -np.pi + 0.01]))  # the same heading, nearly


def test_a_jump_is_told_once() -> None:
    """The start mark was missed by eight sigma, and the gate lets it be mended."""
    smoother = GraphSmoother(GraphSmoother.Config(range_gate=1 - 1e-12), HALL)
    there = HALL.start.pose + np.array([1.2, 0.0, 0.0])
    counters = []
    for k in range(5):
        smoother.update(true_ranges(k * 10**8, there, HALL))
        pose = smoother.pose_at(k * 10**8)
        assert pose is not None
        counters.append(pose.reset_counter)
    assert counters == [1] * 5
    assert float(np.linalg.norm(smoother.state[0][:2] - there[:2])) < 0.3
    smoother.reset()
    smoother.update(true_ranges(0, HALL.start.pose, HALL))
    pose = smoother.pose_at(0)
    assert pose is not None
    assert pose.reset_counter == 0
