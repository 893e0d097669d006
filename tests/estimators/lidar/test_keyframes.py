"""What every tracker of keyframes asks of an increment's covariance."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from estimators.lidar.keyframes import is_covariance

NUMBERS = st.lists(st.floats(-1.0, 1.0), min_size=9, max_size=9)


@given(NUMBERS, st.floats(-6.0, 6.0))
def test_a_covariance_is_what_has_positive_eigenvalues(numbers: list[float], exponent: float) -> None:
    root = np.array(numbers).reshape(3, 3)
    for matrix in (root + root.T, root @ root.T + 0.01 * np.eye(3)):
        least = np.linalg.eigvalsh(matrix)[0]
        assume(abs(least) > 1e-9)
        assert is_covariance(10.0**exponent * matrix) == (least > 0.0)


@pytest.mark.parametrize("place", [(0, 0), (0, 2), (2, 1), (2, 2)])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_not_finite_makes_no_covariance(place: tuple[int, int], bad: float) -> None:
    cov = np.eye(3)
    cov[place] = bad
    assert not is_covariance(cov)


def test_what_is_known_exactly_is_no_covariance() -> None:
    for k in range(3):
        known = np.eye(3)
        known[k, k] = 0.0
        assert not is_covariance(known)
    assert not is_covariance(np.zeros((3, 3)))
