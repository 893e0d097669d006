"""Rows of the graph: the same problems solved by GTSAM as its users drive it, building included."""

from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import numpy as np

from estimators.geometry import compose
from estimators.graph import factors
from estimators.graph.fixed_lag import FixedLag
from estimators.graph.solver import solve
from tests.estimators.graph.drives import ANCHORS, RANGE_SIGMA, STEP_SIGMA, Drive, drive, graph_of
from tools.bench.rows import Benchmark, Run

try:
    import gtsam
    from gtsam.symbol_shorthand import L, X

    from tests.estimators.graph.gtsam_graphs import gtsam_graph
except ImportError:  # an extra
    gtsam = None  # type: ignore[assignment]

WINDOW, UPDATES = 200, 500
"""Poses in the window; updates of a run, which begins with an empty window."""
STEP_NS = 100_000_000


def batch_1000() -> Benchmark:
    """A thousand poses with four ranges each."""
    return _batch(1000)


def batch_10000() -> Benchmark:
    """Ten thousand: ten times the work of a thousand where time grows with length alone."""
    return _batch(10_000)


def _batch(count: int) -> Benchmark:
    chain = drive(count, seed=1)
    peers: dict[str, Run] = {}
    if gtsam is not None:
        name = f"gtsam {version('gtsam')}"
        peers = {
            f"{name} GaussNewtonOptimizer": lambda: gtsam.GaussNewtonOptimizer(
                *gtsam_graph(chain)
            ).optimize(),
            f"{name} LevenbergMarquardtOptimizer": lambda: gtsam.LevenbergMarquardtOptimizer(
                *gtsam_graph(chain)
            ).optimize(),
        }
    return Benchmark("ms/solution", "lower", 1e-3, lambda: solve(graph_of(chain)), peers)


def fixed_lag_200_vs_incremental() -> Benchmark:
    """A window of 200 poses, four ranges each, beside iSAM2 with a lag."""
    return _fixed_lag(
        "IncrementalFixedLagSmoother", lambda smoother, key: smoother.calculateEstimatePose2(key)
    )


def fixed_lag_200_vs_batch() -> Benchmark:
    """The same beside GTSAM's window that is solved anew at every update."""
    return _fixed_lag(
        "BatchFixedLagSmoother", lambda smoother, key: smoother.calculateEstimate().atPose2(key)
    )


def _fixed_lag(peer: str, pose_of: Callable[..., Any]) -> Benchmark:
    chain = drive(UPDATES, seed=2)
    peers: dict[str, Run] = {}
    if gtsam is not None:
        peers[f"gtsam {version('gtsam')} {peer}"] = lambda: _gtsam_window(
            chain, getattr(gtsam, peer)(float(WINDOW)), pose_of
        )
    return Benchmark("ms/update", "lower", UPDATES / 1e3, lambda: _window(chain), peers)


def _window(chain: Drive) -> FixedLag:
    window = FixedLag(np.column_stack([ANCHORS, np.zeros(len(ANCHORS))]), width=1)
    window.begin(0, chain.truth[:1], np.eye(3) * 0.25)
    anchors, cov = np.arange(len(ANCHORS)), np.diag(STEP_SIGMA**2)
    for k, ranges in enumerate(chain.ranges):
        if k:
            node = window.insert(k * STEP_NS, compose(window.newest[0], chain.steps[k - 1])[None])
            ends = window.variable(node - 1), window.variable(node)
            window.add(increments=factors.increments(*ends, chain.steps[k - 1], cov))
        newest = window.variable(len(window.stamps_ns) - 1)
        window.add(ranges=factors.ranges(newest, anchors, ranges, RANGE_SIGMA))
        window.update()
        window.drop_before((k - WINDOW) * STEP_NS)
    return window


def _gtsam_window(chain: Drive, smoother: Any, pose_of: Callable[..., Any]) -> Any:
    of_step = gtsam.noiseModel.Diagonal.Sigmas(STEP_SIGMA)
    of_range = gtsam.noiseModel.Isotropic.Sigma(1, RANGE_SIGMA)
    pose = gtsam.Pose2(*chain.truth[0])
    for k, ranges in enumerate(chain.ranges):
        graph, values, stamps = gtsam.NonlinearFactorGraph(), gtsam.Values(), {X(k): float(k)}
        if k:
            step = gtsam.Pose2(*chain.steps[k - 1])
            pose = pose.compose(step)
            graph.add(gtsam.BetweenFactorPose2(X(k - 1), X(k), step, of_step))
        else:
            wide, tight = (gtsam.noiseModel.Isotropic.Sigma(n, s) for n, s in ((3, 0.5), (2, 1e-6)))
            graph.add(gtsam.PriorFactorPose2(X(0), pose, wide))
            for i, anchor in enumerate(ANCHORS):
                values.insert(L(i), anchor)
                graph.add(gtsam.PriorFactorPoint2(L(i), anchor, tight))
        values.insert(X(k), pose)
        for i, measured in enumerate(ranges):
            graph.add(gtsam.RangeFactor2D(X(k), L(i), measured, of_range))
            stamps[L(i)] = float(k)  # or it would forget the anchor
        smoother.update(graph, values, stamps)
        pose = pose_of(smoother, X(k))
    return pose


BENCHMARKS: dict[str, Callable[[], Benchmark]] = {
    "smoother_batch_1000": batch_1000,
    "smoother_batch_10000": batch_10000,
    "smoother_fixed_lag_200_vs_batch": fixed_lag_200_vs_batch,
    "smoother_fixed_lag_200_vs_incremental": fixed_lag_200_vs_incremental,
}
