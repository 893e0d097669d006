"""What factors add to the normal equations, against the models of the filters and finite differences."""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimators.geometry import wrap_angle
from estimators.graph import factors
from estimators.graph.factors import DensePrior, Graph
from estimators.graph.losses import Loss, LossKind
from estimators.graph.solver import arrays
from estimators.kernels.factors import linearise, system_of
from estimators.messages import FloatArray
from estimators.models.landmark import range_and_bearing
from estimators.models.motion import constant_velocity, increment
from estimators.models.range import slant_range
from tests.estimators.models.finite_differences import numerical_jacobian

COV = np.array([[4e-3, 1e-3, 2e-4], [1e-3, 3e-3, -3e-4], [2e-4, -3e-4, 1e-3]])
ARM = np.array([0.2, -0.1])
LOSSES = [Loss(kind, 1.5) for kind in LossKind]
INFORMATION: FloatArray = np.asarray(np.linalg.inv(COV))


def dense_system(graph: Graph, values: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Cost, downhill gradient (3 V,) and information (3 V, 3 V) of all variables, as the kernel has them."""
    taken, count = arrays(graph), len(values)
    order = np.arange(count)[::-1].copy()  # against the numbers: places must count, not numbers
    system = system_of(taken, order, count)
    _, starts, rows, _ = system
    gradient, diagonal = np.empty((count, 3)), np.empty((count, 3, 3))
    below = np.empty((len(rows), 3, 3))
    cost = linearise(values, taken, system, gradient, diagonal, below, True)
    H = np.zeros((count, count, 3, 3))
    H[range(count), range(count)] = diagonal
    columns = np.repeat(np.arange(count), np.diff(starts))
    H[rows, columns], H[columns, rows] = below, below.transpose(0, 2, 1)
    H = H[::-1, ::-1]
    return cost, gradient[::-1].ravel(), H.transpose(0, 2, 1, 3).reshape(3 * count, 3 * count)


def graphs(loss: Loss) -> dict[str, Graph]:
    """A graph with one factor of each kind; variable 0 is an anchor or landmark."""
    values, free = np.zeros((5, 3)), np.ones((5, 3))
    dense = DensePrior(
        np.array([1, 3]),
        np.ones((2, 3)),
        np.kron(np.array([[2.0, 1.0], [1.0, 3.0]]), np.eye(3)),
        np.arange(6.0),
    )
    return {
        "increment": Graph(values, free, increments=factors.increments(1, 3, [0.4, 0.1, 0.3], COV, loss)),
        "range": Graph(values, free, ranges=factors.ranges(1, 0, 3.0, 0.3, ARM, 1.2, loss)),
        "sighting": Graph(values, free, sightings=factors.sightings(1, 0, 2.0, 0.3, 0.2, 0.1, loss)),
        "motion": Graph(values, free, motions=factors.motions(1, 3, 0.2, 0.5, 1.5)),
        "prior": Graph(values, free, priors=factors.priors(1, [1.0, 2.0, 3.0], INFORMATION, is_pose=True)),
        "heading": Graph(values, free, priors=factors.headings(1, 3.0, 0.1)),
        "dense": Graph(values, free, dense=dense),
    }


Model: TypeAlias = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


def _blocks(size: int, **columns: FloatArray) -> FloatArray:
    J = np.zeros((size, 15))
    for name, block in columns.items():
        i = int(name[1:])
        J[:, 3 * i : 3 * i + 3] = block
    return J


def _increment(v: FloatArray) -> tuple[FloatArray, FloatArray]:
    value, by_first, by_second = increment(v[1], v[3])
    residual = np.array([0.4, 0.1, 0.3]) - value
    residual[2] = wrap_angle(residual[2])
    return residual, _blocks(3, v1=by_first, v3=by_second)


def _range(v: FloatArray) -> tuple[FloatArray, FloatArray]:
    value, by_pose, by_anchor = slant_range(v[1], v[0], ARM, 1.2)
    return np.array([3.0 - value]), _blocks(1, v1=by_pose[None], v0=by_anchor[None])


def _sighting(v: FloatArray) -> tuple[FloatArray, FloatArray]:
    value, by_pose = range_and_bearing(v[1], v[0, :2])
    residual = np.array([2.0, 0.3]) - value
    residual[1] = wrap_angle(residual[1])
    by_landmark = np.column_stack([-by_pose[:, :2], np.zeros(2)])
    return residual, _blocks(2, v1=by_pose, v0=by_landmark)


def _motion(v: FloatArray) -> tuple[FloatArray, FloatArray]:
    F, _ = constant_velocity(0.2, 0.5, 1.5)
    predicted = v[3:5].ravel() - F @ v[1:3].ravel()
    J = np.zeros((6, 15))
    J[:, 3:9], J[:, 9:15] = -F, np.eye(6)
    return -predicted, J


MODELS: dict[str, tuple[Model, FloatArray]] = {
    "increment": (_increment, INFORMATION),
    "range": (_range, np.eye(1) / 0.3**2),
    "sighting": (_sighting, np.diag([0.2**-2, 0.1**-2])),
    "motion": (_motion, np.asarray(np.linalg.inv(constant_velocity(0.2, 0.5, 1.5)[1]))),
}
"""Name of the kind -> residual (M,) and predicted's Jacobian (M, 15) by all variables; information (M, M)."""

numbers = st.floats(-3.0, 3.0)
every_values = (
    st.lists(numbers, min_size=15, max_size=15)
    .map(lambda row: np.array(row).reshape(5, 3))
    .filter(lambda v: bool(np.hypot(*(v[0] - v[1])[:2]) > 0.5))
)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: loss.kind.name)
@settings(max_examples=15)
@given(values=every_values)
def test_normal_equations_are_those_of_the_models(name: str, loss: Loss, values: FloatArray) -> None:
    model, information = MODELS[name]
    residual, J = model(values)
    square = float(residual @ information @ residual)
    signed = np.array([np.sqrt(square) * (np.sign(residual[0]) if name == "range" else 1.0)])
    used = Loss(LossKind.GAUSSIAN) if name == "motion" else loss
    W = used.weight(signed)[0] * information
    cost, gradient, H = dense_system(graphs(loss)[name], values)
    np.testing.assert_allclose(cost, used.value(signed)[0], rtol=1e-9)
    np.testing.assert_allclose(gradient, J.T @ W @ residual, rtol=1e-8, atol=1e-6)
    np.testing.assert_allclose(H, J.T @ W @ J, rtol=1e-8, atol=1e-6)


@pytest.mark.parametrize("name", graphs(LOSSES[0]))
@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: loss.kind.name)
@settings(max_examples=15)
@given(values=every_values)
def test_the_gradient_is_that_of_the_cost(name: str, loss: Loss, values: FloatArray) -> None:
    graph = graphs(loss)[name]
    _, gradient, _ = dense_system(graph, values)
    numerical = numerical_jacobian(
        lambda at: np.array([dense_system(graph, at.reshape(5, 3))[0]]), values.ravel()
    )
    np.testing.assert_allclose(-gradient, numerical[0], rtol=1e-4, atol=2e-2)


def test_a_number_that_is_not_free_gets_no_pull_and_a_one_on_the_diagonal() -> None:
    graph = graphs(LOSSES[0])["range"]
    graph.free[0] = factors.BIAS
    values = np.arange(15.0).reshape(5, 3) / 7.0
    _, gradient, H = dense_system(graph, values)
    np.testing.assert_array_equal(gradient[:2], 0.0)
    np.testing.assert_array_equal(H[:2], np.eye(15)[:2])
    assert gradient[2] != 0.0


@given(every_values, st.floats(-3.0, 3.0))
def test_jacobians_of_the_slant_range(values: FloatArray, height: float) -> None:
    pose, anchor = values[1], values[0]
    _, by_pose, by_anchor = slant_range(pose, anchor, ARM, height)
    numerical = numerical_jacobian(lambda x: np.array([slant_range(x, anchor, ARM, height)[0]]), pose)
    np.testing.assert_allclose(by_pose, numerical[0], atol=1e-5)
    numerical = numerical_jacobian(lambda x: np.array([slant_range(pose, x, ARM, height)[0]]), anchor)
    np.testing.assert_allclose(by_anchor, numerical[0], atol=1e-5)


def test_a_heading_is_compared_across_the_seam() -> None:
    graph = Graph(np.zeros((1, 3)), np.ones((1, 3)), priors=factors.headings(0, np.pi - 0.01, 0.1))
    cost, _, _ = dense_system(graph, np.array([[0.0, 0.0, -np.pi + 0.01]]))
    assert cost == pytest.approx(0.5 * 0.2**2)
