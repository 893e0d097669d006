"""Factors that come one by one are rows of the same numbers as those that come together."""

import numpy as np

from estimators.graph import factors
from estimators.kernels import factor_rows


def test_ranges_that_passed_their_gate_become_rows() -> None:
    reduced = np.random.default_rng(1).uniform(1.0, 5.0, (5, 4))
    anchors, codes = np.array([2, -1, 0, 3, 1]), np.array([0, -1, 3, 0, 1])
    for least, passed in ((0, [0, 3]), (1, [0, 3, 4])):
        rows = factor_rows.ranges(anchors, reduced, codes, least, 0.1, -0.2)
        chosen = reduced[passed]
        expected = factors.ranges(-1, anchors[passed], chosen[:, 2], chosen[:, 3], (0.1, -0.2))
        np.testing.assert_array_equal(rows, expected)
    assert factor_rows.ranges(anchors, reduced, np.full(5, 2), 1, 0.1, -0.2).shape == (0, factors.RANGE)


def test_an_increment_becomes_a_row() -> None:
    half = np.random.default_rng(2).normal(size=(3, 3))
    measured, cov = np.array([0.3, -0.1, 0.2]), half @ half.T
    expected = factors.increments(7, -1, measured, cov)
    np.testing.assert_allclose(factor_rows.increment(7, measured, cov), expected, rtol=1e-12)
