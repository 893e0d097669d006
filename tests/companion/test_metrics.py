"""Metrics against evo, whose figures papers state, and against what follows from their definition."""

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PoseTrajectory3D
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from companion.alignment import Alignment
from companion.evaluate import Errors
from companion.metrics import (
    alignment_of,
    chi2_mean_bounds,
    integrity_violations,
    relative_errors,
    trajectory_error,
)
from estimators.geometry import compose, lift, wrap_angles
from estimators.messages import FloatArray


def track(seed: int, count: int = 120) -> tuple[FloatArray, FloatArray]:
    """Poses and truth along a curve, the poses drifting, shifted and noisy."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 5.0, count)
    truth = np.column_stack([3.0 * np.cos(angle), 2.0 * np.sin(1.3 * angle), angle + np.pi / 2])
    moved = np.array([compose(np.array([0.4, -0.3, 0.2]), pose) for pose in truth])
    noise = rng.standard_normal((count, 3)) * [0.05, 0.05, 0.02]
    drift = np.outer(np.linspace(0.0, 1.0, count), [0.3, 0.1, 0.15])
    return moved + noise + drift, truth


def errors_of(poses: FloatArray, truth: FloatArray, sigma: float = 0.1) -> Errors:
    error = poses - truth
    error[:, 2] = wrap_angles(error[:, 2])
    stamps = 10_000_000 * np.arange(1, len(poses) + 1, dtype=np.int64)
    cov = np.tile(sigma**2 * np.eye(3), (len(poses), 1, 1))
    return Errors(stamps, poses, truth, error, cov, np.zeros(len(poses)), np.ones(len(poses)), 1.0)


def evo_track(poses: FloatArray) -> PoseTrajectory3D:
    return PoseTrajectory3D(
        poses_se3=[lift(pose, 0.0) for pose in poses], timestamps=0.01 * np.arange(1, len(poses) + 1)
    )


@pytest.mark.parametrize("alignment", list(Alignment))
@pytest.mark.parametrize("seed", [1, 2])
def test_trajectory_error_is_that_of_evo(alignment: Alignment, seed: int) -> None:
    poses, truth = track(seed)
    estimate, reference = evo_track(poses), evo_track(truth)
    if alignment is Alignment.SE2:
        estimate.align(reference)
    elif alignment is Alignment.FIRST_POSE:
        estimate.align_origin(reference)
    ape = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    ape.process_data((reference, estimate))
    expected = ape.get_statistic(evo_metrics.StatisticsType.rmse)
    assert trajectory_error(errors_of(poses, truth), alignment) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("distance", [0.5, 1.0, 2.5])
def test_relative_errors_are_those_of_evo(distance: float) -> None:
    poses, truth = track(3)
    found = relative_errors(errors_of(poses, truth), distance)
    for relation, ours in (
        (evo_metrics.PoseRelation.translation_part, np.hypot(found[:, 0], found[:, 1])),
        (evo_metrics.PoseRelation.rotation_angle_rad, np.abs(found[:, 2])),
    ):
        rpe = evo_metrics.RPE(relation, distance, evo_metrics.Unit.meters, pairs_from_reference=True)
        rpe.process_data((evo_track(truth), evo_track(poses)))
        assert len(ours) == len(rpe.error) > 2
        assert ours == pytest.approx(np.array(rpe.error), abs=1e-7)


@given(st.floats(-5, 5), st.floats(-5, 5), st.floats(-3.1, 3.1), st.integers(0, 5))
def test_a_track_that_was_only_moved_has_no_error_once_aligned(
    x: float, y: float, yaw: float, seed: int
) -> None:
    _, truth = track(seed, 30)
    motion = np.array([x, y, yaw])
    poses = np.array([compose(motion, pose) for pose in truth])
    errors = errors_of(poses, truth)
    for alignment in (Alignment.FIRST_POSE, Alignment.SE2):
        assert trajectory_error(errors, alignment) == pytest.approx(0.0, abs=1e-9)
        back = compose(alignment_of(poses, truth, alignment), motion)
        assert np.abs(back) == pytest.approx(np.zeros(3), abs=1e-9)
    assert relative_errors(errors) == pytest.approx(0.0, abs=1e-9)


def test_a_robot_that_stands_has_no_relative_error() -> None:
    poses = np.zeros((20, 3))
    assert relative_errors(errors_of(poses, poses)).shape == (0, 3)


def test_integrity_counts_only_what_was_flagged_healthy() -> None:
    truth = np.zeros((10, 3))
    poses = truth.copy()
    poses[3, 0] = 0.1 * np.sqrt(chi2.ppf(0.9973, 3)) * 1.001
    poses[7, 0] = 0.1 * np.sqrt(chi2.ppf(0.9973, 3)) * 0.999
    errors = errors_of(poses, truth)
    stamps = errors.stamps_ns
    assert integrity_violations(errors, stamps) == pytest.approx(0.1)
    assert integrity_violations(errors, stamps[4:]) == 0.0
    assert integrity_violations(errors, stamps[2:4]) == pytest.approx(0.5)
    assert integrity_violations(errors, []) is None


def test_an_honest_covariance_violates_three_sigma_as_often_as_a_normal_law_does() -> None:
    truth = np.zeros((100_000, 3))
    poses = 0.1 * np.random.default_rng(1).standard_normal(truth.shape)
    errors = errors_of(poses, truth)
    assert integrity_violations(errors, errors.stamps_ns) == pytest.approx(0.0027, abs=0.0005)


def test_bounds_on_a_mean_are_those_of_the_textbook() -> None:
    # Bar-Shalom et al., 5.4.2: 50 runs of two dimensions, 95 %.
    assert chi2_mean_bounds([2] * 50) == pytest.approx((1.484, 2.591), abs=1e-3)
    # Chi-square tables, 3 degrees of freedom.
    assert chi2_mean_bounds([3]) == pytest.approx((0.216, 9.348), abs=1e-3)
    assert chi2_mean_bounds([2, 3, 3]) == pytest.approx(np.array([2.180, 17.535]) / 3, abs=1e-3)
