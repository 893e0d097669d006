"""Covariances of a drive that is long enough for rounding errors to grow, were they left to."""

import numpy as np

from estimators.graph.recording import Noise, Recording
from estimators.graph.solver import solve
from estimators.kernels import block_cholesky
from estimators.messages import FloatArray, IntArray, PoseIncrement, RangeFrame
from tests.estimators.matched_world import HALL, true_increment, true_ranges

RANGES_NS = np.arange(0, 60 * 10**9, 40_000_000)
SCANS_NS = np.arange(33_750_000, 60 * 10**9, 100_000_000)
"""A few milliseconds beside ranges: over these the motion is nearly certain."""
SCANS_TO_A_KEYFRAME = 5
STEP_COV = np.diag([0.003, 0.003, 0.001]) ** 2


def circle(stamps_ns: IntArray) -> FloatArray:
    """Poses (N, 3) on a circle of 2 m."""
    turn = 0.3e-9 * stamps_ns
    return np.column_stack([2.0 * np.sin(turn), 2.0 - 2.0 * np.cos(turn), turn])


def test_covariances_of_a_long_drive_are_blocks_of_the_whole_inverse() -> None:
    ranged = zip(RANGES_NS.tolist(), circle(RANGES_NS), strict=True)
    measured: list[RangeFrame | PoseIncrement] = [true_ranges(ns, pose, HALL) for ns, pose in ranged]
    scanned = list(zip(SCANS_NS.tolist(), circle(SCANS_NS), strict=True))
    for number, (ns, pose) in enumerate(scanned[1:]):
        from_ns, reference = scanned[number - number % SCANS_TO_A_KEYFRAME]
        step = true_increment(reference, pose)
        measured.append(PoseIncrement(from_ns, ns, step, STEP_COV, is_keyframe=True))
    recording = Recording(measured, HALL, Noise(range_sigma=0.1, accel=0.5, yaw_accel=1.5))
    graph = recording.graph(circle(recording.stamps_ns), find_anchors=False, find_biases=False)
    solution = solve(graph)
    found = solution.covariances(graph.free)
    order, starts, rows, _ = solution.system
    for variable in np.flatnonzero(order >= 0)[::200]:
        expected = np.zeros((3, 3))
        for i in range(3):
            column = np.zeros((len(starts) - 1, 3))
            column[order[variable], i] = 1.0
            block_cholesky.solve_down(starts, rows, *solution.factor, column, len(column))
            block_cholesky.solve_up(starts, rows, *solution.factor, column)
            expected[:, i] = column[order[variable]]
        np.testing.assert_allclose(found[variable], expected, rtol=1e-6, atol=1e-9 * expected.max())
