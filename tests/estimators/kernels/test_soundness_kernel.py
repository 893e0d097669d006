"""Poses whose numbers cannot be meant are told from those that can, by NumPy's eigenvalues."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimators.kernels.soundness import NOT_DEFINITE, NOT_FINITE, SOUND, soundness
from estimators.messages import FloatArray


def _matrix(seed: int, values: list[float]) -> FloatArray:
    """A symmetric matrix (N, N) with these eigenvalues."""
    turn, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(len(values), len(values))))
    product = turn * values @ turn.T
    symmetric: FloatArray = 0.5 * (product + product.T)
    return symmetric


@given(
    st.integers(0, 1000),
    st.lists(st.floats(1e-6, 1e6), min_size=6, max_size=6),
    st.one_of(st.just(0), st.floats(-1e6, -1e-6)),
)
def test_one_negative_eigenvalue_is_found_whatever_its_direction(
    seed: int, values: list[float], negative: float
) -> None:
    cov = _matrix(seed, [negative or values[0], *values[1:]])
    # Eigenvalues that rounding could turn say nothing.
    expected = np.linalg.eigvalsh(cov)[0]
    if abs(expected) > 1e-9 * max(values):
        assert soundness(np.eye(4), cov, 6) == (SOUND if expected > 0.0 else NOT_DEFINITE)


def test_a_zero_matrix_is_not_definite() -> None:
    assert soundness(np.eye(4), np.zeros((6, 6)), 6) == NOT_DEFINITE


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [(0, 0), (2, 1), (4, 4)])
def test_a_number_that_is_not_finite_is_found(number: float, place: tuple[int, int]) -> None:
    cov, transform = np.eye(6), np.eye(4)
    cov[place] = transform[3, 3] = number
    assert soundness(np.eye(4), cov, 5) == soundness(transform, np.eye(6), 6) == NOT_FINITE


def test_what_is_not_used_is_not_looked_at() -> None:
    cov = np.eye(6)
    cov[5, 5] = np.inf
    assert soundness(np.eye(4), cov, 5) == SOUND
    assert soundness(np.eye(4), cov, 6) == NOT_FINITE
