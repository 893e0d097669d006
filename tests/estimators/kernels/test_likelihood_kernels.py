"""Kernels of weights and gates against plain NumPy."""

import numpy as np
import pytest

from estimators.kernels import likelihood
from tests.estimators.kernels.clouds import ARM, LANDMARKS, RANGES, predicted, random_cloud, sigmas

SEEDS = pytest.mark.parametrize("seed", range(3))


@SEEDS
def test_residuals_and_misfits_are_those_of_numpy(seed: int) -> None:
    particles, _ = random_cloud(seed)
    expected = predicted(particles, RANGES, LANDMARKS)
    np.testing.assert_allclose(
        likelihood.residuals(particles, ARM, RANGES, LANDMARKS), expected, rtol=1e-9, atol=1e-9
    )
    misfits = 0.5 * ((expected / sigmas(RANGES, LANDMARKS)) ** 2).sum(axis=1)
    np.testing.assert_allclose(likelihood.misfits(particles, ARM, RANGES, LANDMARKS), misfits, rtol=1e-9)


@SEEDS
def test_residuals_are_expected_as_numpy_expects_them(seed: int) -> None:
    particles, weights = random_cloud(seed)
    values = predicted(particles, RANGES, LANDMARKS)[:, : len(RANGES)]
    mean, cov = likelihood.expected_residuals(particles, weights, ARM, RANGES)
    np.testing.assert_allclose(mean, weights @ values, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(cov, np.cov(values.T, aweights=weights, ddof=0), rtol=1e-8, atol=1e-9)


@SEEDS
def test_landmarks_are_gated_by_a_kalman_filters_sequential_update(seed: int) -> None:
    particles, weights = random_cloud(seed)
    values = predicted(particles, RANGES, LANDMARKS)[:, len(RANGES) :]
    spreads = sigmas(RANGES, LANDMARKS)[len(RANGES) :]
    count = len(spreads)
    mean = weights @ values
    cov = (weights * (values - mean).T) @ (values - mean) + np.diag(spreads**2)
    gate, taken = 9.0, list[int]()
    nis = np.empty(count)
    for j in range(count):
        gain = cov[j, taken] @ np.linalg.inv(cov[np.ix_(taken, taken)]) if taken else np.zeros(0)
        nis[j] = (mean[j] - gain @ mean[taken]) ** 2 / (cov[j, j] - gain @ cov[taken, j])
        if nis[j] <= gate:
            taken.append(j)
    landmarks = LANDMARKS.copy()
    found, misfits = likelihood.gated_misfits(particles, weights, landmarks, gate)
    np.testing.assert_allclose(found, nis, rtol=1e-8)
    passed = nis <= gate
    for k, row in enumerate(landmarks):
        assert np.isfinite(row[4:]).all() == (passed[2 * k] and passed[2 * k + 1])
    used = sigmas(np.empty((0, 4)), landmarks)
    np.testing.assert_allclose(misfits, 0.5 * ((values / used) ** 2).sum(axis=1), rtol=1e-9)


def test_a_landmark_whose_bearing_fails_loses_its_range_too() -> None:
    particles, weights = random_cloud(0)
    landmarks = LANDMARKS[:1].copy()
    landmarks[0, 3] += 2.0
    nis, misfits = likelihood.gated_misfits(particles, weights, landmarks, 16.0)
    assert nis[0] < 16.0 < nis[1]
    assert np.isinf(landmarks[0, 4:]).all()
    np.testing.assert_array_equal(misfits, 0.0)


@SEEDS
def test_whole_likelihoods_multiply_the_weights(seed: int) -> None:
    _, weights = random_cloud(seed)
    misfits = np.random.default_rng(seed).exponential(size=60)
    expected = weights * np.exp(-misfits)
    assert likelihood.temper(weights, misfits, 1.0, 1.0) == 1.0
    np.testing.assert_allclose(weights, expected / expected.sum(), rtol=1e-9)
    assert weights.sum() == pytest.approx(1.0, abs=1e-12)


def test_a_sharp_likelihood_is_taken_as_far_as_enough_particles_are_left() -> None:
    weights = np.full(60, 1 / 60)
    misfits = 1000.0 * np.random.default_rng(0).random(60)
    before = weights.copy()
    power = likelihood.temper(weights, misfits, 1.0, 30.0)
    expected = before * np.exp(-power * misfits)
    np.testing.assert_allclose(weights, expected / expected.sum(), rtol=1e-9)
    # Ten halvings find the power to a thousandth of what was asked for; here that is below the least.
    assert power == pytest.approx(0.01)
    power = likelihood.temper(before, misfits / 100.0, 1.0, 30.0)
    assert 1.0 / (before @ before) == pytest.approx(30.0, rel=0.02)
    assert 0.01 < power < 1.0


def test_huge_misfits_leave_weights_that_sum_to_one() -> None:
    weights = np.full(60, 1 / 60)
    likelihood.temper(weights, 1e8 * np.arange(60.0), 1.0, 0.0)
    assert weights[0] == pytest.approx(1.0)
    likelihood.temper(weights, 1e8 * np.arange(60.0)[::-1], 1.0, 0.0)
    assert np.isfinite(weights).all()
    assert weights.sum() == pytest.approx(1.0)
