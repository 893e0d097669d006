"""Points of a scan and the prior on its motion, against plain NumPy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from estimators.geometry import between, inverse, transform, transform_each, wrap_angles
from estimators.kernels.scan_motion import LEAST_HESSIAN, bent, prior_on_states
from estimators.kernels.scan_points import ends_of_beams, extent, returns, seen_from_end
from estimators.lidar.line_map import surface
from estimators.models.motion import cubic_between, smooth_motion

SEEDS = range(4)
MOUNTING = np.array([0.2, -0.1, 0.7])


@given(
    st.lists(
        st.sampled_from([0.0, -1.0, 0.05, 0.5, 3.0, 7.0, 30.0, np.nan, np.inf]), min_size=1, max_size=60
    ),
    st.lists(st.integers(0, 59), max_size=3),
    st.sampled_from([1, 7, 20, 100]),
    st.sampled_from([0.0, 0.02, 0.3]),
)
def test_returns_are_those_that_numpy_picks(
    ranges: list[float], bad: list[int], most: int, spacing: float
) -> None:
    count = len(ranges)
    angles, distances = np.linspace(3.0, 3.0 + 2.0 * np.pi, count) % (2.0 * np.pi), np.array(ranges)
    angles[[i for i in bad if i < count]] = np.nan
    times = np.linspace(0.0, 0.1, count)
    points, since_end, apart = returns(angles, distances, times, MOUNTING, 0.1, 20.0, most, spacing)

    kept = np.flatnonzero((distances >= 0.1) & (distances <= 20.0) & np.isfinite(angles))
    kept = kept[:: -(-len(kept) // most) or 1]
    angles, distances = angles[kept], distances[kept]
    polar = np.column_stack([distances * np.cos(angles), distances * np.sin(angles)])
    assert_allclose(points, transform(MOUNTING, polar), atol=1e-12)
    assert_array_equal(since_end, times[kept] - times[-1])
    if spacing == 0.0:
        assert apart.all()
    else:
        way = np.cumsum(np.abs(wrap_angles(np.diff(angles, prepend=angles[:1]))) * distances)
        assert_array_equal(apart, np.diff(np.floor(way / spacing), prepend=-1.0) > 0.0)


@pytest.mark.parametrize("seed", SEEDS)
def test_extent_is_that_of_the_points_and_of_the_angles_at_which_walls_are_met(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, angles = 4.0 * rng.standard_normal((30, 2)), rng.uniform(0.0, np.pi, 30)
    normals, scanner = np.column_stack([np.cos(angles), np.sin(angles)]), np.array([0.3, -0.2])
    distances, beams = np.linalg.norm(points, axis=1), points - scanner
    cosines = (beams * normals).sum(axis=1) / np.linalg.norm(beams, axis=1)
    expected = distances.mean(), distances.max(), np.sqrt((cosines**2).mean())
    assert_allclose(extent(points, normals, scanner), expected, rtol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_points_are_seen_from_where_the_body_is_at_the_end(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, states = 4.0 * rng.standard_normal((30, 2)), rng.standard_normal(12)
    basis = cubic_between(np.linspace(0.0, 1.0, 30), 0.1)
    there = transform_each(basis @ states.reshape(4, 3), points)
    assert_allclose(seen_from_end(points, basis, states), transform(inverse(states[6:9]), there), atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_ends_of_beams_are_seen_from_the_last_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angles, ranges = np.sort(rng.uniform(-3.0, 3.0, 40)), rng.uniform(0.5, 8.0, 40)
    ranges[::7], ranges[1], ranges[2], ranges[3] = 0.0, np.nan, np.inf, -1.0
    times = np.linspace(0.0, 0.1, 40)
    moved = between(np.array([1.0, 2.0, 0.3]), np.array([1.1, 1.9, 0.2]))
    good = np.isfinite(ranges) & (ranges > 0.0)
    polar = ranges[good, None] * np.column_stack([np.cos(angles[good]), np.sin(angles[good])])
    expected = transform_each((1.0 - times[good] / 0.1)[:, None] * moved, polar)
    assert_allclose(ends_of_beams(angles, ranges, times, moved), expected, atol=1e-12)


def test_lines_that_are_asked_for_are_as_they_are_among_all() -> None:
    rng = np.random.default_rng(0)
    angles = np.linspace(-1.2, 1.2, 200)
    points = np.column_stack([np.full(200, 2.0), 2.0 * np.tan(angles)]) + 0.01 * rng.standard_normal((200, 2))
    every, wanted = surface(points, 0.01), rng.uniform(size=200) < 0.4
    some, chosen = surface(points, 0.01, wanted), wanted[every.own]
    assert 20 < chosen.sum() < len(chosen)
    for name in ("lines", "spans", "own", "points", "normals"):
        assert_array_equal(getattr(some, name), getattr(every, name)[chosen])


@pytest.mark.parametrize("seed", SEEDS)
def test_prior_on_both_states_is_the_inverse_of_their_joint_covariance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    F, Q = smooth_motion(0.1, 0.5, 1.5, 2.0)
    half, state = rng.standard_normal((6, 9)), rng.standard_normal(6)
    cov = half @ half.T
    prior, predicted, sigmas = prior_on_states(F, Q, state, cov)
    joint = np.block([[cov, cov @ F.T], [F @ cov, F @ cov @ F.T + Q]])
    assert_allclose(prior @ joint, np.eye(12), atol=1e-6)
    assert_allclose(predicted, np.concatenate([state, F @ state]))
    assert_allclose(sigmas, np.sqrt(np.diag(joint)[6:9]))


@pytest.mark.parametrize("seed", SEEDS)
def test_a_mode_of_motion_bends_a_scan_by_what_least_squares_makes_of_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows, index = rng.standard_normal((40, 6)), rng.integers(-1, 5, 40)
    shares, modes = rng.uniform(-0.1, 1.1, 40), rng.standard_normal((9, 3))
    half = rng.standard_normal((3, 5))
    deviation, expected = half @ half.T, np.zeros((3, 3))
    kept = index >= 0
    by_end = shares[kept, None] * rows[kept, 1:4]
    for column in modes.T:
        mode = np.interp(shares, np.linspace(0.0, 1.0, 9), column)
        # The distances change by the mode times the derivative; the pose at the end takes up what it can.
        moved = np.linalg.solve(
            by_end.T @ by_end + LEAST_HESSIAN * np.eye(3), by_end.T @ (mode[kept, None] * rows[kept, 1:4])
        )
        expected += moved @ deviation @ moved.T
    assert_allclose(bent(modes, shares, rows, index, deviation), expected, rtol=1e-9)
