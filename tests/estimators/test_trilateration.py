"""Position from ranges, against the truth, scipy's least squares and Monte Carlo."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from estimators.messages import FloatArray
from estimators.trilateration import AnchorGeometryError, check_anchor_geometry, trilaterate

inside = st.tuples(st.floats(0.0, 10.0), st.floats(0.0, 8.0))


def ranges_to(anchors: FloatArray, position: FloatArray) -> FloatArray:
    distances: FloatArray = np.linalg.norm(position - anchors, axis=1)
    return distances


def spread_across(anchors: FloatArray) -> float:
    """Root-sum-square distance of the anchors from their best line [m]."""
    return float(np.linalg.svd(anchors - anchors.mean(axis=0))[1][1])


def layout(rng: np.random.Generator, count: int) -> FloatArray:
    """Anchors spread over a hall of 10 m by 8 m, not nearly in line."""
    while True:
        anchors = rng.uniform([0.0, 0.0], [10.0, 8.0], (count, 2))
        if spread_across(anchors) > 3.0:
            return anchors


@given(st.lists(inside, min_size=3, max_size=8), inside, st.floats(0.01, 1.0))
def test_noiseless_ranges_give_the_exact_position(
    plan: list[tuple[float, float]], place: tuple[float, float], sigma: float
) -> None:
    anchors, position = np.array(plan), np.array(place)
    ranges = ranges_to(anchors, position)
    assume(spread_across(anchors) > 1.0)
    assume(ranges.min() > 0.05)
    fix = trilaterate(anchors, ranges, np.full(len(anchors), sigma))
    np.testing.assert_allclose(fix.position, position, atol=1e-6)
    np.testing.assert_allclose(fix.residuals, 0.0, atol=1e-6)


@pytest.mark.parametrize("count", range(3, 9))
def test_noisy_ranges_give_the_optimum_that_scipy_finds(count: int) -> None:
    for seed in range(15):
        rng = np.random.default_rng(seed)
        anchors = layout(rng, count)
        position = anchors.mean(axis=0) + rng.uniform(-1.5, 1.5, 2)
        sigmas = rng.uniform(0.05, 0.2, count)
        ranges = ranges_to(anchors, position) + rng.normal(0.0, sigmas)

        def weighted(
            p: FloatArray, anchors: FloatArray = anchors, r: FloatArray = ranges, s: FloatArray = sigmas
        ) -> FloatArray:
            return (ranges_to(anchors, p) - r) / s

        reference = least_squares(weighted, position, xtol=1e-12, ftol=1e-12, gtol=1e-12)
        fix = trilaterate(anchors, ranges, sigmas)
        np.testing.assert_allclose(fix.position, reference.x, atol=1e-4, err_msg=f"seed {seed}")
        jacobian = np.asarray(reference.jac, dtype=np.float64)
        np.testing.assert_allclose(fix.cov, np.linalg.inv(jacobian.T @ jacobian), rtol=1e-2, atol=1e-6)
        np.testing.assert_allclose(fix.residuals, ranges - ranges_to(anchors, fix.position), atol=1e-12)


@pytest.mark.parametrize("excess", [3.0, 8.0, 15.0])
@pytest.mark.parametrize("count", [3, 4, 6])
def test_a_blocked_range_does_not_throw_the_position_away(count: int, excess: float) -> None:
    for seed in range(100):
        rng = np.random.default_rng(seed)
        anchors = layout(rng, count)
        ranges = ranges_to(anchors, anchors.mean(axis=0) + rng.uniform(-1.5, 1.5, 2))
        ranges[rng.integers(count)] += excess
        fix = trilaterate(anchors, ranges, np.full(count, 0.1))
        # A minimum: no step of a millimetre improves on it. Not always the least one: there may be two.
        cost = float(fix.residuals @ fix.residuals)
        for step in ([1e-3, 0.0], [-1e-3, 0.0], [0.0, 1e-3], [0.0, -1e-3]):
            moved = ranges - ranges_to(anchors, fix.position + step)
            assert cost <= float(moved @ moved) * (1.0 + 1e-6), f"seed {seed}"
        assert np.linalg.norm(fix.position - anchors.mean(axis=0)) < 30.0


@pytest.mark.parametrize("count", [3, 5])
def test_covariance_agrees_with_monte_carlo(count: int) -> None:
    rng = np.random.default_rng(0)
    anchors = layout(rng, count)
    position, sigmas = anchors.mean(axis=0), np.linspace(0.04, 0.08, count)
    clean = ranges_to(anchors, position)
    trials = 2000
    errors = np.array(
        [
            trilaterate(anchors, clean + rng.normal(0.0, sigmas), sigmas).position - position
            for _ in range(trials)
        ]
    )
    cov = trilaterate(anchors, clean, sigmas).cov
    # Whitened, the sample covariance is the identity to within 4 standard errors of its entries.
    whitened = np.linalg.solve(np.linalg.cholesky(cov), errors.T)
    np.testing.assert_allclose(whitened @ whitened.T / trials, np.eye(2), atol=4 * np.sqrt(2 / trials))


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_anchors_are_refused_by_number(count: int) -> None:
    anchors = np.array([[0.0, 0.0], [5.0, 1.0]])[:count]
    with pytest.raises(AnchorGeometryError, match=rf"^{count} anchors given.*at least 3"):
        trilaterate(anchors, np.full(count, 2.0), np.full(count, 0.1))


@given(
    st.lists(st.floats(-20.0, 20.0), min_size=3, max_size=8),
    st.floats(-np.pi, np.pi),
    inside,
    st.floats(0.0, 0.04),
)
def test_anchors_in_line_are_refused_by_number(
    along: list[float], direction: float, origin: tuple[float, float], across: float
) -> None:
    side = across * (-1.0) ** np.arange(len(along))
    turned = (np.array(along) + 1j * side) * np.exp(1j * direction)
    anchors = np.array(origin) + np.column_stack([turned.real, turned.imag])
    count = len(anchors)
    with pytest.raises(AnchorGeometryError, match=rf"all {count} anchors lie within 0\.\d\d m of one line"):
        trilaterate(anchors, np.full(count, 3.0), np.full(count, 0.1))


def test_an_anchor_given_twice_counts_once() -> None:
    anchors = np.array([[0.0, 0.0], [5.0, 1.0], [5.0, 1.0]])
    with pytest.raises(AnchorGeometryError, match="all 3 anchors"):
        trilaterate(anchors, np.full(3, 3.0), np.full(3, 0.1))


def test_height_does_not_bring_anchors_out_of_line() -> None:
    anchors = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 3.0], [8.0, 0.0, 1.0]])
    with pytest.raises(AnchorGeometryError, match="all 3 anchors"):
        check_anchor_geometry(anchors)


def test_good_layouts_pass() -> None:
    check_anchor_geometry(np.array([[0.0, 0.0, 2.0], [4.0, 0.0, 2.0], [2.0, 0.5, 2.0]]))
