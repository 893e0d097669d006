"""The search against independent optimisers, and its covariance against what its errors really are."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.optimize import Bounds, differential_evolution
from scipy.stats import chi2

from estimators.geometry import transform
from estimators.messages import FloatArray, PoseIncrement, RangeFrame
from estimators.range_gate import HorizontalRanges
from estimators.relocation.search import (
    BLOCKED_LOSS,
    SHORT_LIMIT,
    find_pose,
    residuals_at,
    too_short,
    total_loss,
)
from estimators.relocation.window import PlacedRanges, Window
from tests.estimators.matched_world import pose_error
from tests.estimators.relocation.wandering_robot import ROOM, Robot, clear

BIAS_SIGMA = 0.05


def placed_by(robot: Robot, seconds: float) -> tuple[PlacedRanges, FloatArray]:
    """Ranges of a walk, and where the newest keyframe really was."""
    window = Window(5.0, HorizontalRanges(0.1, ROOM), ROOM)
    keyframe = robot.pose
    for _ in range(round(seconds * 10)):
        for measurement in robot.walk(0.1):
            if isinstance(measurement, RangeFrame):
                window.add_ranges(measurement)
            elif isinstance(measurement, PoseIncrement):
                window.add_increment(measurement)
                keyframe = robot.pose if measurement.is_keyframe else keyframe
    placed = window.ranges_since(5.0)
    assert placed is not None
    return placed, keyframe


def loss_in_plain_words(placed: PlacedRanges, pose: FloatArray) -> float:
    """The loss of `search` by its definition, a range at a time."""
    total = 0.0
    for tag, anchor, measured, sigma in zip(
        placed.tags, placed.anchors, placed.ranges, placed.sigmas, strict=True
    ):
        place = complex(*pose[:2]) + complex(*tag) * np.exp(1j * pose[2])
        excess = (measured - abs(place - complex(*anchor))) / sigma
        if excess > 0.0:
            total += BLOCKED_LOSS * (1.0 - np.exp(-(excess**2) / 2.0 / BLOCKED_LOSS))
        elif excess > -SHORT_LIMIT:
            total += excess**2 / 2.0
        else:
            total += SHORT_LIMIT * (-excess - SHORT_LIMIT / 2.0)
    return float(total)


@pytest.mark.parametrize("seed", range(3))
def test_loss_is_what_it_says(seed: int) -> None:
    placed, _ = placed_by(Robot(ROOM, seed), 2.0)
    poses = np.random.default_rng(seed).uniform([0.0, 0.0, -3.0], [8.0, 7.0, 3.0], (4, 3))
    expected = [loss_in_plain_words(placed, pose) for pose in poses]
    np.testing.assert_allclose(total_loss(residuals_at(placed, poses)), expected, rtol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_the_minimum_is_the_one_that_a_global_optimiser_finds(seed: int) -> None:
    def blocked(_: float, anchor_id: int, rng: np.random.Generator) -> float:
        return rng.exponential(0.8) if anchor_id == 2 else 0.0

    placed, _ = placed_by(Robot(ROOM, seed, blocked), 4.0)
    found = find_pose(placed, BIAS_SIGMA)
    assert found is not None

    def loss(pose: FloatArray) -> float:
        return float(total_loss(residuals_at(placed, pose[None]))[0])

    reference = differential_evolution(
        loss,
        Bounds(np.array([-4.0, -4.0, -np.pi]), np.array([12.0, 11.0, np.pi])),
        rng=np.random.default_rng(seed),
        maxiter=150,
        tol=1e-8,
    )
    assert found.loss <= reference.fun + 0.01
    np.testing.assert_allclose(pose_error(found.pose, np.array(reference.x)), 0.0, atol=5e-3)


def biased(biases: dict[int, float], _: float, anchor_id: int, __: np.random.Generator) -> float:
    """What all ranges of an anchor err by."""
    return biases[anchor_id]


def test_pose_is_consistent_over_noise_drift_and_biases() -> None:
    rng = np.random.default_rng(1)
    runs, nees = 120, []
    for seed in range(runs):
        biases = dict(zip(ROOM.anchors, rng.normal(0.0, BIAS_SIGMA, 4).tolist(), strict=True))
        placed, keyframe = placed_by(Robot(ROOM, seed, partial(biased, biases)), 4.0)
        found = find_pose(placed, BIAS_SIGMA)
        assert found is not None
        error = pose_error(found.pose, keyframe)
        nees.append(error @ np.linalg.solve(found.cov, error))
    low, high = float(chi2.ppf(0.005, 3 * runs)), float(chi2.ppf(0.995, 3 * runs))
    assert low < sum(nees) < high, f"mean NEES {np.mean(nees):.2f}, expected 3"


def test_odometry_that_drifts_widens_the_covariance() -> None:
    placed, _ = placed_by(Robot(ROOM, 2), 4.0)
    sure = find_pose(placed, BIAS_SIGMA)
    drifting = PlacedRanges(
        placed.tags,
        placed.anchors,
        placed.anchor_ids,
        placed.ranges,
        placed.sigmas,
        placed.steps,
        placed.step_poses,
        placed.step_ends,
        100.0 * placed.step_covs,
    )
    unsure = find_pose(drifting, BIAS_SIGMA)
    assert sure is not None
    assert unsure is not None
    np.testing.assert_array_equal(sure.pose, unsure.pose)
    assert (np.diag(unsure.cov) > 1.3 * np.diag(sure.cov)).all()


def test_drift_moves_the_found_pose_as_much_as_the_covariance_says() -> None:
    # One step of the odometry is shifted: the pose follows by what linear propagation gives.
    placed, _ = placed_by(Robot(ROOM, 3, clear), 4.0)
    found = find_pose(placed, 0.0)
    without = find_pose(replace(placed, step_covs=np.zeros_like(placed.step_covs)), 0.0)
    assert found is not None
    assert without is not None
    k, size = 3, 1e-3
    for axis in range(3):
        covs = np.zeros_like(placed.step_covs)
        covs[k, axis, axis] = size**2
        told = find_pose(replace(placed, step_covs=covs), 0.0)
        assert told is not None
        shifts = np.sqrt(np.maximum(np.diag(told.cov) - np.diag(without.cov), 0.0))
        really = find_pose(_with_step_off(placed, k, axis, size), 0.0)
        assert really is not None
        np.testing.assert_allclose(np.abs(pose_error(really.pose, found.pose)), shifts, atol=0.25 * size)


def _with_step_off(placed: PlacedRanges, k: int, axis: int, size: float) -> PlacedRanges:
    """All tags behind step k where they were if the step had come out longer by `size` along an axis."""
    begin, end = placed.step_poses[k], placed.step_ends[k]
    older = placed.steps > k
    tags = placed.tags.copy()
    if axis == 2:
        tags[older] = transform(np.array([0.0, 0.0, -size]), tags[older] - end) + end
    else:
        unit = np.eye(2)[axis]
        tags[older] -= size * transform(np.array([0.0, 0.0, begin[2]]), unit[None])
    return replace(placed, tags=tags)


def test_share_of_ranges_too_short_is_none_at_the_right_pose_and_many_at_a_wrong_one() -> None:
    placed, keyframe = placed_by(Robot(ROOM, 4, lambda _, i, __: 1.0 if i == 1 else 0.0), 4.0)
    wrong = keyframe + np.array([1.0, 0.0, 0.0])
    assert too_short(residuals_at(placed, keyframe[None])) < 0.02
    assert too_short(residuals_at(placed, wrong[None])) > 0.2


def test_ranges_of_one_anchor_give_no_pose() -> None:
    placed, _ = placed_by(Robot(ROOM, 4), 4.0)
    assert find_pose(placed.some(np.flatnonzero(placed.anchor_ids == 1)), BIAS_SIGMA) is None
