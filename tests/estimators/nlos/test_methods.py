"""What each method says of a blocked range, against independent references."""

from math import inf, log, nan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.special import log_ndtr
from scipy.stats import exponnorm, norm

from estimators.kernels import blocked
from estimators.kernels.blocked import (
    BLOCKED_SHARE,
    LIKELY,
    NEVER,
    PRIOR,
    excess_log_ratio,
    power_log_ratio,
    probability,
    sigma_factor,
)
from estimators.messages import FloatArray, IntArray

SECOND = 1_000_000_000
MEMORY = 2.0
MIDDLE = 8.0
residuals = st.floats(-10.0, 10.0)
sigmas = st.floats(0.01, 5.0)


def nothing_known() -> tuple[IntArray, FloatArray]:
    """What is remembered of five anchors at first."""
    return np.full(5, NEVER), np.zeros(5)


@given(st.floats(-300.0, 40.0) | st.floats(-31.0, -29.0) | st.floats(-1.0, 1.0))
def test_shares_of_the_normal_law_are_exact_far_into_its_tail(x: float) -> None:
    assert blocked.log_normal_share(x) == pytest.approx(float(log_ndtr(x)), rel=1e-12, abs=1e-15)


@settings(max_examples=40)
@given(st.floats(-7.0, 7.0), st.floats(0.02, 2.0), st.floats(0.1, 2.0))
def test_the_ratio_is_that_of_the_densities_with_and_without_an_exponential_excess(
    scaled: float, sigma: float, excess: float
) -> None:
    residual = scaled * sigma
    blocked = exponnorm(excess / sigma, scale=sigma).logpdf(residual)
    expected = blocked - norm(scale=sigma).logpdf(residual)
    assert excess_log_ratio(residual, sigma, excess) == pytest.approx(expected, abs=1e-6, rel=1e-6)


@given(residuals, residuals, sigmas)
def test_a_longer_range_never_speaks_less_for_a_blocked_one(a: float, b: float, sigma: float) -> None:
    shorter, longer = sorted([a, b])
    ratios = excess_log_ratio(shorter, sigma, 0.5), excess_log_ratio(longer, sigma, 0.5)
    assert np.isfinite(ratios).all()
    assert ratios[0] <= ratios[1] + 1e-9


def test_a_prediction_that_knows_nothing_learns_nothing() -> None:
    assert excess_log_ratio(0.3, 50.0, 0.5) == pytest.approx(0.0, abs=0.02)


@settings(max_examples=40)
@given(st.floats(-15.0, 15.0), st.floats(0.0, 20.0))
def test_an_anchors_state_is_a_two_state_markov_chain(log_odds: float, seconds: float) -> None:
    into, out_of = BLOCKED_SHARE / MEMORY, (1.0 - BLOCKED_SHARE) / MEMORY
    rates = np.array([[-into, into], [out_of, -out_of]])
    before = probability(log_odds)
    _, expected = np.array([1.0 - before, before]) @ expm(rates * seconds)
    state = nothing_known()
    blocked.remember(*state, 3, 5 * SECOND, log_odds)
    after = blocked.prior(*state, 3, 5 * SECOND + round(seconds * SECOND), MEMORY)
    assert probability(after) == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_what_is_known_of_one_anchor_says_nothing_of_another() -> None:
    state = nothing_known()
    blocked.remember(*state, 3, 0, 5.0)
    assert blocked.prior(*state, 3, 0, MEMORY) == pytest.approx(5.0)
    assert blocked.prior(*state, 4, 0, MEMORY) == PRIOR


@pytest.mark.parametrize("log_odds", [1e3, -1e3])
def test_no_anchor_is_ever_known_for_certain(log_odds: float) -> None:
    state = nothing_known()
    blocked.remember(*state, 3, 0, log_odds)
    assert abs(blocked.prior(*state, 3, 0, MEMORY)) < 25.0
    # A stamp of before is taken for one of now.
    assert blocked.prior(*state, 3, -SECOND, MEMORY) == blocked.prior(*state, 3, 0, MEMORY)


def test_powers_follow_the_vendors_rule() -> None:
    by_first_path = {
        fp: power_log_ratio(-80.0, fp, MIDDLE) for fp in (-82.0, -86.0, -88.0, -89.0, -90.0, -99.0)
    }
    assert by_first_path[-82.0] == by_first_path[-86.0] == -LIKELY
    assert by_first_path[-90.0] == by_first_path[-99.0] == LIKELY
    assert by_first_path[-88.0] == 0.0
    assert 0.0 < by_first_path[-89.0] < LIKELY


@pytest.mark.parametrize(("rx", "fp"), [(nan, -90.0), (-80.0, nan), (nan, nan), (inf, inf), (-80.0, -inf)])
def test_powers_that_are_none_say_nothing(rx: float, fp: float) -> None:
    assert power_log_ratio(rx, fp, MIDDLE) == 0.0


@settings(max_examples=40)
@given(st.floats(-6.0, 8.0), st.floats(0.02, 0.5))
def test_a_range_keeps_the_information_that_it_has_when_clear(scaled: float, sigma: float) -> None:
    residual, excess = scaled * sigma, 0.5
    clear = (1.0 - BLOCKED_SHARE) * norm(scale=sigma).pdf(residual)
    blocked = BLOCKED_SHARE * exponnorm(excess / sigma, scale=sigma).pdf(residual)
    kept = sigma_factor(PRIOR + excess_log_ratio(residual, sigma, excess)) ** -2
    assert kept == pytest.approx(max(clear / (clear + blocked), 1e-4), rel=1e-4, abs=1e-9)


def test_sigma_is_never_smaller_and_never_infinite() -> None:
    assert sigma_factor(-1e3) == 1.0
    assert sigma_factor(1e3) == pytest.approx(100.0)
    assert log(sigma_factor(0.0)) == pytest.approx(0.5 * log(2.0))
