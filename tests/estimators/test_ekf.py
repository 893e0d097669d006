"""The EKF: exact without noise, consistent in a world that fits it, and not to be led astray."""

import numpy as np
import pytest
from scipy.stats import chi2

from estimators.base import Verdict
from estimators.ekf import Ekf
from estimators.messages import PoseIncrement, RangeFrame
from tests.estimators.matched_world import (
    HALL,
    STEP_NS,
    constant_velocity_truth,
    matched_config,
    measured_walk,
    pose_error,
    true_increment,
    true_ranges,
    walk,
)
from tests.strategies import range_frame

RUNS = range(50)
SECONDS = 4
TIGHT = np.diag([1e-6, 1e-6, 1e-7])


def bounds(degrees: int, confidence: float) -> tuple[float, float]:
    """Two-sided chi-square bounds on a sum."""
    return float(chi2.ppf((1 - confidence) / 2, degrees)), float(chi2.ppf((1 + confidence) / 2, degrees))


def standing(config: Ekf.Config | None = None) -> Ekf:
    """Filter that founded a keyframe at 0 and saw one second of exact measurements at the start pose."""
    ekf = Ekf(config or Ekf.Config(), HALL)
    for k in range(11):
        ekf.update(true_ranges(k * 100_000_000, HALL.start.pose, HALL))
        ekf.update(PoseIncrement(0, k * 100_000_000, np.zeros(3), TIGHT, is_keyframe=k == 0))
    return ekf


NOW_NS = 1_000_000_000
SECOND = np.array([0.0, 1.0, 0.0, 0.0])


def with_outlier(stamp_ns: int, excess: float) -> RangeFrame:
    """Exact ranges at the start pose but for the second."""
    frame = true_ranges(stamp_ns, HALL.start.pose, HALL)
    return range_frame(stamp_ns, frame.anchor_ids.tolist(), (frame.ranges + excess * SECOND).tolist())


def test_noiseless_measurements_of_a_motion_that_fits_give_no_error() -> None:
    truth = constant_velocity_truth(np.array([0.5, 0.2, 0.4]), 8.0)
    ekf = Ekf(matched_config(), HALL)
    for k, (_, taken) in enumerate(measured_walk(truth, np.random.default_rng(0), noise=0.0)):
        for measurement in taken:
            ekf.update(measurement)
        if taken and k * STEP_NS >= NOW_NS:
            # The prior stood still; a second later next to nothing is left of that.
            np.testing.assert_allclose(pose_error(ekf.state[0], truth[k]), 0.0, atol=1e-3)
    mean, _ = ekf.state
    np.testing.assert_allclose(pose_error(mean, truth[-1]), 0.0, atol=1e-5)
    np.testing.assert_allclose(mean[3:6], truth[-1, 3:], atol=1e-5)


@pytest.mark.parametrize("second", range(SECONDS))
def test_nees_of_the_pose_is_within_both_bounds(second: int) -> None:
    runs = [walk(seed, SECONDS) for seed in RUNS]
    nees = [run.errors[second] @ np.linalg.solve(run.covs[second], run.errors[second]) for run in runs]
    low, high = bounds(3 * len(runs), 0.99)
    assert low < sum(nees) < high, f"mean NEES {np.mean(nees):.2f} after {second + 1} s, expected 3"


def test_nis_of_every_range_averages_one_when_nothing_is_gated() -> None:
    reports = [report for seed in RUNS for report in walk(seed, SECONDS).reports]
    assert all(verdict is Verdict.ACCEPTED for report in reports for verdict in report.verdicts)
    nis = np.concatenate([report.nis for report in reports])
    low, high = bounds(len(nis), 0.999)
    assert low < nis.sum() < high, f"mean NIS {nis.mean():.3f}, expected 1"


def test_gate_lets_the_configured_share_of_good_ranges_pass() -> None:
    verdicts = [
        verdict
        for seed in RUNS
        for report in walk(seed, SECONDS, 0.95).reports
        for verdict in report.verdicts
    ]
    assert np.mean([verdict is not Verdict.GATED for verdict in verdicts]) == pytest.approx(0.95, abs=0.01)


def test_an_outlier_is_gated_and_changes_nothing_but_time() -> None:
    disturbed, undisturbed = standing(), standing()
    stamp_ns = NOW_NS + 40_000_000
    frame = with_outlier(stamp_ns, 2.0)
    report = disturbed.update(range_frame(stamp_ns, [11], [float(frame.ranges[1])]))
    undisturbed.update(range_frame(stamp_ns, [], []))
    assert report.verdicts == (Verdict.TOO_LONG,)
    assert report.residuals[0] == pytest.approx(2.0, abs=0.2)
    for actual, expected in zip(disturbed.state, undisturbed.state, strict=True):
        np.testing.assert_array_equal(actual, expected)


def test_an_anchor_that_was_blocked_is_believed_again_only_after_a_while() -> None:
    ekf = standing()

    def verdicts(k: int, excess: float) -> tuple[Verdict, ...]:
        return ekf.update(with_outlier(NOW_NS + k * 40_000_000, excess)).verdicts

    good = Verdict.ACCEPTED
    for k in range(10):
        assert verdicts(k, 0.5) == (good, Verdict.TOO_LONG, good, good)
    assert verdicts(10, 0.0) == (good, Verdict.SUSPECT, good, good)
    for k in range(11, 30):
        verdicts(k, 0.0)
    assert verdicts(30, 0.0) == (good, good, good, good)
    ekf.reset()
    assert ekf.update(true_ranges(NOW_NS, HALL.start.pose, HALL)).verdicts == (good,) * 4


def test_an_outlier_among_good_ranges_is_the_only_one_gated() -> None:
    report = standing().update(with_outlier(NOW_NS, -1.5))
    good = Verdict.ACCEPTED
    assert report.verdicts == (good, Verdict.GATED, good, good)
    assert report.nis[1] > 100 * report.nis[[0, 2, 3]].max()


def test_an_accepted_range_moves_the_state_towards_it_and_lessens_the_doubt() -> None:
    ekf = standing()
    (mean, cov), frame = ekf.state, with_outlier(NOW_NS, 0.1)
    report = ekf.update(range_frame(NOW_NS, [11], [float(frame.ranges[1])]))
    assert report.verdicts == (Verdict.ACCEPTED,)
    away = mean[:2] - HALL.anchors[11][:2]
    moved, after = ekf.state
    assert (moved[:2] - mean[:2]) @ away > 0.0
    assert away @ after[:2, :2] @ away < away @ cov[:2, :2] @ away


def test_an_increment_carries_the_doubt_about_its_keyframe() -> None:
    # Near perfect increments from an uncertain keyframe leave a pose as uncertain as that keyframe.
    ekf = Ekf(Ekf.Config(), HALL)
    step = np.array([0.4, 0.1, 0.2])
    for k in range(41):
        report = ekf.update(PoseIncrement(0, k * 50_000_000, step * k / 40, TIGHT, is_keyframe=k == 0))
        assert report.verdicts == (Verdict.ACCEPTED,)
    mean, cov = ekf.state
    np.testing.assert_allclose(true_increment(HALL.start.pose, mean[:3]), step, atol=5e-3)
    # Doubt about the keyframe's heading swings the step: propagate the prior through the composition.
    c, s = np.cos(HALL.start.pose[2]), np.sin(HALL.start.pose[2])
    J = np.eye(3)
    J[:2, 2] = [-s * step[0] - c * step[1], c * step[0] - s * step[1]]
    prior = np.diag(HALL.start.sigma**2)
    # By moving its point of linearisation an EKF takes some 12 % off a heading variance unmeasured.
    np.testing.assert_allclose(cov[:3, :3], J @ prior @ J.T, atol=1e-3)


def test_repeated_increments_from_one_keyframe_do_not_sharpen_the_position() -> None:
    ekf = Ekf(Ekf.Config(), HALL)
    for k in range(20):
        ekf.update(PoseIncrement(0, k * 100_000_000, np.zeros(3), TIGHT, is_keyframe=k == 0))
    sigma = np.sqrt(np.diag(ekf.state[1])[:3])
    np.testing.assert_allclose(sigma, HALL.start.sigma, rtol=1e-2)


@pytest.mark.parametrize("from_stamp_ns", [NOW_NS // 2, 1, -1, 2 * NOW_NS])
def test_an_increment_from_an_unknown_reference_is_not_used(from_stamp_ns: int) -> None:
    ekf, undisturbed = standing(), standing()
    stamp_ns = NOW_NS + 100_000_000
    stray = PoseIncrement(from_stamp_ns, stamp_ns, np.array([0.5, 0.0, 0.1]), TIGHT, is_keyframe=False)
    assert ekf.update(stray).verdicts == (Verdict.NO_REFERENCE,)
    undisturbed.update(range_frame(stamp_ns, [], []))
    for actual, expected in zip(ekf.state, undisturbed.state, strict=True):
        np.testing.assert_array_equal(actual, expected)


@pytest.mark.parametrize(
    ("from_stamp_ns", "jump", "verdict"),
    [
        (0, 5.0, Verdict.GATED),
        (0, float("nan"), Verdict.IMPOSSIBLE),
        (77, 0.0, Verdict.NO_REFERENCE),
        (NOW_NS + 100_000_000, 0.0, Verdict.ACCEPTED),
        (0, 0.0, Verdict.ACCEPTED),
    ],
    ids=["gated", "not a number", "no reference", "founding", "good"],
)
def test_a_keyframe_founds_the_reference_whatever_became_of_its_increment(
    from_stamp_ns: int, jump: float, verdict: Verdict
) -> None:
    keyframe = PoseIncrement(
        from_stamp_ns, NOW_NS + 100_000_000, np.array([jump, 0.0, 0.0]), TIGHT, is_keyframe=True
    )
    ekf = standing()
    assert ekf.update(keyframe).verdicts == (verdict,)
    step = np.array([0.02, 0.0, 0.0])
    onward = PoseIncrement(keyframe.stamp_ns, keyframe.stamp_ns + 10**8, step, TIGHT, is_keyframe=False)
    assert ekf.update(onward).verdicts == (Verdict.ACCEPTED,)
    mean, _ = ekf.state
    np.testing.assert_allclose(true_increment(mean[6:], mean[:3]), step, atol=1e-3)


@pytest.mark.parametrize(("jump", "is_known"), [(5.0, False), (0.0, True)])
def test_a_heading_that_only_a_refused_keyframe_held_is_not_known(jump: float, is_known: bool) -> None:
    ekf = standing()
    ekf.update(PoseIncrement(0, NOW_NS + 10**8, np.zeros(3), TIGHT, is_keyframe=False))
    after_gap_ns = NOW_NS + 3 * 10**9  # by then the heading is anybody's guess
    ekf.update(PoseIncrement(0, after_gap_ns, np.array([60.0 * jump, 0.0, 0.0]), TIGHT, is_keyframe=True))
    pose = ekf.pose_at(after_gap_ns)
    assert pose is not None
    assert np.isfinite(pose.cov[5, 5]) == is_known


def test_a_late_keyframe_founds_nothing() -> None:
    ekf = standing()
    late = NOW_NS - 50_000_000
    assert ekf.update(PoseIncrement(late, late, np.zeros(3), TIGHT, is_keyframe=True)).verdicts == (
        Verdict.LATE,
    )
    onward = PoseIncrement(late, NOW_NS + 50_000_000, np.zeros(3), TIGHT, is_keyframe=False)
    assert ekf.update(onward).verdicts == (Verdict.NO_REFERENCE,)


def test_doubt_grows_with_time_ahead() -> None:
    ekf = standing()
    poses = [ekf.pose_at(NOW_NS + ahead) for ahead in (0, 10**8, 10**9)]
    variances = [np.diag(pose.cov)[[0, 1, 5]] for pose in poses if pose is not None]
    assert len(variances) == 3
    assert (variances[0] < variances[1]).all()
    assert (variances[1] < variances[2]).all()
