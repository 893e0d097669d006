"""Resampling: unbiased, and less random than drawing every particle by itself."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimators.messages import FloatArray, IntArray
from estimators.resampling import RESAMPLING, stratified, systematic

Method = Callable[[FloatArray, int, np.random.Generator], IntArray]
EVERY_METHOD = pytest.mark.parametrize("method", RESAMPLING.values(), ids=list(RESAMPLING))
raw_weights = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=40).filter(lambda w: sum(w) > 1e-6)


def counts(method: Method, weights: FloatArray, draws: int) -> FloatArray:
    """How often each particle is kept (draws, N), in independent draws."""
    rng = np.random.default_rng(1)
    size = len(weights)
    return np.array(
        [np.bincount(method(weights, size, rng), minlength=size) for _ in range(draws)], dtype=float
    )


@EVERY_METHOD
@given(raw=raw_weights, count=st.integers(1, 60), seed=st.integers(0, 1000))
def test_as_many_indices_as_asked_for_all_of_particles_with_weight(
    method: Method, raw: list[float], count: int, seed: int
) -> None:
    weights = np.array(raw) / sum(raw)
    kept = method(weights, count, np.random.default_rng(seed))
    assert len(kept) == count
    assert (np.diff(kept) >= 0).all()
    assert (weights[kept] > 0.0).all()


@given(raw=raw_weights, count=st.integers(1, 60), seed=st.integers(0, 1000))
def test_systematic_keeps_each_particle_its_share_of_times_rounded(
    raw: list[float], count: int, seed: int
) -> None:
    weights = np.array(raw) / sum(raw)
    kept = np.bincount(systematic(weights, count, np.random.default_rng(seed)), minlength=len(weights))
    assert (np.abs(kept - count * weights) < 1.0 + 1e-9).all()


@EVERY_METHOD
def test_a_particle_is_kept_as_often_as_its_weight_says_on_average(method: Method) -> None:
    weights = np.random.default_rng(0).exponential(size=20)
    weights /= weights.sum()
    drawn = counts(method, weights, 4000)
    standard_error = drawn.std(axis=0) / np.sqrt(len(drawn)) + 1e-12
    assert (np.abs(drawn.mean(axis=0) - 20 * weights) < 4.5 * standard_error + 1e-9).all()


@EVERY_METHOD
def test_the_mean_of_what_is_kept_varies_less_than_by_multinomial_resampling(method: Method) -> None:
    rng = np.random.default_rng(0)
    weights = rng.exponential(size=20)
    weights /= weights.sum()
    values = np.sort(rng.normal(size=20))
    multinomial = np.random.default_rng(2).multinomial(20, weights, 4000) @ values / 20
    ours = counts(method, weights, 4000) @ values / 20
    assert ours.var() < 0.5 * multinomial.var()


def test_stratified_takes_one_particle_of_every_share() -> None:
    kept = stratified(np.full(8, 1 / 8), 8, np.random.default_rng(3))
    np.testing.assert_array_equal(kept, np.arange(8))
