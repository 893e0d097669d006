"""The piece of way that increments and ranges make: where each range was measured, and what breaks it."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.base import Verdict
from estimators.geometry import between, compose, transform
from estimators.messages import FloatArray, Measurement, PoseIncrement, RangeFrame
from estimators.range_gate import HorizontalRanges
from estimators.relocation.window import MOST_RANGES, Window
from tests.estimators.relocation.wandering_robot import ROOM, SECOND_NS, Robot
from tests.strategies import range_frame

SMALL = np.diag([1e-6, 1e-6, 1e-6])


def window(length: float = 5.0) -> Window:
    return Window(length, HorizontalRanges(0.1, ROOM), ROOM)


def step(from_tenths: int, to_tenths: int, x: float, is_keyframe: bool) -> PoseIncrement:
    tenth = SECOND_NS // 10
    return PoseIncrement(from_tenths * tenth, to_tenths * tenth, np.array([x, 0.0, 0.0]), SMALL, is_keyframe)


def founding(tenths: int) -> PoseIncrement:
    stamp_ns = tenths * SECOND_NS // 10
    return PoseIncrement(stamp_ns, stamp_ns, np.zeros(3), np.zeros((3, 3)), is_keyframe=True)


def frame(milliseconds: int) -> RangeFrame:
    return range_frame(milliseconds * 1_000_000, [1, 2], [4.0, 5.0])


def tags_of(way: Window, age: float = 5.0) -> FloatArray:
    placed = way.ranges_since(age)
    assert placed is not None
    return placed.tags


def take(way: Window, *measurements: Measurement) -> None:
    for measurement in measurements:
        if isinstance(measurement, RangeFrame):
            way.add_ranges(measurement)
        elif isinstance(measurement, PoseIncrement):
            way.add_increment(measurement)


def test_tags_lie_where_they_were_seen_from_the_newest_keyframe() -> None:
    robot, way = Robot(ROOM, 1), window()
    truths = []
    keyframe = robot.pose
    for _ in range(40):
        for measurement in robot.walk(0.1):
            take(way, measurement)
            if isinstance(measurement, PoseIncrement) and measurement.is_keyframe:
                keyframe = robot.pose
        truths.append(robot.pose)
    # A frame waits for the increment after it: the newest is not placed, nor is there one before the first.
    expected = [transform(between(keyframe, pose), ROOM.tag_in_body[None, :2])[0] for pose in truths[:-1]]
    found = tags_of(way)[::4]
    np.testing.assert_allclose(found, expected, atol=0.12)
    np.testing.assert_allclose(found[-5:], expected[-5:], atol=0.03)


def test_a_range_between_two_increments_is_placed_between_them_in_proportion_to_time() -> None:
    way = window()
    take(way, founding(0), step(0, 1, 0.1, False), frame(125), step(0, 2, 0.3, False))
    np.testing.assert_allclose(tags_of(way)[0] - ROOM.tag_in_body[:2], [0.15, 0.0], atol=1e-12)


def test_keyframes_are_chained() -> None:
    way = window()
    take(way, founding(0), frame(0), step(0, 1, 0.1, True), step(1, 2, 0.2, True), step(2, 3, 0.4, False))
    placed = way.ranges_since(5.0)
    assert placed is not None
    np.testing.assert_allclose(placed.tags[0] - ROOM.tag_in_body[:2], [-0.3, 0.0], atol=1e-12)
    np.testing.assert_array_equal(placed.steps, [2, 2])
    np.testing.assert_allclose(placed.step_ends, [[0.0, 0.0], [-0.2, 0.0]], atol=1e-12)
    np.testing.assert_allclose(way.newest_pose, [0.4, 0.0, 0.0])
    assert way.keyframe_ns == 2 * SECOND_NS // 10
    assert [increment.stamp_ns for increment in way.since_keyframe] == [3 * SECOND_NS // 10]


@pytest.mark.parametrize(
    "broken",
    [founding(2), step(1, 2, 0.1, True), replace(step(0, 2, 0.1, False), increment=np.full(3, np.nan))],
    ids=["odometry begins anew", "unknown reference", "no number"],
)
def test_what_does_not_hang_together_begins_a_new_way(broken: PoseIncrement) -> None:
    way = window()
    take(way, founding(0), frame(50), step(0, 1, 0.1, False))
    assert way.ranges_since(5.0) is not None
    take(way, broken)
    assert way.ranges_since(5.0) is None


def test_only_the_last_seconds_are_kept_and_asked_for() -> None:
    way = window(1.0)
    take(way, founding(0))
    for k in range(1, 31):
        take(way, frame(100 * k - 50), step(0, k, 0.1 * k, False))
    assert len(tags_of(way)) == 20
    assert len(tags_of(way, 0.5)) == 10
    np.testing.assert_allclose(tags_of(way)[-1] - ROOM.tag_in_body[:2], [2.95, 0.0], atol=1e-9)


def test_ranges_in_a_gap_of_the_scans_have_no_place() -> None:
    way = window()
    take(way, founding(0), frame(300), step(0, 6, 0.1, False))
    assert way.ranges_since(5.0) is None
    take(way, frame(650), step(0, 7, 0.2, False))
    assert len(tags_of(way)) == 2


def test_many_ranges_are_thinned_by_whole_frames() -> None:
    way = window()
    take(way, founding(0))
    for k in range(1, 400):
        take(way, frame(10 * k), step(0, k // 10, 0.0, False)) if k % 10 == 0 else take(way, frame(10 * k))
    placed = way.ranges_since(5.0)
    assert placed is not None
    assert 0.5 * MOST_RANGES < len(placed.ranges) <= MOST_RANGES
    assert np.count_nonzero(placed.anchor_ids == 1) == np.count_nonzero(placed.anchor_ids == 2)


def test_verdicts_name_what_cannot_be_used() -> None:
    way = window()
    assert way.add_increment(founding(5)) is Verdict.WAITING
    assert way.add_increment(founding(4)) is Verdict.LATE
    assert way.add_ranges(frame(400)) == [Verdict.LATE, Verdict.LATE]
    bad = range_frame(SECOND_NS, [1, 77, 2], [4.0, 4.0, -1.0])
    assert way.add_ranges(bad) == [Verdict.WAITING, Verdict.UNKNOWN_ANCHOR, Verdict.IMPOSSIBLE]
    assert way.add_increment(replace(step(5, 11, 0.1, False), cov=np.zeros((3, 3)))) is Verdict.IMPOSSIBLE


def test_what_can_be_used_of_a_frame_is_placed() -> None:
    way = window()
    bad = range_frame(50_000_000, [77, 1, 3, 2], [4.0, 4.0, np.nan, 5.0])
    take(way, founding(0), bad, step(0, 1, 0.1, False))
    placed = way.ranges_since(5.0)
    assert placed is not None
    np.testing.assert_array_equal(placed.anchor_ids, [1, 2])
    np.testing.assert_array_equal(placed.anchors, [ROOM.anchors[i][:2] for i in (1, 2)])
    assert np.isfinite(placed.sigmas).all()


def test_between_two_headings_a_tag_turns_the_shorter_way() -> None:
    way = window()
    turns = [
        replace(step(0, k, 0.0, False), increment=np.array([0.0, 0.0, yaw]))
        for k, yaw in ((1, 3.1), (2, -3.1))
    ]
    take(way, founding(0), turns[0], frame(150), turns[1])
    np.testing.assert_allclose(tags_of(way)[0], -ROOM.tag_in_body[:2], atol=1e-12)


def test_every_step_since_a_range_adds_its_shift_and_its_turn_by_the_distance_from_its_end() -> None:
    rng, way = np.random.default_rng(4), window()
    take(way, founding(0))
    for k in range(1, 9):
        root = 0.05 * rng.standard_normal((3, 3))
        moved = rng.normal(0.3, 0.2, 3)
        take(way, frame(100 * k - 50), replace(step(k - 1, k, 0.0, True), increment=moved, cov=root @ root.T))
    placed = way.ranges_since(5.0)
    assert placed is not None
    expected = np.array(
        [HorizontalRanges(0.1, ROOM).of(frame(0), np.zeros(3), 0.0).rows[:, 3] ** 2] * 8
    ).ravel()
    for i, tag in enumerate(placed.tags):
        for end, cov in zip(placed.step_ends[: placed.steps[i]], placed.step_covs, strict=False):
            expected[i] += 0.5 * (cov[0, 0] + cov[1, 1] + cov[2, 2] * ((tag - end) ** 2).sum())
    np.testing.assert_allclose(placed.sigmas**2, expected, rtol=1e-12)
    assert placed.steps.tolist() == [k for k in range(8, 0, -1) for _ in range(2)]


def test_drift_widens_the_sigma_of_ranges_that_lie_behind_it() -> None:
    way = window()
    rough = replace(step(0, 1, 0.1, True), cov=np.diag([0.04, 0.04, 0.01]))
    take(way, founding(0), frame(50), rough, frame(150), step(1, 2, 0.1, False))
    placed = way.ranges_since(5.0)
    assert placed is not None
    near = np.sqrt(placed.sigmas[:2] ** 2 - placed.sigmas[2:] ** 2)
    np.testing.assert_allclose(near, 0.2, rtol=0.02)
    np.testing.assert_allclose(compose(np.zeros(3), placed.step_poses[0])[:2], [-0.1, 0.0], atol=1e-12)
