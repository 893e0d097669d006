"""Search, mode and draw of the posterior against plain NumPy, scipy and our own beetles."""

import numpy as np
import pytest
from scipy.optimize import minimize

from estimators.beetle_antennae import ImprovedBeetleAntennaeSearch
from estimators.kernels import cloud, posterior
from estimators.kernels.posterior import WIDER, Posterior
from estimators.messages import FloatArray
from tests.estimators.kernels.clouds import ARM, LANDMARKS, RANGES, predicted, random_cloud, sigmas

SEEDS = pytest.mark.parametrize("seed", range(3))
TRUE_POSE = np.array([0.25, 0.15, 3.05])


def world(seed: int) -> tuple[Posterior, FloatArray, FloatArray]:
    """Posterior of a random cloud and measurements of `TRUE_POSE` by sharp sensors; the cloud."""
    particles, weights = random_cloud(seed)
    ranges, landmarks = RANGES.copy(), LANDMARKS.copy()
    misses = predicted(TRUE_POSE[None], ranges, landmarks)[0]
    ranges[:, 2] -= misses[:3]
    landmarks[:, 2:4] -= misses[3:].reshape(-1, 2)
    mean, factor, _ = cloud.pose_law(particles, weights)
    return (mean, factor, ARM, ranges, landmarks), particles, weights


def plain_cost(u: FloatArray, law: Posterior) -> float:
    """Negative logarithm of the posterior."""
    mean, factor, _, ranges, landmarks = law
    scaled = predicted((mean + factor @ u)[None], ranges, landmarks)[0] / sigmas(ranges, landmarks)
    return float(0.5 * (u @ u + scaled @ scaled))


def scipy_mode(law: Posterior) -> FloatArray:
    """Mode by a general minimiser."""
    return np.asarray(minimize(plain_cost, np.zeros(3), (law,), method="BFGS", options={"gtol": 1e-7}).x)


@SEEDS
def test_cost_is_that_of_numpy(seed: int) -> None:
    law, _, _ = world(seed)
    for u in np.random.default_rng(seed).normal(size=(5, 3)):
        assert posterior.cost(u, law) == pytest.approx(plain_cost(u, law), rel=1e-9)


@SEEDS
def test_gauss_newton_ends_in_scipys_mode_with_its_information(seed: int) -> None:
    law, _, _ = world(seed)
    u = np.zeros(3)
    for _ in range(8):
        u, root = posterior.gauss_newton(u, law)
    mode = scipy_mode(law)
    np.testing.assert_allclose(u, mode, atol=1e-4)
    nudges = 1e-5 * np.eye(3)
    mean, factor, _, ranges, landmarks = law

    def residuals(at: FloatArray) -> FloatArray:
        misses: FloatArray = predicted((mean + factor @ at)[None], ranges, landmarks)[0]
        return np.asarray(misses / sigmas(ranges, landmarks))

    J = np.array([residuals(u + nudge) - residuals(u - nudge) for nudge in nudges]).T / 2e-5
    np.testing.assert_allclose(root @ root.T, np.eye(3) + J.T @ J, rtol=1e-4, atol=1e-3)


@SEEDS
def test_a_gauss_newton_step_never_leads_upwards(seed: int) -> None:
    law, _, _ = world(seed)
    for u in np.random.default_rng(seed).normal(0.0, 3.0, (20, 3)):
        stepped, _ = posterior.gauss_newton(u, law)
        assert posterior.cost(stepped, law) <= posterior.cost(u, law)


@SEEDS
def test_the_beetles_are_those_of_the_plain_search(seed: int) -> None:
    law, particles, _ = world(seed)
    iterations = 4
    rng = np.random.default_rng(seed)
    mean, factor = law[:2]
    away = particles[:, :3] - mean
    away[:, 2] = np.angle(np.exp(1j * away[:, 2]))
    starts = np.asarray(np.linalg.solve(factor, away.T).T, dtype=np.float64)

    def costs(points: FloatArray) -> FloatArray:
        return np.array([plain_cost(point, law) for point in points])

    plain = ImprovedBeetleAntennaeSearch().search(costs, starts, iterations, rng, np.ones(3))
    uniform = np.random.default_rng(seed).random((iterations, 6 * 60 + 3))
    found = posterior.search(particles, uniform, law)
    np.testing.assert_allclose(found, plain.point, rtol=1e-7, atol=1e-9)


@SEEDS
def test_without_a_move_the_search_gives_the_best_particle(seed: int) -> None:
    law, particles, _ = world(seed)
    mean, factor = law[:2]
    found = posterior.search(particles, np.empty((0, 6 * 60 + 3)), law)
    poses = particles[:, :3]
    away = poses - mean
    away[:, 2] = np.angle(np.exp(1j * away[:, 2]))
    costs = [plain_cost(np.linalg.solve(factor, row), law) for row in away]
    np.testing.assert_allclose(found, np.linalg.solve(factor, away[int(np.argmin(costs))]), atol=1e-9)


@SEEDS
def test_drawn_poses_are_weighted_by_posterior_over_what_they_were_drawn_from(seed: int) -> None:
    law, _, _ = world(seed)
    u, root = posterior.gauss_newton(scipy_mode(law), law)
    normal = np.random.default_rng(seed).normal(size=(40, 3))
    poses, weights, effective = posterior.draw(u, root, normal, law)
    offsets = np.linalg.solve(root.T, normal.T).T
    points = u + WIDER * offsets
    logarithms = np.array([0.5 * row @ row for row in normal]) - [plain_cost(p, law) for p in points]
    expected = np.exp(logarithms - logarithms.max())
    expected /= expected.sum()
    np.testing.assert_allclose(poses, law[0] + points @ law[1].T, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(weights, expected, rtol=1e-7)
    assert effective == pytest.approx(1.0 / (expected @ expected), rel=1e-9)


def test_sampled_particles_have_the_posteriors_mean_and_covariance() -> None:
    law, particles, weights = world(1)
    rng = np.random.default_rng(0)
    many = 20_000
    grown = particles[rng.choice(60, many, p=weights)]
    even = np.full(many, 1.0 / many)
    mean, factor, _ = cloud.pose_law(grown, even)
    law = (mean, factor, *law[2:])
    new, new_weights, effective = posterior.sample(
        grown, even, np.arange(many), *law[2:], rng.random((1, 6 * many + 3)), rng.normal(size=(many, 3))
    )
    # An independent reference: the same posterior by weighting Gaussian draws of its prior.
    u = rng.normal(size=(400_000, 3))
    scaled = predicted(mean + u @ factor.T, law[3], law[4]) / sigmas(law[3], law[4])
    misfits = 0.5 * (scaled**2).sum(axis=1)
    by_prior = np.exp(misfits.min() - misfits)
    by_prior /= by_prior.sum()
    expected = by_prior @ (mean + u @ factor.T)
    centred = (mean + u @ factor.T) - expected
    cov = (by_prior * centred.T) @ centred
    found_mean, found_cov = cloud.moments(new, new_weights, 3)
    assert effective > 0.8 * many
    np.testing.assert_allclose(found_mean, expected, atol=0.1 * float(np.sqrt(np.diag(cov)).min()))
    np.testing.assert_allclose(np.sqrt(np.diag(found_cov)), np.sqrt(np.diag(cov)), rtol=0.05)


def test_a_cloud_without_a_heading_is_not_sampled() -> None:
    law, particles, weights = world(0)
    particles[:, 2] = np.linspace(-3.0, 3.0, 60)
    uniform, normal = np.zeros((1, 363)), np.zeros((60, 3))
    _, _, effective = posterior.sample(particles, weights, np.arange(60), *law[2:], uniform, normal)
    assert effective == 0.0
