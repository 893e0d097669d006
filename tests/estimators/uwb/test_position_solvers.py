"""Solvers of a position: the optimum is scipy's, and momentum finds it in fewer steps."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from estimators.messages import FloatArray
from estimators.uwb.position_solvers import (
    Solution,
    closed_form,
    gradient_descent,
    momentum_descent,
    spans_space,
    unit_vectors,
)

ROOM = np.array([10.0, 8.0, 3.0])
TOLERANCE, MANY = 1e-8, 20_000
GD = gradient_descent(0.5, TOLERANCE, MANY)
FAST_GD = gradient_descent(0.99, TOLERANCE, MANY)
"""With the largest step that cannot swing up."""
MOMENTUM = momentum_descent(0.1, TOLERANCE, MANY)


def problem(rng: np.random.Generator, dimensions: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Anchors about a room, noisy ranges of which some are blocked, and the position."""
    while True:
        anchors = rng.uniform(0.0, ROOM[:dimensions], (rng.integers(dimensions + 1, 8), dimensions))
        if np.linalg.svd(anchors - anchors.mean(axis=0))[1][-1] > 4.0 / dimensions:
            break
    position = rng.uniform(0.15, 0.85, dimensions) * ROOM[:dimensions]
    ranges = np.linalg.norm(anchors - position, axis=1) + rng.normal(0.0, 0.1, len(anchors))
    ranges[0] += 0.8 * (rng.random() < 0.3)
    return anchors, ranges, position


def optimum(anchors: FloatArray, ranges: FloatArray, start: FloatArray) -> FloatArray:
    def residuals(p: FloatArray) -> FloatArray:
        distances: FloatArray = np.linalg.norm(anchors - p, axis=1)
        return distances - ranges

    found = least_squares(residuals, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return np.asarray(found.x)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_descents_reach_the_optimum_of_scipy_and_momentum_in_half_the_steps(dimensions: int) -> None:
    rng = np.random.default_rng(0)
    taken = []
    for _ in range(60):
        anchors, ranges, position = problem(rng, dimensions)
        solutions: list[Solution] = [solve(anchors, ranges, position) for solve in (GD, FAST_GD, MOMENTUM)]
        for solution in solutions:
            expected = optimum(anchors, ranges, solution.position)
            np.testing.assert_allclose(solution.position, expected, atol=1e-6)
        np.testing.assert_allclose(solutions[2].position, solutions[0].position, atol=1e-6)
        taken.append([solution.iterations for solution in solutions])
    slow, fast, momentum = np.mean(taken, axis=0)
    assert momentum <= 0.5 * slow
    assert momentum < 0.8 * fast
    # No single problem costs it many more steps than the descent of the same curvature bound.
    assert all(m <= g for g, _, m in taken)


@given(st.integers(0, 10_000), st.sampled_from([2, 3]))
def test_exact_ranges_are_solved_in_closed_form(seed: int, dimensions: int) -> None:
    anchors, _, position = problem(np.random.default_rng(seed), dimensions)
    ranges = np.linalg.norm(anchors - position, axis=1)
    np.testing.assert_allclose(closed_form(anchors, ranges), position, atol=1e-7)


def test_unit_vectors_are_the_derivatives_of_the_distances() -> None:
    anchors, _, position = problem(np.random.default_rng(3), 3)
    step = 1e-6
    for axis in range(3):
        moved = step * np.eye(3)[axis]
        slope = (unit_vectors(anchors, position + moved)[1] - unit_vectors(anchors, position - moved)[1]) / (
            2.0 * step
        )
        np.testing.assert_allclose(unit_vectors(anchors, position)[0][:, axis], slope, atol=1e-8)


def test_a_descent_ends_after_its_steps_even_where_it_cannot_settle() -> None:
    anchors, ranges, position = problem(np.random.default_rng(1), 2)
    for solve in (gradient_descent(0.5, 1e-8, 3), momentum_descent(0.1, 1e-8, 3)):
        assert solve(anchors, ranges, position + 1.0).iterations == 3


def test_no_direction_without_curvature_throws_momentum_out_of_the_room() -> None:
    # Next to the line of its anchors a tag's ranges say nothing across it.
    anchors = np.array([[0.0, 0.0], [4.0, 0.0], [8.0, 0.11]])
    solution = MOMENTUM(anchors, np.array([2.1, 2.0, 6.1]), np.array([2.0, 0.0]))
    assert np.abs(solution.position).max() < 10.0


@pytest.mark.parametrize(
    ("heights", "answer"),
    [((2.0, 2.0, 2.0, 2.0), False), ((2.0, 2.02, 2.0, 2.02), False), ((2, 1, 2, 1), True)],
)
def test_anchors_span_space_when_they_are_in_no_plane(heights: tuple[float, ...], answer: bool) -> None:
    corners = np.array([[0.0, 0.0], [8.0, 0.0], [8.0, 6.0], [0.0, 6.0]])
    anchors = np.column_stack([corners, heights])
    assert spans_space(anchors) is answer
    assert not spans_space(anchors[:3])
