"""Places found in a map whose truth is known, with ranges and without; a symmetric room is told as such."""

from functools import cache

import numpy as np
import pytest
from scipy.ndimage import maximum_filter

from estimators.base import Setup, Start
from estimators.geometry import transform, wrap_angle
from estimators.lidar.relocalisation import LEVELS, Finding, Relocaliser, _pyramid
from estimators.messages import FloatArray, RangeFrame
from tests.estimators.lidar.room_scans import cast, drawn, rectangle

ANCHORS = {1: np.array([0.1, 0.1, 2.0]), 2: np.array([9.9, 0.1, 2.0]), 3: np.array([0.1, 9.9, 2.0])}
SETUP = Setup(ANCHORS, np.array([0.05, 0.0, 0.2]), Start(np.zeros(3), np.ones(3)), 0.3, 0.05, 0.05)
EMPTY = rectangle(0.0, 0.0, 10.0, 10.0)
FURNISHED = np.vstack(
    [
        EMPTY,
        rectangle(1.4, 2.7, 2.6, 3.3),
        rectangle(6.6, 1.6, 7.4, 2.4),
        rectangle(8.2, 6.0, 8.8, 8.0),
        rectangle(3.0, 8.2, 5.0, 8.7),
        rectangle(4.8, 4.8, 5.2, 5.2),
    ]
)
INSIDE_BOXES = [(1.4, 2.7, 2.6, 3.3), (6.6, 1.6, 7.4, 2.4), (8.2, 6.0, 8.8, 8.0), (3.0, 8.2, 5.0, 8.7)]
INSIDE_BOXES.append((4.8, 4.8, 5.2, 5.2))


@cache
def searcher(*, furnished: bool) -> Relocaliser:
    floor = drawn(FURNISHED if furnished else EMPTY, np.array([-0.2, -0.2, 0.0]))
    return Relocaliser(Relocaliser.Config(), floor, SETUP)


def scan_at(walls: FloatArray, pose: FloatArray, rng: np.random.Generator) -> FloatArray:
    angles = 2.0 * np.pi * np.arange(360) / 360
    directions = np.column_stack([np.cos(pose[2] + angles), np.sin(pose[2] + angles)])
    ranges = cast(walls, np.broadcast_to(pose[:2], (360, 2)), directions)
    seen = ranges > 0.0
    ranges = ranges[seen] + rng.normal(0.0, 0.015, int(seen.sum()))
    points: FloatArray = ranges[:, None] * np.column_stack([np.cos(angles[seen]), np.sin(angles[seen])])
    return points


def ranges_at(pose: FloatArray, rng: np.random.Generator, blocked: int | None = None) -> RangeFrame:
    tag = np.array([*transform(pose, SETUP.tag_in_body[None, :2])[0], 0.5])
    ranges = np.array([float(np.linalg.norm(a - tag)) for a in ANCHORS.values()])
    ranges += rng.normal(0.0, 0.1, 3)
    if blocked is not None:
        ranges[blocked] += 3.0
    return RangeFrame(0, 1, np.array(list(ANCHORS)), ranges, np.full(3, np.nan), np.full(3, np.nan))


def random_pose(rng: np.random.Generator) -> FloatArray:
    while True:
        x, y, yaw = rng.uniform([0.4, 0.4, -np.pi], [9.6, 9.6, np.pi])
        if not any(x0 - 0.3 < x < x1 + 0.3 and y0 - 0.3 < y < y1 + 0.3 for x0, y0, x1, y1 in INSIDE_BOXES):
            return np.array([x, y, yaw])


def error(found: FloatArray, pose: FloatArray) -> tuple[float, float]:
    return float(np.hypot(*(found - pose)[:2])), abs(np.rad2deg(wrap_angle(found[2] - pose[2])))


def test_places_in_a_furnished_room_are_found_with_three_ranges() -> None:
    rng = np.random.default_rng(1)
    right = 0
    for _ in range(6):
        pose = random_pose(rng)
        result = searcher(furnished=True).locate(scan_at(FURNISHED, pose, rng), ranges_at(pose, rng))
        assert result.finding is Finding.FOUND
        distance, turn = error(result.candidates[0].pose, pose)
        right += distance < 0.1 and turn < 2.0
    assert right == 6


def test_without_ranges_what_is_called_found_is_right() -> None:
    rng = np.random.default_rng(2)
    findings = []
    for _ in range(6):
        pose = random_pose(rng)
        result = searcher(furnished=True).locate(scan_at(FURNISHED, pose, rng))
        findings.append(result.finding)
        if result.finding is Finding.FOUND:
            distance, turn = error(result.candidates[0].pose, pose)
            assert distance < 0.1
            assert turn < 2.0
    assert findings.count(Finding.FOUND) >= 3


def test_a_square_room_without_furniture_is_ambiguous_until_ranges_tell() -> None:
    rng = np.random.default_rng(3)
    pose = np.array([2.5, 3.5, 0.4])
    scan = scan_at(EMPTY, pose, rng)
    alone = searcher(furnished=False).locate(scan)
    assert alone.finding is Finding.AMBIGUOUS
    assert len(alone.candidates) == 4
    assert min(error(candidate.pose, pose)[0] for candidate in alone.candidates) < 0.1
    told = searcher(furnished=False).locate(scan, ranges_at(pose, rng))
    assert told.finding is Finding.FOUND
    assert error(told.candidates[0].pose, pose)[0] < 0.1


def test_ranges_that_fit_no_place_are_not_believed_away() -> None:
    rng = np.random.default_rng(4)
    pose = np.array([2.5, 3.5, 0.4])
    result = searcher(furnished=True).locate(scan_at(FURNISHED, pose, rng), ranges_at(pose, rng, blocked=1))
    assert result.finding is Finding.NOT_FOUND


def test_a_scan_of_another_place_is_not_found() -> None:
    rng = np.random.default_rng(5)
    scan = scan_at(rectangle(-1.0, -1.5, 2.0, 1.5), np.array([0.5, 0.3, 0.0]), rng)
    assert searcher(furnished=True).locate(scan).finding is Finding.NOT_FOUND
    assert searcher(furnished=True).locate(np.empty((0, 2))).finding is Finding.NOT_FOUND


def test_a_map_that_lies_askew_gives_poses_in_the_map_frame() -> None:
    rng = np.random.default_rng(6)
    pose = np.array([3.2, 6.1, -2.0])
    askew = np.array([2.0, -10.5, 0.9])
    search = Relocaliser(Relocaliser.Config(), drawn(FURNISHED, askew), SETUP)
    result = search.locate(scan_at(FURNISHED, pose, rng), ranges_at(pose, rng))
    assert result.finding is Finding.FOUND
    distance, turn = error(result.candidates[0].pose, pose)
    assert distance < 0.1
    assert turn < 2.0


@pytest.mark.parametrize("level", range(LEVELS))
def test_every_level_of_the_pyramid_bounds_the_cells_it_stands_for(level: int) -> None:
    field = np.random.default_rng(0).random((37, 50)).astype(np.float32)
    size = 1 << level
    found = _pyramid(field)[level]
    padded = np.pad(field, ((0, size), (0, size)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (size, size))[:37, :50]
    np.testing.assert_array_equal(found, windows.max(axis=(2, 3)))


def test_the_search_finds_what_trying_everything_finds() -> None:
    from estimators.kernels import pose_search

    rng = np.random.default_rng(7)
    field = maximum_filter((rng.random((40, 40)) ** 30).astype(np.float32), 3)
    cells = rng.integers(-8, 9, (5, 12, 2))
    pyramid = _pyramid(field)
    sums = np.zeros((5, 56, 56))
    padded = np.pad(field, 16)
    for turn in range(5):
        for row, column in cells[turn]:
            sums[turn] += padded[8 + row : 64 + row, 8 + column : 64 + column]
    blocks = pose_search.top_blocks(pyramid, cells, -8, 47, -8, 47)
    blocks = np.ascontiguousarray(blocks[np.argsort(-blocks[:, 0])])
    best, turn, row, column = pose_search.search(pyramid, cells, blocks, np.empty((0, 5), np.int64), 0.0)
    assert best == pytest.approx(sums.max(), rel=1e-6)
    assert sums[turn, row + 8, column + 8] == pytest.approx(best, rel=1e-6)
