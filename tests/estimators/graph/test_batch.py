"""Whole recordings: smoother than any filter, anchors and biases found, blocked ranges left out."""

import csv
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from estimators.base import Setup, Start
from estimators.geometry import between
from estimators.graph import factors
from estimators.graph.batch import Smoothed, smooth
from estimators.graph.errors import GraphError
from estimators.graph.losses import GAUSSIAN
from estimators.graph.recording import Noise, Recording
from estimators.graph.solver import solve
from estimators.messages import FloatArray, IntArray, LandmarkFrame, Measurement, PoseIncrement, RangeFrame
from tests.estimators.matched_world import HALL, pose_error, true_ranges
from tests.strategies import range_frame

STEP_NS = 100_000_000
NOISE = Noise(range_sigma=0.1, accel=0.5, yaw_accel=1.5)
STEP_SIGMA = np.array([0.0015, 0.0015, 0.0007])
"""Of increments every tenth of a second: 5 mm and 0.13 deg from keyframe to keyframe, a second apart."""
DATA = Path(__file__).parents[2] / "data" / "lias_planar"


def course(count: int, radius: float = 3.0) -> FloatArray:
    """Poses (N, 3) of a round through the hall, from its start."""
    angles = np.linspace(0.0, 2.0 * np.pi, count)
    x, y, yaw = HALL.start.pose
    round_trip = radius * np.array([np.sin(angles), 1.0 - np.cos(angles)])
    return np.column_stack([x + round_trip[0], y + round_trip[1], yaw + angles])


def drive(truth: FloatArray, seed: int, biases: dict[int, float] | None = None) -> list[Measurement]:
    """Ranges and increments along a course, each increment from the pose before."""
    rng = np.random.default_rng(seed)
    measured: list[Measurement] = []
    for k, pose in enumerate(truth):
        frame = true_ranges(k * STEP_NS, pose, HALL)
        ids: list[int] = frame.anchor_ids.tolist()
        bias = np.array([(biases or {}).get(i, 0.0) for i in ids])
        slants = frame.ranges + bias + rng.normal(0.0, NOISE.range_sigma, len(ids))
        measured.append(range_frame(k * STEP_NS, ids, slants.tolist()))
        if k:
            step = between(truth[k - 1], pose) + rng.normal(0.0, STEP_SIGMA)
            measured.append(
                PoseIncrement((k - 1) * STEP_NS, k * STEP_NS, step, np.diag(STEP_SIGMA**2), is_keyframe=True)
            )
    return measured


def at_truth(truth: FloatArray, offset: float = 0.0) -> FloatArray:
    return np.asarray(truth + np.array([offset, -offset, 0.1 * offset]))


def aligned(found: FloatArray, truth: FloatArray) -> FloatArray:
    """Points (N, 2) moved and turned, not scaled, to fit others best."""
    a, b = found - found.mean(axis=0), truth - truth.mean(axis=0)
    turn = np.angle(np.sum((b[:, 0] + 1j * b[:, 1]) * np.conj(a[:, 0] + 1j * a[:, 1])))
    turned = (a[:, 0] + 1j * a[:, 1]) * np.exp(1j * turn)
    return np.asarray(np.column_stack([turned.real, turned.imag]) + truth.mean(axis=0))


def places(setup: Setup) -> FloatArray:
    return np.array([anchor[:2] for anchor in setup.anchors.values()], dtype=np.float64)


def displaced(setup: Setup, distance: float, seed: int) -> Setup:
    """Every anchor is somewhere else, in a random direction."""
    angles = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, len(setup.anchors))
    moves = distance * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])
    moved = {i: place + move for (i, place), move in zip(setup.anchors.items(), moves, strict=True)}
    return replace(setup, anchors=moved)


def found_places(found: Smoothed) -> FloatArray:
    return np.array([fix.position for fix in found.anchors.values()])


def test_every_pose_gets_better_by_what_comes_after_it() -> None:
    truth = course(150)
    found = smooth(Recording(drive(truth, 1), HALL, NOISE), lambda _: at_truth(truth, 0.3))
    np.testing.assert_array_equal(found.stamps_ns, STEP_NS * np.arange(150))
    errors = np.array([pose_error(a, b) for a, b in zip(found.poses, truth, strict=True)])
    assert np.sqrt((errors[:, :2] ** 2).sum(axis=1).mean()) < 0.03
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(found.covs), errors)
    assert 0.5 < nees.mean() < 8.0  # one drive: neighbours err alike
    sigma = np.sqrt(np.trace(found.covs[:, :2, :2], axis1=1, axis2=2))
    assert sigma[75] < sigma[0]
    assert all(fix.bias_sigma == 0.0 and not fix.position_cov.any() for fix in found.anchors.values())


def heading_along(x: FloatArray, y: FloatArray) -> FloatArray:
    """Poses (N, 3) of a robot that looks where it goes."""
    return np.column_stack([x, y, np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))])


def all_over_the_hall() -> FloatArray:
    angles = np.linspace(0.0, 2.0 * np.pi, 1500)
    return heading_along(7.0 * np.sin(2.0 * angles), 6.5 * np.sin(3.0 * angles))


def round_each_anchor(radius: float = 1.0, share: float = 1.0) -> FloatArray:
    """Poses (1500, 3): straight from anchor to anchor, and round each, or this share of it from within."""
    inward = np.arctan2(-places(HALL)[:, 1], -places(HALL)[:, 0])
    angles = inward[:, None] + share * np.pi * np.linspace(-1.0, 1.0, 9)
    circles = radius * np.stack([np.cos(angles), np.sin(angles)], axis=2)
    way = (places(HALL)[:, None] + circles).reshape(-1, 2)
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    at = np.linspace(0.0, lengths[-1], 1500)
    window = np.hanning(11) / np.hanning(11).sum()
    padded = (np.pad(np.interp(at, lengths, column), 5, mode="edge") for column in way.T)
    return heading_along(*(np.convolve(column, window, "valid") for column in padded))


BIASES = {10: 0.15, 11: 0.3, 12: 0.2, 13: 0.1}


def survey(truth: FloatArray, seed: int) -> Smoothed:
    """What a drive tells of anchors whose places were known to half a metre."""
    setup = replace(displaced(HALL, 0.5, seed), start=replace(HALL.start, pose=truth[0]))
    recording = Recording(drive(truth, seed, BIASES), setup, NOISE)
    guess = at_truth(truth, 0.1)
    return smooth(recording, lambda _: guess, find_anchors=True, find_biases=True)


def bias_sigmas(truth: FloatArray) -> FloatArray:
    """Cramer-Rao bounds of the biases that a drive tells [m]: the inverse information at the truth."""
    setup = replace(HALL, start=replace(HALL.start, pose=truth[0]))
    recording = Recording(drive(truth, 0), setup, NOISE)
    graph = recording.graph(truth, find_anchors=True, find_biases=True)
    graph.ranges[:, factors.RANGE_LOSS] = GAUSSIAN.kind
    sigmas: FloatArray = np.sqrt(solve(graph).covariances(graph.free)[: len(HALL.anchors), 2, 2])
    return sigmas


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("course", "most_bias"), [(all_over_the_hall, np.inf), (round_each_anchor, 0.03)], ids=["hall", "round"]
)
def test_a_drive_surveys_anchors_and_biases(
    course: Callable[[], FloatArray], most_bias: float, seed: int
) -> None:
    found = survey(course(), seed)
    errors = np.linalg.norm(aligned(found_places(found), places(HALL)) - places(HALL), axis=1)
    assert errors.max() < 0.05
    for anchor_id, fix in found.anchors.items():
        off = abs(fix.bias - BIASES[anchor_id])
        assert off < most_bias
        assert off < 3.0 * fix.bias_sigma < 0.15
        assert fix.residual_rms == pytest.approx(0.1, abs=0.01)
        assert fix.ranges + fix.blocked == 1500


def test_who_sees_an_anchor_from_both_sides_tells_its_bias_from_its_distance() -> None:
    # What moves an anchor along the line of sight a bias does as well, but not for who sees it from behind.
    one_side, inner_half, round_it = map(
        bias_sigmas, [all_over_the_hall(), round_each_anchor(share=0.5), round_each_anchor()]
    )
    assert 0.04 < one_side.max() < 0.05
    assert 0.012 < inner_half.max() < 0.016
    assert 0.007 < round_it.max() < 0.01


def test_blocked_ranges_are_left_out() -> None:
    truth = course(300)
    measured = drive(truth, 5)
    for k, measurement in enumerate(measured):
        if 200 <= k < 280 and isinstance(measurement, RangeFrame):
            measurement.ranges[2] += 0.6
    found = smooth(Recording(measured, HALL, NOISE), lambda _: at_truth(truth, 0.1))
    blocked = {i: fix.blocked for i, fix in found.anchors.items()}
    assert 40 <= blocked[12] < 75
    assert max(blocked[i] for i in (10, 11, 13)) < 45
    errors = np.array([pose_error(a, b) for a, b in zip(found.poses, truth, strict=True)])
    assert np.hypot(*errors[:, :2].T).max() < 0.06


def test_landmarks_count() -> None:
    setup = replace(HALL, landmarks={3: np.array([2.0, 1.0])})
    truth = course(40)
    measured = [m for m in drive(truth, 6) if isinstance(m, PoseIncrement)]
    looks: list[Measurement] = []
    for k, pose in enumerate(truth):
        offset = setup.landmarks[3] - pose[:2]
        bearing = np.arctan2(offset[1], offset[0]) - pose[2]
        ids, distances = np.array([3, 99]), np.array([np.hypot(*offset), 1.0])
        looks.append(LandmarkFrame(k * STEP_NS, ids, distances, np.array([bearing, 0.0]), 0.02, 0.01))
    blind = smooth(Recording(measured, setup, NOISE), lambda _: truth)
    seeing = smooth(Recording([*measured, *looks], setup, NOISE), lambda _: truth)
    assert np.trace(seeing.covs[20][:2, :2]) < 0.5 * np.trace(blind.covs[20][:2, :2])


def test_ranges_of_a_tag_in_the_middle_tell_no_heading() -> None:
    setup, truth = replace(HALL, tag_in_body=np.array([0.0, 0.0, 0.35])), course(300)
    frames = [true_ranges(k * STEP_NS, pose, setup) for k, pose in enumerate(truth)]
    found = smooth(Recording(frames, setup, NOISE), lambda _: at_truth(truth, 0.2))
    assert np.isinf(found.covs[:, 2, 2]).all()
    assert np.hypot(*(found.poses - truth)[:, :2].T).max() < 0.05


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0, 0.0])
def test_impossible_measurements_are_left_out(bad: float) -> None:
    truth = course(30)
    clean = drive(truth, 7)
    odd: list[Measurement] = [
        range_frame(5 * STEP_NS, [10, 77], [bad, 3.0]),
        PoseIncrement(0, 3 * STEP_NS, np.full(3, np.nan), np.eye(3), is_keyframe=False),
        PoseIncrement(0, 3 * STEP_NS, np.zeros(3), -np.eye(3), is_keyframe=False),
    ]
    a, b = (smooth(Recording(m, HALL, NOISE), lambda _: truth) for m in (clean, [*clean, *odd]))
    np.testing.assert_array_equal(a.poses, b.poses)


def test_an_anchor_that_was_never_heard_is_named() -> None:
    truth = course(30)
    setup = replace(HALL, anchors={**HALL.anchors, 44: np.array([1.0, 1.0, 2.0])})
    found = smooth(Recording(drive(truth, 8), setup, NOISE), lambda _: truth)
    assert found.anchors[44].ranges == 0
    with pytest.raises(GraphError, match="anchor 44: no range determines it"):
        smooth(Recording(drive(truth, 8), setup, NOISE), lambda _: truth, find_anchors=True)


def test_an_empty_recording_is_refused() -> None:
    with pytest.raises(GraphError, match="recording: ranges or increments at 1 instants"):
        Recording([range_frame(0, [], [])], HALL, NOISE)


ANCHORS = {
    0: np.array([-3.4203, 3.0053, 1.0442]),
    1: np.array([0.0016, 3.0110, 1.0446]),
    2: np.array([3.6056, 2.9795, 1.0463]),
    3: np.array([3.6011, -0.0008, 1.0422]),
    4: np.array([3.5674, -3.0087, 1.0443]),
    5: np.array([-0.0072, -2.9652, 1.0444]),
    6: np.array([-3.4673, -2.9587, 1.0445]),
    7: np.array([-3.4858, -0.0098, 1.0457]),
}
ARMS = {
    0: np.array([-0.0689, -0.1423, 0.0]),
    1: np.array([-0.0750, 0.1402, 0.0]),
    2: np.array([0.2034, 0.1451, 0.0]),
}


def real_ranges() -> tuple[IntArray, FloatArray]:
    """Instants (K,) and ranges (K, 8, 3) of anchors to tags; NaN where the ranging failed."""
    with (DATA / "uwb_three_tags.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))[1:]
    times = [datetime.strptime(row[0], "%Y-%m-%d %H:%M:%S.%f") for row in rows]
    stamps_ns = [round((time - times[0]).total_seconds() * 1e6) * 1000 for time in times]
    values = [[float(cell) if cell else np.nan for cell in row[1:]] for row in rows]
    return np.array(stamps_ns), np.array(values).reshape(-1, 8, 3)


def first_guess(ranges: FloatArray, at: FloatArray) -> FloatArray:
    """Poses (K, 3) frame by frame: place from differences of squared ranges, heading from those of tags."""
    poses, arms = [], np.array([arm[:2] for arm in ARMS.values()])
    arms = arms - arms.mean(axis=0)
    for frame in ranges:
        mean = np.nanmean(frame, axis=1)
        heard = np.isfinite(mean)
        local = at[heard] - at[heard].mean(axis=0)
        square = (local**2).sum(axis=1) - mean[heard] ** 2
        place = at[heard].mean(axis=0) + np.linalg.lstsq(2.0 * local, square - square.mean(), rcond=None)[0]
        away = (place - at) / np.linalg.norm(place - at, axis=1)[:, None]
        # A tag ahead of the middle by its arm is farther from an anchor by the arm's share away from it.
        c = away @ arms.T
        s = away @ np.array([-arms[:, 1], arms[:, 0]])
        known = np.isfinite(frame)
        longer = (frame - mean[:, None])[known]
        cosine, sine = np.linalg.lstsq(np.column_stack([c[known], s[known]]), longer, rcond=None)[0]
        poses.append([*place, np.arctan2(sine, cosine)])
    return np.array(poses)


@pytest.mark.filterwarnings("ignore:Mean of empty slice")
@pytest.mark.parametrize("seed", range(2))
def test_a_real_drive_without_lidar_surveys_its_anchors(seed: int) -> None:
    stamps_ns, ranges = real_ranges()
    start = Start(np.zeros(3), np.array([10.0, 10.0, 10.0]))
    truth = Setup(ANCHORS, np.zeros(3), start, height=0.965, height_sigma=0.02, level_sigma=0.02, tags=ARMS)
    setup = displaced(truth, 0.5, seed)
    frames = [
        replace(range_frame(int(stamp_ns), list(ANCHORS), frame[:, tag].tolist()), tag_id=tag)
        for stamp_ns, frame in zip(stamps_ns, ranges, strict=True)
        for tag in ARMS
    ]
    guess = first_guess(ranges, places(setup))
    found = smooth(Recording(frames, setup, NOISE), lambda _: guess, find_anchors=True, find_biases=True)
    errors = np.linalg.norm(aligned(found_places(found), places(truth)) - places(truth), axis=1)
    assert errors.max() < 0.15
    # With known anchors the biases are 0.09 to 0.26 m, 0.16 m on average.
    assert np.mean([fix.bias for fix in found.anchors.values()]) == pytest.approx(0.16, abs=0.03)
