"""Nodes that are solved for without the rest of the window: the same optimum, and not for long."""

from typing import Any

import gtsam
import numpy as np
import pytest

from estimators.geometry import compose
from estimators.graph import factors
from estimators.graph.fixed_lag import FixedLag
from estimators.messages import FloatArray, IntArray
from tests.estimators.graph.drives import ANCHORS, RANGE_SIGMA, STEP_SIGMA, Drive, drive

KNOWN = np.column_stack([ANCHORS, np.zeros(len(ANCHORS))])
START = np.diag([0.3, 0.3, 0.1]) ** 2
COV = np.diag(STEP_SIGMA**2)
EXACTLY = (20, 1e-10)
"""Steps and tolerance with which a window is solved as a whole, to the end, at every update."""


class Watched(FixedLag):
    """A window that counts how often it is solved as a whole."""

    solved = 0

    def _solve_all(self, asked: IntArray, iterations: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        self.solved += 1
        return super()._solve_all(asked, iterations)


def begun(*search: float) -> Watched:
    """Window with its first node, which is the truth of every drive."""
    window = Watched(KNOWN, 1, *search)  # type: ignore[arg-type]
    window.begin(0, drive(1, seed=0).truth[:1], START)
    return window


def take(window: FixedLag, chain: Drive, k: int) -> FloatArray:
    """Give the window a step of a drive; covariance of its newest pose."""
    if k:
        node = window.insert(k, compose(window.newest[0], chain.steps[k - 1])[None])
        ends = window.variable(node - 1), window.variable(node)
        window.add(increments=factors.increments(*ends, chain.steps[k - 1], COV))
    newest = window.variable(len(window.stamps_ns) - 1)
    window.add(ranges=factors.ranges(newest, np.arange(len(ANCHORS)), chain.ranges[k], RANGE_SIGMA))
    return window.update()


def newest_poses(chain: Drive, *search: float) -> tuple[FloatArray, FloatArray, int]:
    """After every step the newest pose (N, 3) and its sigmas (N, 3); how often all was solved."""
    window = begun(*search)
    poses, covs = [], []
    for k in range(len(chain.ranges)):
        covs.append(take(window, chain, k))
        poses.append(window.newest[0].copy())
    return np.array(poses), np.sqrt(np.diagonal(covs, axis1=1, axis2=2)), window.solved


def incremental_poses_of_gtsam(chain: Drive) -> FloatArray:
    """The same (N, 2), x and y alone, by iSAM2 as GTSAM ships it."""
    smoother = gtsam.IncrementalFixedLagSmoother(1e3)
    of_step = gtsam.noiseModel.Diagonal.Sigmas(STEP_SIGMA)
    of_range = gtsam.noiseModel.Isotropic.Sigma(1, RANGE_SIGMA)
    at, poses, count = gtsam.Pose2(*chain.truth[0]), [], len(ANCHORS)
    for k, measured in enumerate(chain.ranges):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        stamps: Any = {}
        if k:
            step = gtsam.Pose2(*chain.steps[k - 1])
            at = at.compose(step)
            graph.add(gtsam.BetweenFactorPose2(count + k - 1, count + k, step, of_step))
        else:
            of_start = gtsam.noiseModel.Diagonal.Sigmas(np.sqrt(np.diag(START)))
            graph.add(gtsam.PriorFactorPose2(count, at, of_start))
            for i, anchor in enumerate(ANCHORS):
                values.insert(i, anchor)
                graph.add(gtsam.PriorFactorPoint2(i, anchor, gtsam.noiseModel.Isotropic.Sigma(2, 1e-6)))
        values.insert(count + k, at)
        for i, slant in enumerate(measured):
            graph.add(gtsam.RangeFactor2D(count + k, i, slant, of_range))
            stamps[i] = float(k)
        stamps[count + k] = float(k)
        smoother.update(graph, values, stamps)
        at = smoother.calculateEstimatePose2(count + k)
        poses.append([at.x(), at.y()])
    return np.array(poses)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_newest_poses_are_nearer_to_the_optimum_than_those_of_isam2(seed: int) -> None:
    chain = drive(100, seed)
    exact, sigma, _ = newest_poses(chain, *EXACTLY)
    poses, _, solved = newest_poses(chain)
    off = np.abs(poses - exact) / sigma
    off_peer = np.abs(incremental_poses_of_gtsam(chain) - exact[:, :2]) / sigma[:, :2]
    assert off.max() < 0.1
    assert off[:, :2].max() < 0.5 * off_peer.max()
    assert solved < 35  # of 100


def test_where_nothing_bends_newest_poses_are_the_optimum() -> None:
    """Without noise no node moves, and all is as good as linear."""
    chain = drive(40, seed=4, noise=0.0)
    exact, sigma_exact, _ = newest_poses(chain, *EXACTLY)
    poses, sigma, solved = newest_poses(chain)
    np.testing.assert_allclose(poses, exact, atol=1e-6)
    np.testing.assert_allclose(sigma, sigma_exact, rtol=1e-4)
    assert solved <= 1 + 40 // 10


@pytest.mark.parametrize("old", [3, 20])
def test_a_factor_that_goes_further_back_is_taken_at_once(old: int) -> None:
    """The robot came round, and sees an old place again."""
    chain = drive(24, seed=6, noise=0.0)
    windows = begun(), begun(*EXACTLY)
    for window in windows:
        for k in range(24):
            take(window, chain, k)
        if not window._has_new():
            pytest.fail("the newest nodes are to be solved alone before the closure comes")
        there, here = window.variable(old), window.variable(23)
        step = compose(inverse_of(window.graph.values[there]), window.graph.values[here])
        window.add(increments=factors.increments(there, here, step + np.array([0.05, -0.02, 0.0]), 0.1 * COV))
        window.update()
        window.update()
    np.testing.assert_allclose(windows[0].graph.values, windows[1].graph.values, atol=1e-4)
    assert np.abs(windows[0].newest[0] - chain.truth[-1]).max() > 5e-3


def inverse_of(pose: FloatArray) -> FloatArray:
    """Pose (3,) as seen from where it leads."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([-c * pose[0] - s * pose[1], s * pose[0] - c * pose[1], -pose[2]])


def test_what_is_to_leave_waits_until_all_is_solved() -> None:
    chain, window = drive(60, seed=7, noise=0.0), begun()
    lengths, left = [], []
    for k in range(60):
        take(window, chain, k)
        alone = window._has_new()
        left.append(window.drop_before(k - 20))
        assert not (left[-1] and alone)
        lengths.append(len(window.stamps_ns))
    assert any(left)
    assert max(lengths) <= 20 + 1 + 10 + 1
    assert lengths[-1] > 15


def test_a_reference_that_was_not_asked_for_before_is_told_all_the_same() -> None:
    chain, window = drive(14, seed=8, noise=0.0), begun()
    for k in range(14):
        take(window, chain, k)
    assert window._has_new()
    cov = window.update(reference=5)
    assert cov.shape == (6, 6)
    np.testing.assert_allclose(cov[3:, 3:], window.state_of(5)[1], rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(cov[:3, :3], window.state_of(13)[1], rtol=1e-3, atol=1e-9)
    # From now on it is, and the nodes that follow are solved alone with it.
    before = window.solved
    ahead = compose(window.newest[0], chain.steps[-1])
    window.insert(14, ahead[None])
    ends = window.variable(5), window.variable(14)
    seen = compose(inverse_of(window.graph.values[ends[0]]), ahead)
    window.add(increments=factors.increments(*ends, seen, COV))
    window.update(reference=5)
    assert window.solved == before
    np.testing.assert_allclose(window.newest[0], ahead, atol=1e-3)


def test_what_comes_late_between_the_newest_nodes_is_taken_as_by_a_window_solved_as_a_whole() -> None:
    """The robot stands, so that nothing but the numbers of the nodes tells them apart."""
    states = []
    for search in ((), EXACTLY):
        window = FixedLag(KNOWN, 2, *search)
        state = np.array([[5.0, 4.0, 0.3], [0.0, 0.0, 0.0]])
        window.begin(0, state, np.diag([0.1, 0.1, 0.1, 0.01, 0.01, 0.01]) ** 2)
        for k in range(1, 7):
            node = window.insert(k * 10**9, state)
            ends = window.variable(node - 1), window.variable(node)
            window.add(motions=factors.motions(*ends, 1.0, 0.5, 1.5))
            if k == 3:
                window.update()
        late = window.interpolate(25 * 10**8)
        assert late is not None
        distances = np.hypot(*(ANCHORS - state[0, :2]).T) + np.array([0.03, -0.02, 0.02, 0.01])
        at = window.variable(late)
        window.add(ranges=factors.ranges(at, np.arange(len(ANCHORS)), distances, RANGE_SIGMA))
        cov = window.update()
        states.append((window.newest.copy(), cov))
    np.testing.assert_allclose(states[0][0], states[1][0], atol=1e-4)
    np.testing.assert_allclose(states[0][1], states[1][1], rtol=1e-3, atol=1e-6)


def test_all_is_solved_anew_when_the_newest_nodes_draw_old_ones_far_away() -> None:
    window = Watched(KNOWN, 2)
    state = np.array([[5.0, 4.0, 0.3], [0.0, 0.0, 0.0]])
    window.begin(0, state, np.diag([0.3, 0.3, 0.1, 0.01, 0.01, 0.01]) ** 2)
    window.update()
    for k, (shift, solved) in enumerate([(0.0, 1), (0.5, 2)], start=1):
        node = window.insert(k * 10**8, state)
        window.add(motions=factors.motion(window.variable(node - 1), window.variable(node), 0.1, 0.5, 1.5))
        distances = np.hypot(*(ANCHORS - state[0, :2] - [shift, 0.0]).T)
        window.add(ranges=factors.ranges(window.variable(node), np.arange(len(ANCHORS)), distances, 0.1))
        window.update()
        assert window.solved == solved
