"""Drives whose graphs several tests solve: a circle in a room of 10 m, with all that may be measured."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from estimators.geometry import between, compose
from estimators.graph import factors
from estimators.graph.factors import Graph
from estimators.graph.losses import GAUSSIAN, Loss
from estimators.messages import FloatArray, IntArray

ANCHORS = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
RANGE_SIGMA = 0.1
STEP_SIGMA = np.array([0.02, 0.02, 0.01])
SIGHTING_SIGMA = np.array([0.05, 0.02])


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """What was true and what was measured.

    Attributes:
        truth: (N, 3) poses.
        guess: (N, 3) poses that the search begins at.
        steps: (N - 1, 3) increments from pose to pose.
        ranges: (N, 4) to the anchors.
    """

    truth: FloatArray
    guess: FloatArray
    steps: FloatArray
    ranges: FloatArray

    @property
    def poses(self) -> IntArray:
        """Variables of the poses, behind the anchors."""
        return len(ANCHORS) + np.arange(len(self.truth))


def drive(count: int, seed: int, noise: float = 1.0, dt: float = 0.1) -> Drive:
    """A drive round the room; the noise comes from the seed, and is multiplied by `noise`; `dt` [s]."""
    rng = np.random.default_rng(seed)
    times = dt * np.arange(count)
    truth = np.column_stack(
        [5 + 4 * np.cos(0.1 * times), 5 + 4 * np.sin(0.1 * times), 0.1 * times + np.pi / 2]
    )
    steps = np.array([between(a, b) for a, b in pairwise(truth)]).reshape(-1, 3)
    steps += noise * STEP_SIGMA * rng.standard_normal(steps.shape)
    ranges = np.linalg.norm(truth[:, None, :2] - ANCHORS, axis=2)
    ranges += noise * RANGE_SIGMA * rng.standard_normal(ranges.shape)
    guess = truth + np.array([0.1, 0.1, 0.05]) * rng.standard_normal(truth.shape)
    return Drive(truth, guess, steps, ranges)


def graph_of(drive: Drive, loss: Loss = GAUSSIAN) -> Graph:
    """Increments from pose to pose and ranges to known anchors."""
    poses, count = drive.poses, len(ANCHORS)
    values = np.vstack([np.column_stack([ANCHORS, np.zeros(count)]), drive.guess])
    free = np.ones_like(values)
    free[:count] = factors.FIXED
    return Graph(
        values,
        free,
        increments=factors.increments(poses[:-1], poses[1:], drive.steps, np.diag(STEP_SIGMA**2)),
        ranges=factors.ranges(
            np.repeat(poses, count),
            np.tile(np.arange(count), len(poses)),
            drive.ranges.ravel(),
            RANGE_SIGMA,
            loss=loss,
        ),
    )


def closures(drive: Drive, count: int, seed: int) -> tuple[IntArray, IntArray, FloatArray]:
    """Poses (M,), poses seen again from there (M,), and what was measured of the motion between (M, 3)."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, len(drive.truth) // 2, count)
    second = rng.integers(len(drive.truth) // 2, len(drive.truth), count)
    measured = np.array([between(drive.truth[a], drive.truth[b]) for a, b in zip(first, second, strict=True)])
    noise = STEP_SIGMA * rng.standard_normal((count, 3))
    return first, second, np.array([compose(m, n) for m, n in zip(measured, noise, strict=True)])


def with_closures(drive: Drive, graph: Graph, count: int, seed: int) -> Graph:
    """The graph with loop closures behind its increments."""
    first, second, measured = closures(drive, count, seed)
    rows = factors.increments(drive.poses[first], drive.poses[second], measured, np.diag(STEP_SIGMA**2))
    graph.increments = np.concatenate([graph.increments, rows])
    return graph


def sightings(drive: Drive, seed: int) -> tuple[FloatArray, IntArray, IntArray, FloatArray]:
    """Landmarks (L, 2); who sees (M,) which (M,) at which range and bearing (M, 2), within 3 m."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(0.5, 9.5, (30, 2))
    offsets = places - drive.truth[:, None, :2]
    distances = np.hypot(offsets[..., 0], offsets[..., 1])
    seen = distances < 3.0
    places, distances, offsets = places[seen.any(0)], distances[:, seen.any(0)], offsets[:, seen.any(0)]
    who, which = np.nonzero(distances < 3.0)
    bearings = np.arctan2(offsets[who, which, 1], offsets[who, which, 0]) - drive.truth[who, 2]
    measured = np.column_stack([distances[who, which], bearings])
    return places, who, which, measured + SIGHTING_SIGMA * rng.standard_normal(measured.shape)


def with_landmarks(drive: Drive, seed: int) -> tuple[Graph, int]:
    """Graph with landmarks of unknown places between anchors and poses, and how many there are."""
    places, who, which, measured = sightings(drive, seed)
    plain, count, known = graph_of(drive), len(places), len(ANCHORS)
    guess = places + 0.2 * np.random.default_rng(seed).standard_normal(places.shape)
    landmarks = np.column_stack([guess, np.zeros(count)])
    free = np.insert(plain.free, known, np.tile(factors.PLACE, (count, 1)), axis=0)
    increments, ranges = plain.increments.copy(), plain.ranges.copy()
    increments[:, :2] += count
    ranges[:, 0] += count
    rows = factors.sightings(drive.poses[who] + count, known + which, *measured.T, *SIGHTING_SIGMA)
    values = np.insert(plain.values, known, landmarks, axis=0)
    return Graph(values, free, increments=increments, ranges=ranges, sightings=rows), count


def pose_errors(found: FloatArray, reference: FloatArray) -> FloatArray:
    """Differences (N, 3) of poses, yaw as an angle."""
    error = found - reference
    error[:, 2] = np.angle(np.exp(1j * error[:, 2]))
    return error
