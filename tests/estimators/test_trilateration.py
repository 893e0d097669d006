"""Position from ranges, against the truth, scipy's least squares and Monte Carlo."""

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from estimators.messages import FloatArray
from estimators.trilateration import (
    AnchorGeometryError,
    check_anchor_geometry,
    circle_intersections,
    trilaterate,
)

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
    fix = trilaterate(anchors, ranges, np.full(len(anchors), sigma))[0]
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
        (fix,) = trilaterate(anchors, ranges, sigmas)
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
        fix = trilaterate(anchors, ranges, np.full(count, 0.1))[0]
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
            trilaterate(anchors, clean + rng.normal(0.0, sigmas), sigmas)[0].position - position
            for _ in range(trials)
        ]
    )
    cov = trilaterate(anchors, clean, sigmas)[0].cov
    # Whitened, the sample covariance is the identity to within 4 standard errors of its entries.
    whitened = np.linalg.solve(np.linalg.cholesky(cov), errors.T)
    np.testing.assert_allclose(whitened @ whitened.T / trials, np.eye(2), atol=4 * np.sqrt(2 / trials))


@pytest.mark.parametrize("count", [0, 1, 2])
def test_a_layout_of_fewer_than_three_anchors_is_refused_by_number(count: int) -> None:
    with pytest.raises(AnchorGeometryError, match=rf"^{count} anchors given.*at least 3"):
        check_anchor_geometry(np.array([[0.0, 0.0], [5.0, 1.0]])[:count])


@given(
    st.lists(st.floats(-20.0, 20.0), min_size=3, max_size=8),
    st.floats(-np.pi, np.pi),
    inside,
    st.floats(0.0, 0.04),
)
def test_a_layout_in_line_is_refused_by_number(
    along: list[float], direction: float, origin: tuple[float, float], across: float
) -> None:
    side = across * (-1.0) ** np.arange(len(along))
    turned = (np.array(along) + 1j * side) * np.exp(1j * direction)
    anchors = np.array(origin) + np.column_stack([turned.real, turned.imag])
    count = len(anchors)
    with pytest.raises(AnchorGeometryError, match=rf"all {count} anchors lie within 0\.\d\d m of one line"):
        check_anchor_geometry(anchors)


@pytest.mark.parametrize("anchors", [[], [[3.0, 1.0]], [[5.0, 1.0], [5.0, 1.0], [5.0, 1.02]]])
def test_anchors_on_one_spot_give_no_position(anchors: list[list[float]]) -> None:
    count = len(anchors)
    with pytest.raises(AnchorGeometryError, match=f"{count} anchors on one spot"):
        trilaterate(np.array(anchors).reshape(-1, 2), np.full(count, 3.0), np.full(count, 0.1))


def mirrored(point: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """The point on the other side of a line through two others, in complex numbers."""
    p, a, b = (complex(*each) for each in (point, first, second))
    image = a + (b - a) * np.conj((p - a) / (b - a))
    return np.array([image.real, image.imag])


@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.parametrize("seed", range(8))
def test_anchors_in_line_leave_two_positions_that_scipy_finds_from_either_side(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    direction = rng.uniform(-np.pi, np.pi)
    unit = np.array([np.cos(direction), np.sin(direction)])
    anchors = rng.uniform(0.0, 5.0, 2) + np.linspace(0.0, 6.0, count)[:, None] * unit
    across = np.array([-unit[1], unit[0]])
    place = anchors.mean(axis=0) + rng.uniform(-2.0, 2.0) * unit + rng.uniform(1.0, 4.0) * across
    sigmas = np.full(count, 0.1)
    ranges = ranges_to(anchors, place) + rng.normal(0.0, sigmas)
    fixes = trilaterate(anchors, ranges, sigmas)
    assert len(fixes) == 2

    def weighted(position: FloatArray) -> FloatArray:
        residuals: FloatArray = (ranges_to(anchors, position) - ranges) / sigmas
        return residuals

    for start in (place, mirrored(place, anchors[0], anchors[-1])):
        reference = least_squares(weighted, start)
        assert min(np.linalg.norm(fix.position - reference.x) for fix in fixes) < 1e-4
    for fix in fixes:
        assert np.linalg.eigvalsh(fix.cov)[0] > 0.0


def test_the_position_comes_first_and_alone_once_the_anchors_say_on_which_side_it_is() -> None:
    place = np.array([4.0, 3.0])
    counts = []
    for offset in (0.0, 0.1, 1.0, 4.0):
        anchors = np.array([[0.0, 0.0], [4.0, offset], [8.0, 0.0]])
        fixes = trilaterate(anchors, ranges_to(anchors, place), np.full(3, 0.1))
        counts.append(len(fixes))
        assert min(np.linalg.norm(fix.position - place) for fix in fixes) < 1e-5
        if offset:
            np.testing.assert_allclose(fixes[0].position, place, atol=1e-5)
    assert counts == [2, 2, 1, 1]


@pytest.mark.parametrize("anchors", [[[0.0, 0.0], [8.0, 0.0]], [[0.0, 0.0], [4.0, 0.0], [8.0, 0.0]]])
def test_a_tag_between_anchors_in_line_has_no_covariance_and_so_no_position(
    anchors: list[list[float]],
) -> None:
    plan = np.array(anchors)
    assert trilaterate(plan, ranges_to(plan, np.array([3.0, 0.0])), np.full(len(plan), 0.1)) == ()


@given(inside, inside, st.floats(0.1, 12.0), st.floats(0.1, 12.0))
@example((0.0, 0.0), (0.0, 0.5), 1.0, 0.5)  # one touches the other from within
def test_circles_meet_on_both_or_where_they_come_nearest(
    first: tuple[float, float], second: tuple[float, float], first_range: float, second_range: float
) -> None:
    a, b = np.array(first), np.array(second)
    length = float(np.linalg.norm(b - a))
    assume(length > 0.2)
    places = circle_intersections(a, b, first_range, second_range)
    apart = max(length - first_range - second_range, abs(first_range - second_range) - length)
    gap = max(apart, 0.0)
    for place in places:
        assert abs(np.linalg.norm(place - a) - first_range) == pytest.approx(gap / 2.0, abs=1e-6)
        assert abs(np.linalg.norm(place - b) - second_range) == pytest.approx(gap / 2.0, abs=1e-6)
    # Where they just touch, one place is both.
    assert abs(apart) < 1e-9 or len(places) == (2 if gap == 0.0 else 1)


def test_circles_round_one_spot_meet_nowhere() -> None:
    assert circle_intersections(np.zeros(2), np.array([0.01, 0.0]), 2.0, 2.0) == ()


def test_height_does_not_bring_anchors_out_of_line() -> None:
    anchors = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 3.0], [8.0, 0.0, 1.0]])
    with pytest.raises(AnchorGeometryError, match="all 3 anchors"):
        check_anchor_geometry(anchors)


def test_good_layouts_pass() -> None:
    check_anchor_geometry(np.array([[0.0, 0.0, 2.0], [4.0, 0.0, 2.0], [2.0, 0.5, 2.0]]))
