"""Block-sparse Cholesky: factor, solutions and blocks of the inverse against dense NumPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimators.kernels import block_cholesky
from estimators.messages import FloatArray, IntArray


@st.composite
def sparse_matrices(draw: st.DrawFn) -> tuple[int, IntArray, FloatArray]:
    """Number of blocks, pairs of connected ones, and a positive definite matrix with that pattern."""
    count = draw(st.integers(1, 9))
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    every = [(i, j) for j in range(count) for i in range(j)]
    pairs = [pair for pair in every if rng.random() < draw(st.sampled_from([0.15, 0.4, 0.9]))]
    A = np.zeros((3 * count, 3 * count))
    for i, j in pairs:
        rows = rng.standard_normal((3, 3 * count))
        keep = np.zeros(3 * count, dtype=bool)
        keep[3 * i : 3 * i + 3] = keep[3 * j : 3 * j + 3] = True
        A += (rows * keep).T @ (rows * keep)
    A += np.diag(rng.uniform(0.1, 2.0, 3 * count))
    doubled = [*pairs, *pairs[:2], (-1, -1)]  # a pair may come twice, and one of a fixed variable
    return count, np.array(doubled, dtype=np.int64), A


def blocks_of(A: FloatArray, starts: IntArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
    """Diagonal blocks and those below in the places of a pattern."""
    count = len(starts) - 1
    at = [slice(3 * i, 3 * i + 3) for i in range(count)]
    diagonal = np.array([A[at[j], at[j]] for j in range(count)])
    columns = np.repeat(np.arange(count), np.diff(starts))
    below = np.array([A[at[i], at[j]] for i, j in zip(rows, columns, strict=True)]).reshape(-1, 3, 3)
    return diagonal, below


@settings(max_examples=60)
@given(sparse_matrices())
def test_solutions_are_those_of_the_dense_matrix(case: tuple[int, IntArray, FloatArray]) -> None:
    count, pairs, A = case
    starts, rows = block_cholesky.pattern(count, pairs)
    diagonal, below = blocks_of(A, starts, rows)
    assert block_cholesky.factorise(starts, rows, diagonal, below, count) == -1
    right = np.arange(3.0 * count).reshape(-1, 3) - 2.0
    x = right.copy()
    block_cholesky.solve_down(starts, rows, diagonal, below, x, count)
    block_cholesky.solve_up(starts, rows, diagonal, below, x)
    np.testing.assert_allclose(A @ x.ravel(), right.ravel(), atol=1e-8)


@settings(max_examples=60)
@given(sparse_matrices())
def test_blocks_of_the_inverse_are_those_of_the_dense_inverse(
    case: tuple[int, IntArray, FloatArray],
) -> None:
    count, pairs, A = case
    starts, rows = block_cholesky.pattern(count, pairs)
    factor = blocks_of(A, starts, rows)
    block_cholesky.factorise(starts, rows, *factor, count)
    found = block_cholesky.inverse_blocks(starts, rows, *factor)
    for actual, expected in zip(
        found, blocks_of(np.asarray(np.linalg.inv(A), dtype=np.float64), starts, rows), strict=True
    ):
        np.testing.assert_allclose(actual, expected, atol=1e-8)


@given(sparse_matrices(), st.data())
def test_a_factorisation_cut_short_leaves_the_schur_complement(
    case: tuple[int, IntArray, FloatArray], data: st.DataObject
) -> None:
    count, pairs, A = case
    eliminated = data.draw(st.integers(0, count - 1))
    starts, rows = block_cholesky.pattern(count, pairs)
    diagonal, below = blocks_of(A, starts, rows)
    block_cholesky.factorise(starts, rows, diagonal, below, eliminated)
    k = 3 * eliminated
    expected = A[k:, k:] - A[k:, :k] @ np.linalg.solve(A[:k, :k], A[:k, k:])
    for j in range(eliminated, count):
        at = slice(3 * j - k, 3 * j - k + 3)
        np.testing.assert_allclose(np.tril(diagonal[j]), np.tril(expected[at, at]), atol=1e-9)


@pytest.mark.parametrize("loose", [0, 2, 4])
def test_a_variable_that_nothing_determines_is_named(loose: int) -> None:
    pairs = np.array([(i, i + 1) for i in range(4)], dtype=np.int64)
    A = 4.0 * np.eye(15) - np.kron(np.eye(5, k=1) + np.eye(5, k=-1), np.eye(3))
    A[3 * loose + 1] = A[:, 3 * loose + 1] = 0.0
    starts, rows = block_cholesky.pattern(5, pairs)
    assert block_cholesky.factorise(starts, rows, *blocks_of(A, starts, rows), 5) == loose
