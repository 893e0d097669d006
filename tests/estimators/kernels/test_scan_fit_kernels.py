"""Nearest lines, sums, what walls hold and the states that fit, against plain NumPy and scipy."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import eigh

from estimators.geometry import transform_each
from estimators.kernels.scan_fit import (
    CONVERGED,
    HELD_RATIO,
    LEAST_MATCHED,
    MOST_ITERATIONS,
    gradient_noise,
    held_directions,
    normal_equations,
)
from estimators.kernels.scan_lines import LEAST_COSINE, associate
from estimators.kernels.scan_motion import newest_information
from estimators.lidar.line_map import LineMap, Surface, surface
from estimators.lidar.scan_fit import LEAST_INFORMATION
from estimators.messages import FloatArray, IntArray
from estimators.models.motion import cubic_between

SIGMA, REACH, FARTHEST = 0.01, 0.4, 8.0
SEEDS = range(4)
ROOM = np.array([(-3, -2), (4, -2), (4, 3), (1, 3), (1, 1.5), (-3, 1.5), (-3, -2)], dtype=np.float64)
CORRIDOR = np.array([(-50, -1), (50, -1), (50, 1), (-50, 1), (-50, -1)], dtype=np.float64)


def walls(rng: np.random.Generator, pose: FloatArray, corners: FloatArray) -> FloatArray:
    """Points (N, 2) of a room seen from a pose (3,), in the order of the beams, with noise."""
    points = []
    for angle in np.linspace(-np.pi, np.pi, 360, endpoint=False) + pose[2]:
        ray, hits = np.array([np.cos(angle), np.sin(angle)]), []
        for a, b in pairwise(corners):
            matrix = np.column_stack([ray, a - b])
            if abs(np.linalg.det(matrix)) > 1e-9:
                distance, share = np.linalg.solve(matrix, a - pose[:2])
                if distance > 0 and 0 <= share <= 1:
                    hits.append(distance)
        if min(hits) < FARTHEST:
            points.append((min(hits) + SIGMA * rng.standard_normal()) * np.array([1.0, 1j]) @ ray)
    along = np.array(points) * np.exp(-1j * pose[2])
    return np.column_stack([along.real, along.imag])


def scan_and_map(seed: int, corners: FloatArray) -> tuple[LineMap, Surface, FloatArray, FloatArray]:
    """A map, surface points of a scan from elsewhere, their basis, and states (12,) near by."""
    rng = np.random.default_rng(seed)
    pose = np.array([0.1, -0.05, 0.04]) * rng.standard_normal(3)
    lines = LineMap(walls(rng, np.zeros(3), corners), SIGMA, REACH)
    found = surface(walls(rng, pose, corners), SIGMA)
    basis = cubic_between(np.linspace(0.0, 1.0, len(found.points)), 0.1)
    states = np.concatenate([pose, np.zeros(3), pose, np.zeros(3)]) + 0.01 * rng.standard_normal(12)
    return lines, found, basis, states


@pytest.mark.parametrize("seed", SEEDS)
def test_the_nearest_line_is_found_whatever_line_a_point_had_before(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lines, found, basis, states = scan_and_map(seed, ROOM)
    states[[0, 6]] += rng.uniform(-1.0, 1.0)
    rows, index = lines.match(found.points, found.normals, basis, states)
    poses = basis @ states.reshape(4, 3)
    points = transform_each(poses, found.points)
    turned = poses * [0.0, 0.0, 1.0]
    normals = transform_each(turned, found.normals)
    feet = lines._lines[:, :2]
    apart = np.linalg.norm(points[:, None] - feet, axis=2)
    apart[np.abs(normals @ lines._lines[:, 2:4].T) <= LEAST_COSINE] = np.inf
    nearest, least = apart.argmin(axis=1), apart.min(axis=1)
    across = ((points - feet[nearest]) * lines._lines[nearest, 2:4]).sum(axis=1)
    along = np.sqrt(np.maximum(least**2 - across**2, 0.0))
    matched = (least < REACH) & (along <= lines._lines[nearest, 5] + 0.5 * np.abs(across))
    assert 0 < matched.sum() < len(points)
    assert_array_equal(index, np.where(matched, nearest, -1))
    assert_allclose(rows[matched, 0], across[matched], atol=1e-12)

    again, guessed = np.empty_like(rows), rng.integers(-1, len(feet), len(points))
    count = associate(
        found.points,
        found.normals,
        basis,
        states,
        lines._lines,
        lines._begin,
        lines._grid,
        lines._columns,
        again,
        guessed,
    )
    assert count == matched.sum()
    assert_array_equal(guessed, index)
    assert_array_equal(again[matched], rows[matched])


def matches(rng: np.random.Generator, count: int = 50) -> tuple[FloatArray, FloatArray, IntArray, FloatArray]:
    """Basis, rows and index as `associate` gives them, some points without a line; lines."""
    angles = rng.uniform(0.0, 2.0 * np.pi, count)
    rows = rng.standard_normal((count, 6))
    rows[:, 0] *= 0.02
    rows[:, 1], rows[:, 2] = np.cos(angles), np.sin(angles)
    rows[:, 3] = rows[:, 2] * rows[:, 4] - rows[:, 1] * rows[:, 5]
    lines = rng.uniform(0.001, 0.01, (20, 6))
    return rng.standard_normal((count, 4)), rows, rng.integers(-1, 20, count), lines


@pytest.mark.parametrize("seed", SEEDS)
def test_sums_are_those_of_weighted_least_squares(seed: int) -> None:
    basis, rows, index, lines = matches(np.random.default_rng(seed))
    found = normal_equations(basis, rows, index, lines, 0.03)
    kept = index >= 0
    r, by_pose = rows[kept, 0], rows[kept, 1:4]
    weights = 1.0 / (1.0 + (r / 0.03) ** 2)
    by_states = (basis[kept, :, None] * by_pose[:, None, :]).reshape(-1, 12)
    # The normal turned by 90 deg, and what that does to the derivative by yaw.
    turned = np.column_stack([-by_pose[:, 1], by_pose[:, 0], (by_pose[:, :2] * rows[kept, 4:6]).sum(axis=1)])
    expected = (
        by_states.T @ (weights[:, None] * by_states),
        by_states.T @ (weights * r),
        by_pose.T @ (weights[:, None] * by_pose),
        turned.T @ ((weights * lines[index[kept], 4])[:, None] * turned),
        weights.sum(),
        (weights * r * r).sum(),
    )
    for got, wanted in zip(map(np.asarray, found), expected, strict=True):
        assert_allclose(got, wanted, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_noise_of_the_maps_points_goes_into_every_line_through_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    _, rows, index, lines = matches(rng)
    first = rng.integers(0, 25, len(lines))
    spans = np.column_stack([first, first + rng.integers(2, 6, len(lines))])
    by_point = np.zeros((31, 3))
    for row, k in zip(rows, index, strict=True):
        if k >= 0:
            begin, end = spans[k]
            by_point[begin : end + 1] += row[1:4] / (1.0 + (row[0] / 0.03) ** 2) / (end + 1 - begin)
    assert_allclose(gradient_noise(rows, index, 0.03, spans, 31), by_point.T @ by_point, rtol=1e-12)


@pytest.mark.parametrize("free", range(4))
@pytest.mark.parametrize("seed", SEEDS)
def test_directions_are_held_that_say_more_than_noise_feigns(seed: int, free: int) -> None:
    rng = np.random.default_rng(seed)
    half = rng.standard_normal((3, 3))
    feigned = half @ half.T + 0.1 * np.eye(3)
    values, vectors = eigh(np.diag([5.0, 3.0, 1.0]), feigned)
    ratios = HELD_RATIO * np.where(np.arange(3) < free, rng.uniform(0.1, 0.9, 3), rng.uniform(1.1, 9.0, 3))
    back = np.linalg.inv(vectors)
    assert values.min() > 0.0
    held = held_directions(np.ascontiguousarray(back.T @ np.diag(ratios) @ back), feigned)
    assert_allclose(held @ vectors[:, :free], 0.0, atol=1e-7)
    assert_allclose(held, held.T, atol=1e-9)
    assert_allclose(held @ held, held, atol=1e-9)
    assert_allclose(np.trace(held), 3 - free, atol=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_information_on_the_newer_pose_is_the_inverse_of_its_covariance(seed: int) -> None:
    half = np.random.default_rng(seed).standard_normal((12, 20))
    information = half @ half.T
    expected = np.linalg.inv(np.linalg.inv(information)[6:9, 6:9])
    assert_allclose(newest_information(information), expected, rtol=1e-9)


def held_in_numpy(pose_hessian: FloatArray, feigned: FloatArray) -> FloatArray:
    values, vectors = eigh(pose_hessian, feigned)
    free, _ = np.linalg.qr(vectors[:, values <= HELD_RATIO])
    held: FloatArray = np.eye(3) - free @ free.T
    return held


@pytest.mark.parametrize("corners", [ROOM, CORRIDOR], ids=["room", "corridor"])
@pytest.mark.parametrize("spread", [0.0, 0.3])
@pytest.mark.parametrize("seed", SEEDS)
def test_a_scan_settles_as_it_does_in_numpy(seed: int, spread: float, corners: FloatArray) -> None:
    lines, found, basis, start = scan_and_map(seed, corners)
    predicted = start + 0.005
    prior = np.diag(np.tile([1e3, 1e3, 1e3, 10.0, 10.0, 10.0], 2))
    fit = lines.settle(found, basis, prior, predicted, start, SIGMA, spread)
    assert fit is not None

    states = start
    for _ in range(MOST_ITERATIONS):
        rows, index = lines.match(found.points, found.normals, basis, states)
        distances = np.sort(np.abs(rows[index >= 0, 0]))
        scale = max(2.0 * SIGMA, 1.5 * distances[len(distances) // 2])
        sums = lines.sums(basis, rows, index, max(scale, spread))
        held = held_in_numpy(sums.pose_hessian, sums.feigned)
        of_all = np.kron(np.eye(4), held)
        variance = max(SIGMA**2, 0.5 * sums.squares / sums.weight)
        information = prior + of_all @ sums.hessian @ of_all / variance
        gradient = of_all @ sums.gradient / variance + prior @ (states - predicted)
        step = of_all @ np.linalg.solve(information, -gradient)
        states = states + step
        if np.abs(step[6:9]).max() < CONVERGED and spread <= scale:
            break
        spread *= 0.5
    assert round(np.trace(held)) == (3 if corners is ROOM else 2)
    gain = np.linalg.pinv(held @ sums.pose_hessian @ held, rcond=1e-7, hermitian=True)
    noise = variance * gain @ lines.gradient_noise(rows, index, scale) @ gain
    assert_allclose(fit.states, states, atol=1e-7)
    assert_allclose(fit.cov, np.linalg.inv(information)[6:, 6:], rtol=1e-5, atol=1e-9)
    assert_allclose(fit.held, held, atol=1e-6)
    assert fit.share == len(distances) / len(index)
    assert_array_equal(fit.index, index)
    assert_allclose(fit.rows[index >= 0], rows[index >= 0], atol=1e-6)
    after = np.linalg.inv(np.linalg.inv(information)[6:9, 6:9])
    said = np.linalg.inv(held @ (after - prior[6:9, 6:9]) @ held + LEAST_INFORMATION * np.eye(3))
    moved = held @ said @ after @ (states - predicted)[6:9]
    assert_allclose(fit.increment, predicted[6:9] + moved, atol=1e-7)
    assert_allclose(fit.increment_cov, said + noise, rtol=1e-5, atol=1e-9)


def test_a_scan_with_hardly_a_line_near_does_not_settle() -> None:
    lines, found, basis, start = scan_and_map(0, ROOM)
    few = slice(0, LEAST_MATCHED - 1)
    thinned = Surface(
        found.lines[few], found.spans[few], found.own[few], found.points[few], found.normals[few]
    )
    assert lines.settle(thinned, basis[few].copy(), np.eye(12), start, start, SIGMA, 0.0) is None
