"""A whole recording at once: every pose from all that was measured before and after it, anchors if asked for.

What the measurements leave open is where the frame lies (gauge): the start mark holds it as well as the
operator hit it. With anchors to be found, their places in the site file hold it, too, each by
`recording.PLACE_SIGMA`.

Blocked ranges are found in rounds. A one-sided loss keeps them from doing much harm in the first; those that
are then too long, and their neighbours in time, are left out of the next. Loop closures are believed as far
as they go together with the rest (`closures.solve_with_doubtful`).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from estimators.graph import factors
from estimators.graph.closures import solve_with_doubtful
from estimators.graph.errors import GraphError
from estimators.graph.factors import Graph
from estimators.graph.losses import GAUSSIAN
from estimators.graph.recording import Recording
from estimators.graph.solver import Solution
from estimators.immutable import immutable
from estimators.messages import FloatArray, IntArray

BoolArray: TypeAlias = NDArray[np.bool_]

_BLOCKED = 3.0
"""A range that is too long by so many standard deviations after all is solved was blocked."""
_BLOCKED_FOR_NS = 500_000_000
"""So are its anchor's ranges this long before and after."""
_ROUNDS = 6


@immutable
class AnchorFix:
    """What a recording says of an anchor.

    Attributes:
        position: (2,) [m], map frame.
        position_cov: (2, 2) [m^2]; zero if it was known.
        bias: of its ranges [m].
        bias_sigma: its standard deviation [m]; zero if it was known.
        ranges: that were used.
        blocked: ranges that were left out.
        residual_mean: measured minus predicted, of the ranges used [m]; NaN without any.
        residual_rms: the same, root mean square [m].
    """

    position: FloatArray
    position_cov: FloatArray
    bias: float
    bias_sigma: float
    ranges: int
    blocked: int
    residual_mean: float
    residual_rms: float


@immutable
class Smoothed:
    """The most likely course of a recording.

    Attributes:
        stamps_ns: (K,) instants.
        poses: (K, 3) x [m], y [m], yaw [rad], map frame.
        covs: (K, 3, 3) their covariance; infinite variance of a yaw that nothing tells.
        anchors: by id.
        iterations: steps of the solver, all rounds.
        closures: loop closures that were used.
        false_closures: loop closures that contradict the rest.
    """

    stamps_ns: IntArray
    poses: FloatArray
    covs: FloatArray
    anchors: dict[int, AnchorFix]
    iterations: int
    closures: int
    false_closures: int


def smooth(
    recording: Recording,
    guess: Callable[[IntArray], FloatArray],
    find_anchors: bool = False,
    find_biases: bool = False,
    on_round: Callable[[int], None] = lambda _: None,
) -> Smoothed:
    """Find the most likely course of a recording.

    Args:
        recording: what was measured.
        guess: gives poses (K, 3) at instants (K,) [ns] for the search to begin at.
        find_anchors: x and y of the anchors are to be found, too.
        find_biases: biases of the ranges of each anchor are to be found, too.
        on_round: called before each round with its number.

    Raises:
        GraphError: something that the measurements do not determine.

    Source: huang2024 Eq. (29)-(38), over all poses.
    """
    if find_anchors or find_biases:
        # The prior would hold it, but that is no survey.
        for i, anchor_id in enumerate(recording.anchor_ids):
            if not (recording.ranges[:, 1] == i).any():
                raise GraphError(f"anchor {anchor_id}: no range determines it")
    graph = recording.graph(guess(recording.stamps_ns), find_anchors, find_biases)
    # What is left is taken at its face value: a one-sided loss would draw biases down.
    plain = recording.ranges.copy()
    plain[:, factors.RANGE_LOSS] = GAUSSIAN.kind
    solution, used, iterations = None, np.zeros(len(plain), dtype=np.bool_), 0
    believed = np.ones(len(recording.closures))
    for number in range(_ROUNDS):
        on_round(number)
        solution, believed = solve_with_doubtful(graph, recording.closures)
        iterations += solution.iterations
        blocked = _blocked(range_residuals(solution.values, plain) / plain[:, 3], recording)
        if number > 0 and (used == ~blocked).all():
            break
        if number < _ROUNDS - 1:
            used = ~blocked
            graph = replace(graph, values=solution.values, ranges=plain[used])
    assert solution is not None
    return _told(recording, graph, solution, used, iterations, believed)


def range_residuals(values: FloatArray, rows: FloatArray) -> FloatArray:
    """Measured minus predicted (M,) [m] of rows (M, 9) of `factors.ranges` at values (V, 3) of variables."""
    poses, anchors = values[rows[:, 0].astype(np.int64)], values[rows[:, 1].astype(np.int64)]
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    dx = poses[:, 0] + c * rows[:, 4] - s * rows[:, 5] - anchors[:, 0]
    dy = poses[:, 1] + s * rows[:, 4] + c * rows[:, 5] - anchors[:, 1]
    return np.asarray(rows[:, 2] - np.sqrt(dx**2 + dy**2 + rows[:, 6] ** 2) - anchors[:, 2])


def _blocked(residuals: FloatArray, recording: Recording) -> BoolArray:
    """Which ranges (M,) are too long, in standard deviations, or near one in time that is."""
    blocked = np.zeros(len(residuals), dtype=np.bool_)
    for anchor in range(len(recording.anchor_ids)):
        of_anchor = recording.ranges[:, 1] == anchor
        stamps_ns = recording.range_stamps_ns[of_anchor]
        long_ns = np.sort(stamps_ns[residuals[of_anchor] > _BLOCKED])
        if len(long_ns):
            after = np.clip(np.searchsorted(long_ns, stamps_ns), 1, len(long_ns))
            nearest = np.minimum(
                np.abs(stamps_ns - long_ns[after - 1]),
                np.abs(stamps_ns - long_ns[np.minimum(after, len(long_ns) - 1)]),
            )
            blocked[of_anchor] = nearest <= _BLOCKED_FOR_NS
    return blocked


def _told(
    recording: Recording,
    graph: Graph,
    solution: Solution,
    used: BoolArray,
    iterations: int,
    believed: FloatArray,
) -> Smoothed:
    covs, residuals = solution.covariances(graph.free), range_residuals(solution.values, recording.ranges)
    anchors = {}
    for i, anchor_id in enumerate(recording.anchor_ids):
        mine = recording.ranges[:, 1] == i
        kept = residuals[mine & used]
        anchors[anchor_id] = AnchorFix(
            position=solution.values[i, :2],
            position_cov=covs[i, :2, :2],
            bias=float(solution.values[i, 2]),
            bias_sigma=float(np.sqrt(covs[i, 2, 2])),
            ranges=len(kept),
            blocked=int((mine & ~used).sum()),
            residual_mean=float(kept.mean()) if len(kept) else np.nan,
            residual_rms=float(np.sqrt((kept**2).mean())) if len(kept) else np.nan,
        )
    of_poses = slice(len(graph.values) - 2 * len(recording.stamps_ns), None, 2)
    pose_covs = covs[of_poses].copy()
    if not recording.heading_known:
        pose_covs[:, 2, 2] = np.inf
    closures = int((believed > 0.5).sum())
    return Smoothed(
        recording.stamps_ns,
        solution.values[of_poses],
        pose_covs,
        anchors,
        iterations,
        closures,
        len(believed) - closures,
    )
