"""Range model: height reduction with its sigma, horizontal range with its Jacobian."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from estimators.messages import FloatArray
from estimators.models.range import MIN_HORIZONTAL_RANGE, horizontal_range, reduce_height, two_way_range
from tests.estimators.models.finite_differences import numerical_jacobian
from tests.strategies import poses

offsets = st.floats(-2.0, 2.0)
points = st.tuples(st.floats(-50.0, 50.0), st.floats(-50.0, 50.0), st.floats(0.0, 5.0)).map(np.array)
arms = st.tuples(offsets, offsets, offsets).map(np.array)


@given(st.floats(0.3, 100.0), st.floats(-5.0, 5.0))
def test_height_reduction_recovers_the_horizontal_range(horizontal: float, height: float) -> None:
    reduced = reduce_height(float(np.hypot(horizontal, height)), 0.1, height)
    assert reduced is not None
    assert reduced[0] == pytest.approx(horizontal, rel=1e-11)


@given(st.floats(0.3, 50.0), st.floats(-5.0, 5.0), st.floats(1e-3, 1.0))
def test_sigma_is_propagated_by_the_derivative(horizontal: float, height: float, sigma: float) -> None:
    slant, step = float(np.hypot(horizontal, height)), 1e-6
    here, ahead, behind = (reduce_height(d, sigma, height) for d in (slant, slant + step, slant - step))
    assert here is not None
    assert ahead is not None
    assert behind is not None
    assert here[1] == pytest.approx(sigma * (ahead[0] - behind[0]) / (2 * step), rel=1e-5)


def test_sigma_agrees_with_monte_carlo() -> None:
    rng = np.random.default_rng(0)
    slant, sigma, height = 4.0, 0.1, 2.5
    draws = [reduce_height(float(d), sigma, height) for d in slant + rng.normal(0.0, sigma, 20_000)]
    horizontals = np.array([draw[0] for draw in draws if draw is not None])
    reduced = reduce_height(slant, sigma, height)
    assert reduced is not None
    assert len(horizontals) == 20_000
    # 20,000 draws know a standard deviation to 0.5 %; three of that, and 1 % for the curvature.
    assert horizontals.std() == pytest.approx(reduced[1], rel=0.025)


@pytest.mark.parametrize(
    "slant", [float("nan"), float("inf"), -float("inf"), 0.0, -0.0, -3.0, 1.999, 2.0, 1e-300]
)
def test_impossible_slant_ranges_give_none(slant: float) -> None:
    assert reduce_height(slant, 0.1, 2.0) is None
    assert reduce_height(slant, 0.1, -2.0) is None


def test_under_the_anchor_there_is_no_horizontal_range() -> None:
    assert reduce_height(float(np.hypot(2.0, 0.99 * MIN_HORIZONTAL_RANGE)), 0.1, 2.0) is None
    assert reduce_height(float(np.hypot(2.0, 1.01 * MIN_HORIZONTAL_RANGE)), 0.1, 2.0) is not None


@given(st.floats(allow_nan=True, allow_infinity=True), st.floats(-10.0, 10.0))
def test_height_reduction_never_gives_a_wrong_number(slant: float, height: float) -> None:
    assume(not np.isfinite(slant) or abs(slant) < 1e150)
    reduced = reduce_height(slant, 0.1, height)
    if reduced is not None:
        assert 0.0 < reduced[0] <= slant * (1 + 1e-12)
        assert 0.1 * (1 - 1e-12) <= reduced[1] < float("inf")


@given(poses, points, arms)
def test_horizontal_range_is_the_distance_to_the_tag(
    pose: FloatArray, anchor: FloatArray, arm: FloatArray
) -> None:
    tag = complex(pose[0], pose[1]) + np.exp(1j * pose[2]) * complex(arm[0], arm[1])
    distance = abs(tag - complex(anchor[0], anchor[1]))
    assert horizontal_range(pose, anchor, arm)[0] == pytest.approx(distance, rel=1e-11, abs=1e-9)


@given(poses, points, arms)
def test_jacobian_of_the_horizontal_range(pose: FloatArray, anchor: FloatArray, arm: FloatArray) -> None:
    value, jacobian = horizontal_range(pose, anchor, arm)
    assume(value > 0.1)  # at the anchor the distance has a kink
    reference = numerical_jacobian(lambda x: np.array([horizontal_range(x, anchor, arm)[0]]), pose)
    np.testing.assert_allclose(jacobian, reference[0], atol=1e-6)


def test_on_top_of_the_anchor_value_and_jacobian_are_finite() -> None:
    value, jacobian = horizontal_range(np.array([1.0, 2.0, 0.0]), np.array([1.0, 2.0, 2.5]), np.zeros(3))
    assert value < 1e-6
    assert np.isfinite(jacobian).all()


def test_two_way_range_is_half_of_what_light_travels_besides_the_delays() -> None:
    # 20 ns there and back are 299.792458 mm a nanosecond, halved.
    sent, delays = np.array([1.0e-3, 0.0]), np.array([300e-9, 0.0])
    received = sent + 2.0 * delays + 20e-9
    found = two_way_range(sent, received, delays, delays)
    np.testing.assert_allclose(found, 2.99792458, atol=1e-9)
    late = two_way_range(sent, received + 1e-9, delays, delays) - found
    np.testing.assert_allclose(late, 0.149896229, atol=1e-9)
