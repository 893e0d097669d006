"""The sliding window: what it forgets it forgets properly, and what comes late finds its place."""

import numpy as np
import pytest

from estimators.geometry import compose
from estimators.graph import factors
from estimators.graph.errors import GraphError
from estimators.graph.fixed_lag import FixedLag
from estimators.graph.solver import solve
from estimators.messages import FloatArray
from tests.estimators.graph.drives import (
    ANCHORS,
    RANGE_SIGMA,
    STEP_SIGMA,
    Drive,
    drive,
    graph_of,
    pose_errors,
)

STEP_NS = 100_000_000
KNOWN = np.column_stack([ANCHORS, np.zeros(len(ANCHORS))])
START = np.diag([0.3, 0.3, 0.1]) ** 2
COV = np.diag(STEP_SIGMA**2)


def through(drive: Drive, lag: int, iterations: int = 10) -> tuple[FixedLag, FloatArray, FloatArray]:
    """Window after a drive, its newest poses (N, 3), and the last covariance."""
    window, poses = FixedLag(KNOWN, 1, iterations, tolerance=1e-9), []
    for k, ranges in enumerate(drive.ranges):
        if k == 0:
            window.begin(0, drive.truth[:1], START)
        else:
            window.insert(k * STEP_NS, compose(window.newest[0], drive.steps[k - 1])[None])
            v = window.variable(len(window.stamps_ns) - 1)
            window.add(increments=factors.increments(v - 1, v, drive.steps[k - 1], COV))
        v = window.variable(len(window.stamps_ns) - 1)
        window.add(ranges=factors.ranges(v, np.arange(len(ANCHORS)), ranges, RANGE_SIGMA))
        cov = window.update()
        poses.append(window.newest[0].copy())
        window.drop_before((k - lag) * STEP_NS)
    return window, np.array(poses), cov


def test_a_window_over_everything_is_the_batch() -> None:
    chain = drive(80, seed=1)
    window, poses, cov = through(chain, lag=1000)
    graph = graph_of(chain)
    graph.priors = factors.priors(4, chain.truth[0], np.linalg.inv(START), is_pose=True)
    whole = solve(graph)
    np.testing.assert_allclose(pose_errors(poses[-1:], whole.values[-1:]), 0.0, atol=1e-5)
    np.testing.assert_allclose(cov, whole.covariances(graph.free)[-1], rtol=1e-3, atol=1e-7)
    assert len(window.stamps_ns) == 80


def test_what_is_forgotten_still_counts() -> None:
    """Marginalising loses next to nothing: only the point of linearisation stays behind."""
    chain = drive(150, seed=2)
    _, whole, cov_whole = through(chain, lag=1000)
    window, poses, cov = through(chain, lag=10)
    sigma = np.sqrt(np.diag(cov_whole))
    assert (np.abs(pose_errors(poses[20:], whole[20:])) < 0.1 * sigma).all()
    np.testing.assert_allclose(cov, cov_whole, rtol=0.05, atol=1e-6)
    assert len(window.stamps_ns) <= 12
    assert len(window.graph.ranges) <= 12 * 4


def test_nothing_is_counted_twice_when_a_window_is_marginalised_to_its_newest_node() -> None:
    chain = drive(30, seed=3)
    window, _, cov = through(chain, lag=1000)
    window.update()
    before = window.newest.copy()
    window.drop_before(10**12)
    assert len(window.stamps_ns) == 1
    assert len(window.graph.increments) == 0
    assert len(window.graph.ranges) == len(ANCHORS)  # its own
    np.testing.assert_allclose(window.update(), cov, rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(window.newest, before, atol=1e-5)


def test_absorbed_factors_leave_the_optimum_where_it_is() -> None:
    chain = drive(20, seed=4)
    window, _, cov = through(chain, lag=1000)
    window.update()
    before = window.graph.values.copy()
    window.absorb()
    assert len(window.graph.ranges) == 0
    np.testing.assert_allclose(window.update(), cov, rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(window.graph.values, before, atol=1e-5)


def test_a_node_where_increments_begin_stays_until_they_have_left() -> None:
    window = FixedLag(KNOWN, 1)
    window.begin(0, np.array([[5.0, 5.0, 0.0]]), START)
    for k in range(1, 11):  # all from the same keyframe
        window.insert(k * STEP_NS, np.array([[5.0 + 0.1 * k, 5.0, 0.0]]))
        step = factors.increments(
            window.variable(0), window.variable(len(window.stamps_ns) - 1), [0.1 * k, 0, 0], COV
        )
        window.add(increments=step)
        window.update()
        window.drop_before((k - 3) * STEP_NS)
    assert window.stamps_ns.tolist() == [0, *(k * STEP_NS for k in range(7, 11))]
    window.drop_before(11 * STEP_NS, kept_ns=[0])
    assert window.stamps_ns.tolist() == [0, 10 * STEP_NS]
    window.drop_before(11 * STEP_NS)
    assert window.stamps_ns.tolist() == [10 * STEP_NS]


def moving(stamps: list[int], late: int | None = None) -> FixedLag:
    """Window of a body that moves at 1 m/s, ranges at each instant; one node put in afterwards."""
    window = FixedLag(KNOWN, 2)
    window.begin(
        0, np.array([[2.0, 5.0, 0.0], [1.0, 0.0, 0.0]]), np.diag([0.1, 0.1, 0.1, 0.3, 0.3, 0.3]) ** 2
    )
    for stamp in stamps:
        x = 2.0 + stamp * 0.1
        node = window.insert(stamp * STEP_NS, np.array([[x, 5.0, 0.0], [1.0, 0.0, 0.0]]))
        dt = (window.stamps_ns[node] - window.stamps_ns[node - 1]) * 1e-9
        window.add(motions=factors.motions(window.variable(node - 1), window.variable(node), dt, 0.5, 1.5))
        window.add(ranges=ranges_at(window, node, x, stamp))
    if late is not None:
        window.update()
        node_ = window.interpolate(late * STEP_NS)
        assert node_ is not None
        window.add(ranges=ranges_at(window, node_, 2.0 + late * 0.1, late))
    return window


def ranges_at(window: FixedLag, node: int, x: float, stamp: int) -> FloatArray:
    """Ranges with an error that depends on the instant alone."""
    distances = np.hypot(ANCHORS[:, 0] - x, ANCHORS[:, 1] - 5.0) + 0.05 * np.sin(stamp + np.arange(4.0))
    return factors.ranges(window.variable(node), np.arange(4), distances, RANGE_SIGMA)


@pytest.mark.parametrize("late", [1, 4, 8])
def test_what_comes_late_counts_as_if_it_had_been_in_time(late: int) -> None:
    in_time = moving(list(range(1, 10)))
    afterwards = moving([k for k in range(1, 10) if k != late], late)
    covs = [window.update() for window in (in_time, afterwards)]
    for window in (in_time, afterwards):
        window.update()
    np.testing.assert_array_equal(afterwards.stamps_ns, in_time.stamps_ns)
    np.testing.assert_allclose(afterwards.graph.values, in_time.graph.values, atol=1e-4)
    np.testing.assert_allclose(covs[1], covs[0], rtol=1e-3, atol=1e-7)
    for node in (2, 9):
        state, cov = afterwards.state_of(node)
        np.testing.assert_allclose(
            state, in_time.graph.values[4 + 2 * node : 6 + 2 * node].ravel(), atol=1e-4
        )
        np.testing.assert_allclose(cov, in_time.state_of(node)[1], rtol=1e-3, atol=1e-7)


def test_nothing_can_be_put_before_or_behind_the_window() -> None:
    window = moving([1, 2, 3])
    assert window.interpolate(-1) is None
    assert window.interpolate(4 * STEP_NS) is None


def test_a_window_that_nothing_holds_says_so_and_stays_as_it_was() -> None:
    window = FixedLag(KNOWN, 1)
    window.insert(0, np.array([[5.0, 5.0, 0.0]]))
    window.add(ranges=factors.ranges(4, [0, 1], [7.0, 7.0], 0.1))
    with pytest.raises(GraphError):
        window.update()
    np.testing.assert_array_equal(window.newest, [[5.0, 5.0, 0.0]])
    window.add(priors=factors.headings(4, 0.0, 0.1))
    window.update()
    assert (window.newest != [[5.0, 5.0, 0.0]]).any()


def test_the_pose_of_a_reference_is_told_along_with_the_newest_state() -> None:
    window = moving([1, 2, 3, 4])
    cov = window.update(reference=2)
    assert cov.shape == (9, 9)
    np.testing.assert_allclose(cov[:6, :6], window.state_of(4)[1], rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(cov[6:, 6:], window.state_of(2)[1][:3, :3], rtol=1e-3, atol=1e-6)
    assert (np.abs(np.linalg.eigvalsh(cov)) > 0.0).all()
