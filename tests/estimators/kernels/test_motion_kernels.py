"""Kernels of the motion against plain NumPy."""

import numpy as np
import pytest

from estimators.geometry import wrap_angle
from estimators.kernels import cloud, motion
from estimators.messages import FloatArray
from estimators.models.motion import constant_velocity, increment
from tests.estimators.kernels.clouds import deviations, law, random_cloud, wrapped

SEEDS = pytest.mark.parametrize("seed", range(3))
EVEN = np.full(4000, 1 / 4000)
COV = np.array([[4e-4, 1e-4, 0.0], [1e-4, 3e-4, 5e-5], [0.0, 5e-5, 1e-4]])


def in_keyframe(particles: FloatArray) -> FloatArray:
    """Motion since the keyframe and velocity (N, 6), in the keyframe's frame."""
    turn = np.exp(-1j * particles[:, 8])
    step = ((particles[:, 0] - particles[:, 6]) + 1j * (particles[:, 1] - particles[:, 7])) * turn
    speed = (particles[:, 3] + 1j * particles[:, 4]) * turn
    turned = wrapped(particles[:, 2] - particles[:, 8])
    return np.column_stack([step.real, step.imag, turned, speed.real, speed.imag, particles[:, 5]])


@SEEDS
def test_move_is_that_of_numpy(seed: int) -> None:
    particles, weights = random_cloud(seed)
    noise = np.random.default_rng(seed).normal(size=(60, 3))
    expected, matched = particles.copy(), noise.copy()
    cloud.match(matched, expected, weights)
    change = np.array([0.5, 0.5, 1.5]) * np.sqrt(0.2) * matched
    expected[:, :3] += 0.2 * (expected[:, 3:6] + change / np.sqrt(3))
    expected[:, 3:6] += change
    motion.move(particles, weights, noise, 0.2, 0.5, 1.5)
    np.testing.assert_allclose(
        deviations(particles, expected[0]), deviations(expected, expected[0]), rtol=1e-9, atol=1e-9
    )


def test_moving_adds_the_variances_of_constant_velocity() -> None:
    particles = np.zeros((4000, 9))
    noise = np.random.default_rng(0).normal(size=(4000, 3))
    motion.move(particles, EVEN, noise, 0.3, 0.5, 1.5)
    _, Q = constant_velocity(0.3, 0.5, 1.5)
    np.testing.assert_allclose(np.diag(law(particles, EVEN)[1])[:6], np.diag(Q), rtol=1e-9)


@SEEDS
def test_an_increment_is_taken_as_numpy_does(seed: int) -> None:
    particles, weights = random_cloud(seed)
    noise = np.random.default_rng(seed).normal(size=(60, 3))
    matched = noise.copy()
    cloud.match(matched, particles, weights)
    before = in_keyframe(particles)
    increment = weights @ before[:, :3] + [0.02, -0.01, 0.03]
    centred = before - weights @ before
    joint = (weights * centred.T) @ centred[:, :3]
    S = joint[:3] + COV
    innovation = increment + matched @ np.linalg.cholesky(COV).T - before[:, :3]
    expected = before + innovation @ np.linalg.solve(S, joint.T)
    mean = increment - weights @ before[:, :3]
    keyframes = particles[:, 6:].copy()
    nis = motion.take_increment(particles, weights, noise, increment, COV, 1e9)
    assert nis == pytest.approx(mean @ np.linalg.solve(S, mean), rel=1e-9)
    np.testing.assert_allclose(in_keyframe(particles), expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(particles[:, 6:], keyframes)


def test_a_gated_increment_changes_nothing() -> None:
    particles, weights = random_cloud(0)
    before = particles.copy()
    far = np.array([50.0, 0.0, 0.0])
    nis = motion.take_increment(particles, weights, np.ones((60, 3)), far, COV, 20.0)
    assert nis > 20.0
    np.testing.assert_array_equal(particles, before)


def test_a_near_perfect_increment_puts_every_particle_there() -> None:
    particles, weights = random_cloud(2)
    noise = np.random.default_rng(0).normal(size=(60, 3))
    increment = np.array([0.3, -0.1, 0.2])
    motion.take_increment(particles, weights, noise, increment, 1e-14 * np.eye(3), np.inf)
    np.testing.assert_allclose(in_keyframe(particles)[:, :3], np.tile(increment, (60, 1)), atol=1e-6)


@SEEDS
@pytest.mark.parametrize("dt", [0.3, -0.2, 0.0])
@pytest.mark.parametrize("size", [6, 9])
def test_a_state_is_predicted_as_by_the_model(seed: int, dt: float, size: int) -> None:
    rng = np.random.default_rng(seed)
    mean, factor = rng.normal(size=size), rng.normal(size=(size, size))
    F, Q = np.eye(size), np.zeros((size, size))
    F[:6, :6], Q[:6, :6] = constant_velocity(dt, 0.5, 1.5)
    before = factor @ factor.T
    found, cov = motion.predicted(mean, before, dt, 0.5, 1.5)
    np.testing.assert_allclose(found, F @ mean, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(cov, F @ before @ F.T + Q, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(cov, cov.T)
    np.testing.assert_array_equal(before, factor @ factor.T)


@SEEDS
def test_nis_of_an_increment_is_that_of_its_model(seed: int) -> None:
    rng = np.random.default_rng(seed)
    reference, pose = rng.uniform(-3.0, 3.0, size=(2, 3))
    root = rng.normal(size=(9, 9))
    cov = root @ root.T
    predicted, by_reference, by_pose = increment(reference, pose)
    measured = predicted + np.array([0.3, -0.2, 6.0])
    H = np.hstack([by_pose, np.zeros((3, 3)), by_reference])
    residual = measured - predicted
    residual[2] = wrap_angle(residual[2])
    expected = residual @ np.linalg.solve(H @ cov @ H.T + COV, residual)
    assert motion.increment_nis(reference, pose, cov, measured, COV) == pytest.approx(expected, rel=1e-9)
