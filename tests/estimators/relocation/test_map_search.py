"""A robot that stands still is found by its scan in a saved map; what is not clear is told, not taken."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from estimators import estimator_config_class, make_estimator
from estimators.base import Estimator, Setup, Start
from estimators.geometry import between, compose, wrap_angle
from estimators.lidar.scan_preparation import ScanPreparation
from estimators.messages import FloatArray, Measurement, PoseIncrement, RangeFrame, Scan
from estimators.relocation.map_search import ALONE_AFTER_NS, MOST_CELLS
from estimators.relocation.recovery import Recovering
from tests.estimators.lidar.room_scans import ROOM, Arc, drawn, rectangle, scan_while_moving
from tests.estimators.matched_world import tag_of
from tests.strategies import range_frame

SECOND_NS = 10**9
PERIOD_NS = SECOND_NS // 10
EMPTY = rectangle(0.0, 0.0, 5.0, 5.0)
FURNISHED = np.vstack([ROOM, rectangle(0.0, 3.3, 2.2, 4.5), rectangle(5.3, 0.0, 6.0, 0.9)])
"""Turned by half a circle it looks clearly different."""
ASKEW = np.array([1.0, -6.0, 0.7])
MOUNTING = np.array([0.1, -0.05, 0.7])
POSE = np.array([1.7, 1.4, 0.5])
SETUP = Setup(
    anchors={
        1: np.array([0.1, 0.2, 2.2]),
        2: np.array([5.9, 0.1, 2.0]),
        3: np.array([5.8, 4.4, 2.3]),
        4: np.array([0.2, 4.3, 1.9]),
    },
    tag_in_body=np.array([-0.1, 0.05, 0.2]),
    start=Start(np.zeros(3), np.array([100.0, 100.0, np.pi]), known=False),
    height=0.3,
    height_sigma=0.02,
    level_sigma=0.02,
    lidar_in_body=MOUNTING,
)


def in_map(walls: FloatArray, T_map_grid: FloatArray = ASKEW) -> Setup:
    return replace(SETUP, floor_map=drawn(walls, T_map_grid))


def stream(
    walls: FloatArray,
    path: Arc,
    seconds: float,
    seed: int = 0,
    anchors: tuple[int, ...] = (1, 2, 3, 4),
    excess: dict[int, float] | None = None,
    begin_ns: int = 0,
) -> Iterator[Measurement]:
    """Scans 10 times a second, each followed by its increment, and ranges; every increment is a keyframe."""
    rng = np.random.default_rng(seed)
    last_ns, last = begin_ns, path.poses(np.zeros(1))[0]
    for k in range(round(seconds * 10)):
        whole = scan_while_moving(walls, path, 0.1 * k, rng, 0.015, MOUNTING)
        scan = replace(whole, stamp_ns=begin_ns + k * PERIOD_NS)
        now_ns = scan.end_stamp_ns
        pose = path.poses(np.array([0.1 * k + whole.beam_times[-1]]))[0]
        founds = k == 0
        step = np.zeros(3) if founds else between(last, pose) + rng.normal(0.0, [0.003, 0.003, 0.002])
        cov = np.zeros((3, 3)) if founds else np.diag([0.003**2, 0.003**2, 0.002**2])
        if anchors:
            tag = tag_of(pose, SETUP)
            slants = [
                float(np.linalg.norm(SETUP.anchors[i] - tag))
                + rng.normal(0.0, 0.1)
                + (excess or {}).get(i, 0.0)
                for i in anchors
            ]
            yield range_frame(now_ns - 1, list(anchors), slants)
        yield scan
        yield PoseIncrement(now_ns if founds else last_ns, now_ns, step, cov, is_keyframe=True)
        last_ns, last = now_ns, pose


def standing(pose: FloatArray) -> Arc:
    return Arc(pose, np.zeros(3))


def recovering(setup: Setup, name: str = "ekf") -> Estimator:
    return make_estimator(name, estimator_config_class(name)(), setup, Recovering.Config())


def feed(estimator: Estimator, measurements: Iterator[Measurement]) -> tuple[list[str], int]:
    """Notes after each measurement, and the newest stamp."""
    notes, newest_ns = [], 0
    for measurement in measurements:
        notes.append(estimator.update(measurement).note)
        if isinstance(measurement, PoseIncrement):
            newest_ns = measurement.stamp_ns
    return notes, newest_ns


def assert_at(estimator: Estimator, stamp_ns: int, pose: FloatArray) -> int:
    found = estimator.pose_at(stamp_ns)
    assert found is not None
    assert np.hypot(*(found.xy - pose[:2])) < 0.1
    assert abs(np.rad2deg(wrap_angle(found.yaw - pose[2]))) < 2.0
    assert np.isfinite(found.cov).all()
    error = np.array([*(found.xy - pose[:2]), wrap_angle(found.yaw - pose[2])])
    # The covariance means something: not one of a thousand is so far out.
    assert error @ np.linalg.solve(found.planar_cov, error) < 16.3
    return found.reset_counter


@pytest.mark.parametrize("name", ["ekf", "pf", "graph"])
def test_a_standing_robot_is_found_within_a_second(name: str) -> None:
    estimator = recovering(in_map(ROOM), name)
    notes, now_ns = feed(estimator, stream(ROOM, standing(POSE), 1.0))
    assert_at(estimator, now_ns, POSE)
    assert notes[-1] == ""


def test_a_map_too_large_for_a_search_in_time_is_not_searched() -> None:
    floor = drawn(ROOM, ASKEW)
    wide = np.pad(floor.occupied, ((0, 0), (0, MOST_CELLS // len(floor.occupied))))
    estimator = recovering(replace(SETUP, floor_map=replace(floor, occupied=wide, free=~wide)))
    notes, now_ns = feed(estimator, stream(ROOM, standing(POSE), 1.0))
    assert estimator.pose_at(now_ns) is None
    assert notes[-1] == "drive a metre"


def test_a_standing_robot_without_ranges_is_found_a_little_later() -> None:
    estimator = recovering(in_map(FURNISHED))
    _, now_ns = feed(estimator, stream(FURNISHED, standing(POSE), 1.5, anchors=()))
    assert now_ns < ALONE_AFTER_NS
    assert estimator.pose_at(now_ns) is None
    estimator.reset()
    _, now_ns = feed(estimator, stream(FURNISHED, standing(POSE), 3.5, anchors=()))
    assert_at(estimator, now_ns, POSE)


@pytest.mark.parametrize(("min_range", "is_found"), [(0.1, False), (0.5, True)])
def test_limits_of_the_site_hold_in_the_search(min_range: float, is_found: bool) -> None:
    preparation = ScanPreparation.Config(min_range=min_range)
    estimator = recovering(replace(in_map(FURNISHED), scan_preparation=preparation))
    now_ns = 0
    for measurement in stream(FURNISHED, standing(POSE), 1.0):
        if isinstance(measurement, Scan):
            # A frame round the scanner hides every second beam.
            ranges = np.where(np.arange(len(measurement.ranges)) % 2, 0.4, measurement.ranges)
            measurement = replace(measurement, ranges=ranges)
            now_ns = measurement.end_stamp_ns
        estimator.update(measurement)
    assert (estimator.pose_at(now_ns) is not None) == is_found


def test_places_that_look_alike_are_told_and_not_taken_until_ranges_decide() -> None:
    pose = np.array([1.7, 1.4, 0.5])
    estimator = recovering(in_map(EMPTY))
    notes, now_ns = feed(estimator, stream(EMPTY, standing(pose), 4.0, anchors=()))
    assert estimator.pose_at(now_ns) is None
    assert notes[-1] == "4 places look alike, drive a metre"
    assert all(len(note) <= 35 for note in notes)
    estimator.reset()
    _, now_ns = feed(estimator, stream(EMPTY, standing(pose), 1.0))
    assert_at(estimator, now_ns, pose)


def test_two_ranges_do_not_decide_between_places_that_look_alike() -> None:
    estimator = recovering(in_map(EMPTY))
    notes, now_ns = feed(estimator, stream(EMPTY, standing(POSE), 4.0, anchors=(1, 2)))
    assert estimator.pose_at(now_ns) is None
    assert notes[-1] == "4 places look alike, drive a metre"


def test_a_scan_of_another_room_gives_no_pose() -> None:
    estimator = recovering(in_map(rectangle(0.0, 0.0, 2.0, 3.0)))
    notes, now_ns = feed(estimator, stream(ROOM, standing(POSE), 4.0, anchors=()))
    assert estimator.pose_at(now_ns) is None
    assert notes[-1] == "scan not in the map, drive a metre"


def test_a_place_that_the_ranges_contradict_is_not_taken() -> None:
    estimator = recovering(in_map(ROOM))
    _, now_ns = feed(estimator, stream(ROOM, standing(POSE), 1.0, excess={1: 1.5, 2: 1.0}))
    assert estimator.pose_at(now_ns) is None
    estimator.reset()
    # Nothing shortens a range: one that is too short speaks against the place.
    notes, now_ns = feed(estimator, stream(ROOM, standing(POSE), 1.0, excess={3: -0.8}))
    assert estimator.pose_at(now_ns) is None
    assert notes[-1] == "ranges contradict, 75% agree"


def test_one_blocked_anchor_of_four_neither_hides_the_place_nor_sets_the_filter_again() -> None:
    estimator = recovering(in_map(ROOM))
    _, now_ns = feed(estimator, stream(ROOM, standing(POSE), 4.5, excess={1: 1.5}))
    assert assert_at(estimator, now_ns, POSE) == 1


def test_a_wrong_start_mark_is_put_right_before_the_robot_moves() -> None:
    mark = POSE + np.array([1.5, 1.0, 1.2])
    estimator = recovering(replace(in_map(ROOM), start=Start(mark, np.array([0.05, 0.05, 0.03]))))
    _, now_ns = feed(estimator, stream(ROOM, standing(POSE), 3.0))
    assert assert_at(estimator, now_ns, POSE) == 1


def test_a_scan_mostly_from_beyond_the_map_has_no_place_in_it() -> None:
    estimator = recovering(in_map(FURNISHED, np.array([-0.2, -0.2, 0.0])))
    for measurement in stream(FURNISHED, standing(POSE), 3.0):
        changed = measurement
        if isinstance(measurement, Scan):
            beyond = np.arange(len(measurement.ranges)) % 5 < 3
            changed = replace(measurement, ranges=np.where(beyond, 11.0, measurement.ranges))
        note = estimator.update(changed).note
        assert estimator.pose_at(measurement.stamp_ns) is None
    assert note == "scan not in the map, drive a metre"


def test_a_robot_that_moves_is_not_held_against_the_map() -> None:
    estimator = recovering(in_map(ROOM))
    turning = Arc(POSE, np.array([0.0, 0.0, 0.6]))
    notes, now_ns = feed(estimator, stream(ROOM, turning, 4.0, anchors=()))
    assert estimator.pose_at(now_ns) is None
    assert set(notes) == {"waiting for increments and ranges"}


def test_a_robot_that_was_carried_off_is_found_standing_and_the_jump_is_counted() -> None:
    estimator = recovering(replace(in_map(ROOM), start=Start(POSE, np.array([0.05, 0.05, 0.03]))))
    _, now_ns = feed(estimator, stream(ROOM, standing(POSE), 3.0))
    assert assert_at(estimator, now_ns, POSE) == 0
    elsewhere = np.array([3.5, 1.2, 2.5])
    _, now_ns = feed(estimator, stream(ROOM, standing(elsewhere), 4.0, seed=1, begin_ns=now_ns + SECOND_NS))
    assert assert_at(estimator, now_ns, elsewhere) == 1


def test_blocked_ranges_do_not_move_a_standing_filter_that_is_right() -> None:
    estimator = recovering(replace(in_map(ROOM), start=Start(POSE, np.array([0.05, 0.05, 0.03]))))
    _, now_ns = feed(estimator, stream(ROOM, standing(POSE), 6.0, excess={1: 0.6, 3: 0.5}))
    assert assert_at(estimator, now_ns, POSE) == 0


def test_the_found_pose_holds_where_the_robot_is_and_not_where_its_keyframe_was() -> None:
    estimator = recovering(in_map(FURNISHED))
    drive = list(stream(FURNISHED, Arc(POSE, np.array([0.5, 0.0, 0.0])), 0.6, anchors=()))
    stop = compose(POSE, np.array([0.5 * (0.5 + 0.1 * 399 / 400), 0.0, 0.0]))
    rest = list(stream(FURNISHED, standing(stop), 3.0, anchors=(), begin_ns=6 * PERIOD_NS))
    increments = [m for m in drive + rest if isinstance(m, PoseIncrement)]
    keyframe = increments[0]
    chained, at = [], np.zeros(3)
    for measured in increments[1:]:
        # The founding increment of the second piece is a step of no length.
        at = compose(at, measured.increment)
        chained.append(PoseIncrement(keyframe.stamp_ns, measured.stamp_ns, at, np.eye(3) * 1e-5, False))
    replaced = iter([keyframe, *chained])
    _, now_ns = feed(
        estimator, iter(next(replaced) if isinstance(m, PoseIncrement) else m for m in drive + rest)
    )
    assert_at(estimator, now_ns, stop)
    found = estimator.pose_at(now_ns)
    assert found is not None
    assert np.sqrt(np.diag(found.planar_cov)[:2]).max() < 0.05


def test_scans_without_sense_give_no_pose_and_no_error() -> None:
    bad = [
        Scan(0, np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0)),
        Scan(0, np.full(3, np.nan), np.full(3, np.nan), np.arange(3.0) * 1e-3, np.zeros(3)),
        Scan(0, np.arange(300.0) / 50, np.full(300, np.inf), np.arange(300.0) * 1e-4, np.zeros(300)),
        Scan(0, np.arange(300.0) / 50, np.full(300, 90.0), np.arange(300.0) * 1e-4, np.zeros(300)),
        Scan(0, np.arange(300.0) / 50, np.full(300, 1e-9), np.arange(300.0) * 1e-4, np.zeros(300)),
    ]
    for scan in bad:
        estimator = recovering(in_map(ROOM))
        for measurement in stream(ROOM, standing(POSE), 3.0):
            changed = measurement
            if isinstance(measurement, Scan):
                begin_ns = measurement.end_stamp_ns - (scan.end_stamp_ns - scan.stamp_ns)
                changed = replace(scan, stamp_ns=begin_ns)
            elif isinstance(measurement, RangeFrame):
                changed = range_frame(measurement.stamp_ns, [1, 2, 3], [float("nan"), -1.0, 3.0])
            note = estimator.update(changed).note
            pose = estimator.pose_at(measurement.stamp_ns)
            assert pose is None, (scan, note)
        assert note == "scan not in the map, drive a metre"
