"""The optimum of graphs against GTSAM and scipy, its covariance, and graphs that have none."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X
from scipy.optimize import least_squares
from scipy.stats import chi2

from estimators.graph import factors
from estimators.graph.errors import GraphError
from estimators.graph.factors import DensePrior, Graph
from estimators.graph.losses import Loss, LossKind
from estimators.graph.solver import Method, arrays, solve
from estimators.kernels import optimise
from estimators.kernels.block_cholesky import inverse_blocks
from estimators.kernels.factors import system_of
from estimators.messages import FloatArray
from estimators.models.motion import increment
from tests.estimators.graph.drives import (
    ANCHORS,
    RANGE_SIGMA,
    closures,
    drive,
    graph_of,
    pose_errors,
    sightings,
    with_closures,
    with_landmarks,
)
from tests.estimators.graph.gtsam_graphs import add_closures, add_landmarks, gtsam_graph, optimum, poses_of

METHODS: list[Method] = ["gauss_newton", "levenberg_marquardt"]
FIRST = len(ANCHORS)
APART = np.array([1e-4, 1e-4, 1e-5])
"""How far the optimum may be from GTSAM's [m, m, rad]."""


def assert_same_poses(found: FloatArray, reference: FloatArray) -> None:
    assert (np.abs(pose_errors(found, reference)).max(axis=0) < APART).all()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("count", [100, 1000])
def test_a_chain_has_the_optimum_of_gtsam(method: Method, count: int) -> None:
    chain = drive(count, seed=1)
    assert_same_poses(
        solve(graph_of(chain), method).values[FIRST:], poses_of(optimum(*gtsam_graph(chain)), count)
    )


@pytest.mark.parametrize(
    ("loss", "theirs"),
    [
        (Loss(LossKind.HUBER, 1.345), gtsam.noiseModel.mEstimator.Huber.Create(1.345)),
        (Loss(LossKind.CAUCHY, 2.0), gtsam.noiseModel.mEstimator.Cauchy.Create(2.0)),
    ],
    ids=["huber", "cauchy"],
)
def test_robust_losses_have_the_optimum_of_gtsam(
    loss: Loss, theirs: gtsam.noiseModel.mEstimator.Base
) -> None:
    chain = drive(300, seed=2)
    chain.ranges[40:90, 1] += 0.8  # blocked
    found = solve(graph_of(chain, loss)).values[FIRST:]
    assert_same_poses(found, poses_of(optimum(*gtsam_graph(chain, theirs)), 300))
    plain = solve(graph_of(chain)).values[FIRST:]
    assert np.abs(pose_errors(plain, found)).max() > 0.05


def test_loop_closures_have_the_optimum_of_gtsam() -> None:
    chain = drive(600, seed=3)
    graph, values = gtsam_graph(chain)
    add_closures(graph, *closures(chain, 50, seed=4))
    found = solve(with_closures(chain, graph_of(chain), 50, seed=4)).values[FIRST:]
    assert_same_poses(found, poses_of(optimum(graph, values), 600))


def test_unknown_landmarks_have_the_optimum_of_gtsam() -> None:
    chain = drive(400, seed=5)
    ours, count = with_landmarks(chain, seed=6)
    _, who, which, measured = sightings(chain, seed=6)
    graph, values = gtsam_graph(chain)
    add_landmarks(graph, values, ours.values[FIRST : FIRST + count, :2], who, which, measured)
    assert_same_poses(solve(ours).values[FIRST + count :], poses_of(optimum(graph, values), 400))


def test_covariances_are_those_of_gtsam() -> None:
    chain = drive(60, seed=7)
    graph, values = gtsam_graph(chain)
    theirs = optimum(graph, values)
    marginals = gtsam.Marginals(graph, theirs)
    ours = graph_of(chain)
    covs = solve(ours).covariances(ours.free)
    np.testing.assert_array_equal(covs[:FIRST], 0.0)
    for k in (0, 29, 59):
        R = np.eye(3)
        R[:2, :2] = theirs.atPose2(X(k)).rotation().matrix()  # theirs are in the body frame
        expected = R @ marginals.marginalCovariance(X(k)) @ R.T
        # Their error of an increment is a logarithm: at residuals that are not zero its derivative differs.
        np.testing.assert_allclose(covs[FIRST + k], expected, atol=0.01 * np.diag(expected).min())


def test_a_chain_goes_by_time_and_many_closures_by_degree() -> None:
    chain = drive(300, seed=8)
    np.testing.assert_array_equal(solve(graph_of(chain)).system[0][FIRST:], np.arange(300))
    graph = with_closures(chain, graph_of(chain), 40, seed=9)
    solution = solve(graph)
    assert (np.diff(solution.system[0][FIRST:]) != 1).any()
    # Whatever the order, these are blocks of the inverse of one matrix.
    graph.values = solution.values
    order = np.r_[np.full(FIRST, -1), np.arange(300)]
    system = system_of(arrays(graph), order, 300)
    *_, diagonal, below = optimise.gauss_newton(solution.values.copy(), arrays(graph), system, 1, 1.0)
    by_time = inverse_blocks(system[1], system[2], diagonal, below)[0]
    np.testing.assert_allclose(solution.covariances(graph.free)[FIRST:], by_time, rtol=1e-6, atol=1e-12)


def test_unknown_anchors_with_biases_have_the_optimum_of_scipy() -> None:
    chain = drive(20, seed=10, dt=3.0)
    graph = graph_of(chain)
    graph.free[1:3], graph.free[3] = factors.ALL, factors.BIAS
    graph.values[1:3, :2] += 0.3
    graph.ranges[graph.ranges[:, 1] == 2, 2] += 0.2
    weights = np.linalg.cholesky(graph.increments[:, 5:14].reshape(-1, 3, 3)).transpose(0, 2, 1)
    mask = graph.free.astype(bool)

    def residuals(x: FloatArray) -> FloatArray:
        v = graph.values.copy()
        v[mask] = x
        out = []
        for row, R in zip(graph.increments, weights, strict=True):
            error = row[2:5] - increment(v[int(row[0])], v[int(row[1])])[0]
            error[2] = np.angle(np.exp(1j * error[2]))
            out.append(R @ error)
        tags, anchors = v[graph.ranges[:, 0].astype(int)], v[graph.ranges[:, 1].astype(int)]
        predicted = np.hypot(*(tags - anchors)[:, :2].T) + anchors[:, 2]
        return np.concatenate([*out, (graph.ranges[:, 2] - predicted) / RANGE_SIGMA])

    reference = least_squares(residuals, graph.values[mask], xtol=1e-12, ftol=1e-12, gtol=1e-12)
    solution = solve(graph)
    assert solution.cost == pytest.approx(reference.cost, rel=1e-7)
    np.testing.assert_allclose(solution.values[mask], reference.x, atol=2e-4)
    jac = np.asarray(reference.jac)
    inverse = np.linalg.inv(jac.T @ jac)
    expected = np.zeros((len(mask.ravel()),) * 2)
    expected[np.ix_(mask.ravel(), mask.ravel())] = inverse
    for i, cov in enumerate(solution.covariances(graph.free)):
        np.testing.assert_allclose(cov, expected[3 * i : 3 * i + 3, 3 * i : 3 * i + 3], rtol=2e-2, atol=1e-7)


def test_noiseless_measurements_give_no_error() -> None:
    chain = drive(200, seed=11, noise=0.0)
    np.testing.assert_allclose(
        pose_errors(solve(graph_of(chain)).values[FIRST:], chain.truth), 0.0, atol=1e-6
    )


def test_nees_of_all_poses_is_within_both_bounds() -> None:
    nees = []
    for seed in range(60):
        chain = drive(12, seed)
        graph = graph_of(chain)
        solution = solve(graph)
        errors, covs = pose_errors(solution.values[FIRST:], chain.truth), solution.covariances(graph.free)
        nees.append(errors[6] @ np.linalg.solve(covs[FIRST + 6], errors[6]))
    assert chi2.ppf(0.005, 3 * len(nees)) < sum(nees) < chi2.ppf(0.995, 3 * len(nees))


def test_the_start_is_left_as_it_was() -> None:
    graph = graph_of(drive(20, seed=12))
    before = graph.values.copy()
    solve(graph)
    np.testing.assert_array_equal(graph.values, before)


def test_the_same_graph_gives_the_same_bytes() -> None:
    graph = with_closures(drive(100, seed=13), graph_of(drive(100, seed=13)), 10, seed=1)
    assert solve(graph).values.tobytes() == solve(graph).values.tobytes()


def named(graph: Graph) -> Graph:
    graph.name = lambda i: f"anchor {i}" if i < FIRST else f"pose {i - FIRST}"
    return graph


def test_an_anchor_without_ranges_is_named() -> None:
    graph = named(graph_of(drive(30, seed=14)))
    graph.free[2] = factors.ALL
    graph.ranges = graph.ranges[graph.ranges[:, 1] != 2]
    with pytest.raises(GraphError, match=r"anchor 2: no measured numbers bear on it, at least 3"):
        solve(graph)
    graph = named(graph_of(drive(30, seed=14)))
    graph.free[2] = factors.ALL
    graph.ranges = np.delete(graph.ranges, np.flatnonzero(graph.ranges[:, 1] == 2)[2:], axis=0)
    with pytest.raises(GraphError, match=r"anchor 2: 2 measured numbers bear on it, at least 3"):
        solve(graph)


def test_a_pose_that_hangs_on_nothing_is_named() -> None:
    graph = named(graph_of(drive(30, seed=15)))
    graph.ranges = graph.ranges[graph.ranges[:, 0] < FIRST + 20]
    graph.increments = np.delete(graph.increments, 19, axis=0)
    with pytest.raises(GraphError, match="pose 20: nothing holds it and 9 others in place"):
        solve(graph)


def test_a_graph_that_may_be_moved_as_a_whole_is_refused() -> None:
    graph = named(graph_of(drive(30, seed=16)))
    graph.free[:FIRST] = factors.PLACE
    with pytest.raises(GraphError, match="anchor 0: nothing holds it"):
        solve(graph)
    graph.dense = DensePrior(np.array([0]), graph.values[:1], np.diag([1e4, 1e4, 0.0]), np.zeros(3))
    with pytest.raises(GraphError, match="the measurements do not determine it"):  # it may still turn
        solve(graph)


@pytest.mark.parametrize("method", METHODS)
def test_a_heading_that_nothing_tells_is_no_silent_answer(method: Method) -> None:
    chain = drive(3, seed=17)
    graph = named(graph_of(chain))
    graph.increments = graph.increments[:0]
    with pytest.raises(GraphError, match="pose 0: the measurements do not determine it"):
        solve(graph, method)


@pytest.mark.parametrize("table", ["increments", "ranges"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_number_that_is_not_finite_is_named(table: str, value: float) -> None:
    graph = named(graph_of(drive(30, seed=18)))
    getattr(graph, table)[7, 2] = value
    with pytest.raises(GraphError, match=rf"pose \d+ and .*{table} is not finite, row 7"):
        solve(graph)
    graph = named(graph_of(drive(30, seed=18)))
    graph.values[FIRST + 5, 1] = value
    with pytest.raises(GraphError, match="pose 5: its start is not finite"):
        solve(graph)


def test_a_variable_that_there_is_not_is_refused() -> None:
    graph = graph_of(drive(5, seed=19))
    graph.ranges[3, 0] = 77
    with pytest.raises(GraphError, match="ranges: a variable that the graph does not have"):
        solve(graph)


def test_too_few_steps_are_said_to_be() -> None:
    with pytest.raises(GraphError, match="no optimum within 2 steps"):
        solve(graph_of(drive(50, seed=20)), "gauss_newton", iterations=2)
