"""Loop closures of which some are wrong: the wrong ones do not count, the right ones count in full."""

import numpy as np
import pytest

from estimators.graph.closures import increment_squares, solve_with_doubtful
from estimators.graph.solver import solve
from estimators.models.motion import increment
from tests.estimators.graph.drives import drive, graph_of, pose_errors, with_closures


@pytest.mark.parametrize("seed", range(3))
def test_wrong_closures_are_told_from_right_ones(seed: int) -> None:
    chain = drive(200, seed)
    count = 20
    clean = with_closures(chain, graph_of(chain), count, seed)
    clean.ranges = clean.ranges[::41]  # hardly anything else holds the loops
    clean.values = solve(clean).values
    wrong = np.arange(len(clean.increments) - count, len(clean.increments))[::4]
    doubtful = np.arange(len(clean.increments) - count, len(clean.increments))
    spoiled = with_closures(chain, graph_of(chain), count, seed)
    spoiled.ranges = clean.ranges
    spoiled.values = clean.values
    spoiled.increments[wrong, 2:4] += np.random.default_rng(seed).uniform(1.0, 3.0, (len(wrong), 2))
    solution, weights = solve_with_doubtful(spoiled, doubtful)
    np.testing.assert_array_equal(weights == 0.0, np.isin(doubtful, wrong))
    right = clean
    right.increments = np.delete(right.increments, wrong, axis=0)
    np.testing.assert_allclose(pose_errors(solution.values, solve(right).values), 0.0, atol=1e-5)
    assert np.abs(pose_errors(solve(spoiled).values, solution.values)).max() > 0.1


def test_without_wrong_closures_all_count() -> None:
    chain = drive(100, seed=5)
    graph = with_closures(chain, graph_of(chain), 10, seed=5)
    doubtful = np.arange(len(graph.increments) - 10, len(graph.increments))
    solution, weights = solve_with_doubtful(graph, doubtful, confidence=1 - 1e-9)
    np.testing.assert_array_equal(weights, 1.0)
    np.testing.assert_array_equal(solution.values, solve(graph).values)


def test_squares_are_mahalanobis_distances() -> None:
    chain = drive(10, seed=6)
    graph = graph_of(chain)
    row = graph.increments[4]
    residual = row[2:5] - increment(graph.values[int(row[0])], graph.values[int(row[1])])[0]
    expected = residual @ row[5:14].reshape(3, 3) @ residual
    assert increment_squares(graph.values, graph.increments[4:5])[0] == pytest.approx(expected)
