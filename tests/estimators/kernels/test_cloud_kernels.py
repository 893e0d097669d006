"""Kernels of the cloud against plain NumPy."""

import numpy as np
import pytest

from estimators.kernels import cloud
from estimators.kernels.cloud import LEAST_VARIANCE
from tests.estimators.kernels.clouds import deviations, law, random_cloud, wrapped

SEEDS = pytest.mark.parametrize("seed", range(3))


@SEEDS
@pytest.mark.parametrize("columns", [3, 6, 9])
def test_moments_are_those_of_numpy(seed: int, columns: int) -> None:
    particles, weights = random_cloud(seed)
    mean, cov = cloud.moments(particles, weights, columns)
    expected_mean, expected_cov = law(particles, weights)
    difference = mean - expected_mean[:columns]
    np.testing.assert_allclose(np.exp(1j * difference), 1.0, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(cov, expected_cov[:columns, :columns], rtol=1e-9, atol=1e-9)


@SEEDS
def test_matched_noise_has_its_moments_exactly_and_hangs_together_with_no_pose(seed: int) -> None:
    particles, weights = random_cloud(seed)
    noise = np.random.default_rng(seed).normal(size=(60, 3)) + 0.3
    cloud.match(noise, particles, weights)
    np.testing.assert_allclose(weights @ noise, 0.0, atol=1e-12)
    np.testing.assert_allclose((weights * noise.T) @ noise, np.eye(3), atol=1e-12)
    poses = deviations(particles, particles[0])[:, :3]
    np.testing.assert_allclose((weights * noise.T) @ (poses - weights @ poses), 0.0, atol=1e-12)


def test_noise_beside_hardly_any_weighted_particle_stays_as_it_is() -> None:
    particles, _ = random_cloud(0)
    weights = np.zeros(60)
    weights[:4] = 0.25
    noise = np.random.default_rng(0).normal(size=(60, 3))
    before = noise.copy()
    cloud.match(noise, particles, weights)
    np.testing.assert_array_equal(noise, before)


@SEEDS
def test_pose_law_is_that_of_numpy(seed: int) -> None:
    particles, weights = random_cloud(seed)
    mean, factor, gain = cloud.pose_law(particles, weights)
    expected_mean, cov = law(particles, weights)
    pose_cov = cov[:3, :3] * (1 + 1e-9 * np.eye(3)) + LEAST_VARIANCE * np.eye(3)
    np.testing.assert_allclose(np.exp(1j * (mean - expected_mean[:3])), 1.0, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(factor, np.linalg.cholesky(pose_cov), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(gain, cov[3:, :3] @ np.linalg.inv(pose_cov), rtol=1e-7, atol=1e-9)


def test_a_cloud_that_is_one_point_has_a_law() -> None:
    particles = np.tile(random_cloud(0)[0][:1], (20, 1))
    _, factor, gain = cloud.pose_law(particles, np.full(20, 0.05))
    np.testing.assert_allclose(factor, np.sqrt(LEAST_VARIANCE) * np.eye(3), rtol=1e-6, atol=1e-12)
    assert np.isfinite(gain).all()


@SEEDS
def test_put_moves_poses_and_all_else_by_the_regression(seed: int) -> None:
    particles, weights = random_cloud(seed)
    _, _, gain = cloud.pose_law(particles, weights)
    poses = particles[:, :3] + np.random.default_rng(seed).normal(0.0, 0.2, (60, 3))
    expected = particles.copy()
    expected[:, 3:] += (poses - particles[:, :3]) @ gain.T
    expected[:, :3] = poses
    cloud.put(particles, poses, gain)
    np.testing.assert_allclose(
        deviations(particles, expected[0]), deviations(expected, expected[0]), rtol=1e-9, atol=1e-9
    )
    assert (np.abs(particles[:, [2, 8]]) <= np.pi).all()


@SEEDS
def test_resampled_particles_are_the_shrunk_and_spread_ones_of_numpy(seed: int) -> None:
    particles, weights = random_cloud(seed)
    rng = np.random.default_rng(seed)
    kept = np.sort(rng.choice(60, 60, p=weights)).astype(np.int64)
    noise = rng.normal(size=(60, 3))
    new = cloud.resampled(particles, weights, kept, noise.copy(), 0.4)
    mean, factor, gain = cloud.pose_law(particles, weights)
    expected = particles[kept]
    cloud.match(noise, expected, np.full(60, 1 / 60))
    away = expected[:, :3] - mean
    away[:, 2] = wrapped(away[:, 2])
    cloud.put(expected, mean + np.sqrt(1 - 0.4**2) * away + 0.4 * noise @ factor.T, gain)
    np.testing.assert_allclose(
        deviations(new, expected[0]), deviations(expected, expected[0]), rtol=1e-9, atol=1e-9
    )


def test_resampling_by_equal_weights_keeps_mean_and_covariance_of_the_pose() -> None:
    particles, _ = random_cloud(1)
    weights = np.full(60, 1 / 60)
    noise = np.random.default_rng(1).normal(size=(60, 3))
    new = cloud.resampled(particles, weights, np.arange(60), noise, 0.5)
    (mean, cov), (new_mean, new_cov) = law(particles, weights), law(new, weights)
    np.testing.assert_allclose(new_mean[:3], mean[:3], atol=1e-9)
    np.testing.assert_allclose(new_cov[:3, :3], cov[:3, :3], atol=1e-9)
