"""What the LiDAR sees between tag and anchor: the grid that is filled on the way, and rays through it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from estimators import estimator_config_class, make_estimator
from estimators.base import Setup, Start, Verdict
from estimators.geometry import compose, lift
from estimators.lidar.floor_map import FloorMap
from estimators.lidar.occupancy_grid import OccupancyGrid
from estimators.messages import FloatArray, PoseEstimate, PoseIncrement, Scan
from estimators.nlos.visibility import OBSTRUCTED, PERIOD_NS, Visibility
from tests.estimators.lidar.room_scans import PERIOD, ROOM, Arc, Loop, drawn, rectangle, scan_while_moving
from tests.strategies import range_frame

MOUNTING = np.array([0.1, -0.05, 0.7])
TAG = np.array([-0.1, 0.0, 0.2])
HEIGHT = 0.3
HIDDEN, FREE = np.array([5.9, 4.3, 2.5]), np.array([5.9, 0.1, 2.5])
"""Anchors behind the box from (4.2, 2.8) to (5.0, 3.4), and beside it."""
POSE = np.array([2.0, 1.0, 0.4])
SETUP = Setup(
    anchors={0: HIDDEN, 1: FREE},
    tag_in_body=TAG,
    start=Start(POSE, np.full(3, 0.01)),
    height=HEIGHT,
    height_sigma=0.05,
    level_sigma=0.05,
    lidar_in_body=MOUNTING,
)
PoseAt = Callable[[int], PoseEstimate | None]


def known(path: Arc | Loop, sigma: float = 0.01, spoil: float = 1.0) -> PoseAt:
    """An estimator that knows the body's path."""
    cov = np.diag(np.full(6, sigma**2 * spoil))

    def pose_at(stamp_ns: int) -> PoseEstimate:
        return PoseEstimate(stamp_ns, lift(path.poses(np.array([stamp_ns * 1e-9]))[0], HEIGHT), cov, 0)

    return pose_at


def show(visibility: Visibility, scan: Scan, pose_at: PoseAt, stamp_ns: int | None = None) -> None:
    """A scan, then the increment up to its end."""
    visibility.see(scan, pose_at)
    stamp_ns = scan.end_stamp_ns if stamp_ns is None else stamp_ns
    increment = PoseIncrement(stamp_ns, stamp_ns, np.zeros(3), np.zeros((3, 3)), is_keyframe=True)
    visibility.see(increment, pose_at)


def shown(path: Arc | Loop, seconds: float = 2.0, obstacle_height: float = 2.0) -> Visibility:
    visibility = Visibility(obstacle_height, SETUP)
    for start in np.arange(0.0, seconds, PERIOD).tolist():
        scan = scan_while_moving(ROOM, path, start, lidar_in_body=MOUNTING)
        show(visibility, scan, known(path))
    return visibility


STANDING = Arc(POSE, np.zeros(3))
ROOM_SEEN = shown(STANDING)


def test_an_obstacle_on_the_line_speaks_for_a_blocked_range_and_an_empty_line_says_nothing() -> None:
    assert ROOM_SEEN.log_ratio(POSE, HIDDEN) == OBSTRUCTED > 0.0
    assert ROOM_SEEN.log_ratio(POSE, FREE) == 0.0


def test_nothing_is_said_before_anything_was_seen_and_after_a_reset() -> None:
    assert Visibility(2.0, SETUP).log_ratio(POSE, HIDDEN) == 0.0
    visibility = shown(STANDING)
    visibility.reset()
    assert visibility.log_ratio(POSE, HIDDEN) == 0.0


def test_a_ray_that_passes_above_the_obstacle_is_free() -> None:
    # From 0.5 m at the tag to 2.5 m at the anchor, above 1 m after a quarter of the way, before the box.
    assert shown(STANDING, obstacle_height=1.0).log_ratio(POSE, HIDDEN) == 0.0
    # An anchor below the tag: the ray ends below the height of what is seen.
    low, level = np.array([*HIDDEN[:2], 0.1]), np.array([*HIDDEN[:2], 0.5])
    assert shown(STANDING, obstacle_height=0.3).log_ratio(POSE, low) == OBSTRUCTED
    assert shown(STANDING, obstacle_height=0.05).log_ratio(POSE, low) == 0.0
    assert ROOM_SEEN.log_ratio(POSE, level) == OBSTRUCTED
    assert shown(STANDING, obstacle_height=0.4).log_ratio(POSE, level) == 0.0


def test_the_wall_behind_the_anchor_and_the_robot_itself_block_nothing() -> None:
    on_the_wall = np.array([6.0, 2.0, 2.5])
    assert ROOM_SEEN.log_ratio(POSE, on_the_wall) == 0.0
    in_the_wall = np.array([6.5, 2.0, 2.5])
    assert shown(STANDING, obstacle_height=3.0).log_ratio(POSE, in_the_wall) == OBSTRUCTED
    beside_a_wall = np.array([2.0, 0.12, 0.0])
    assert ROOM_SEEN.log_ratio(beside_a_wall, FREE) == 0.0
    assert ROOM_SEEN.log_ratio(POSE, np.array([*(POSE[:2] + 0.2), 2.5])) == 0.0


def test_scans_of_a_turning_robot_are_deskewed_and_put_through_the_mounting() -> None:
    visibility = shown(Arc(np.array([2.0, 1.5, 0.0]), np.array([0.4, 0.0, 1.0])), 3.0)
    grid = visibility.grid
    rows, columns = np.nonzero(grid.obstacles)
    centres = grid.origin + (np.column_stack([columns, rows]) + 0.5) * grid.cell
    assert len(centres) > 200
    assert np.percentile(to_nearest_wall(centres), 95) < grid.cell
    assert visibility.log_ratio(POSE, HIDDEN) == OBSTRUCTED


def to_nearest_wall(points: FloatArray) -> FloatArray:
    begins, along = ROOM[:, 0], ROOM[:, 1] - ROOM[:, 0]
    share = np.einsum("nmi,mi->nm", points[:, None] - begins, along) / (along**2).sum(axis=1)
    nearest = begins + np.clip(share, 0.0, 1.0)[..., None] * along
    distance: FloatArray = np.linalg.norm(points[:, None] - nearest, axis=2).min(axis=1)
    return distance


@pytest.mark.parametrize("yaw", [0.0, 1.2, -2.0])
def test_the_tag_is_where_its_lever_arm_puts_it(yaw: float) -> None:
    # The tag, not the body's origin, stands behind the corner of the box, whichever way the body faces.
    arm = np.array([0.8 * np.sin(yaw), 0.8 * np.cos(yaw), 0.2])
    visibility = Visibility(2.0, Setup(SETUP.anchors, arm, SETUP.start, HEIGHT, 0.05, 0.05))
    visibility.grid = ROOM_SEEN.grid
    pose = np.array([3.0, 2.2, yaw])
    anchor = np.array([5.9, 2.6, 2.5])
    tag = compose(pose, np.array([*arm[:2], 0.0]))[:2]
    assert ROOM_SEEN.grid.blocked(tag, anchor[:2])
    assert visibility.log_ratio(pose, anchor) == OBSTRUCTED
    assert ROOM_SEEN.log_ratio(pose, anchor) == 0.0


@pytest.mark.parametrize(
    ("sigma", "spoil"), [(0.15, 1.0), (0.06, 1.0), (0.01, np.nan), (0.01, np.inf)], ids=str
)
def test_a_pose_that_is_not_known_well_draws_no_grid(sigma: float, spoil: float) -> None:
    visibility = Visibility(2.0, SETUP)
    show(visibility, scan_while_moving(ROOM, STANDING, 0.0), known(STANDING, sigma, spoil))
    assert visibility.grid.log_odds.size == 0


def test_a_scan_is_added_only_with_its_own_increment_and_not_too_often(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    added: list[float] = []
    insert = OccupancyGrid.insert

    def count(grid: OccupancyGrid, T_map_lidar: FloatArray, points: FloatArray) -> bool:
        added.append(T_map_lidar[0])
        return insert(grid, T_map_lidar, points)

    monkeypatch.setattr(OccupancyGrid, "insert", count)
    visibility = Visibility(2.0, SETUP)
    scan = scan_while_moving(ROOM, STANDING, 0.0)
    show(visibility, scan, known(STANDING), stamp_ns=scan.end_stamp_ns + 1)
    show(visibility, scan, lambda _: None)
    assert not added
    shown(STANDING, seconds=4.0)
    assert len(added) == pytest.approx(4e9 / PERIOD_NS, abs=4)


@pytest.mark.parametrize("name", ["ekf", "graph", "pf", "pf_ibas", "pf_ibas_graph"])
def test_every_filter_sees_the_obstacle_in_its_scans(name: str) -> None:
    config = estimator_config_class(name).model_validate({"nlos": ["visibility"]})
    estimator = make_estimator(name, config, SETUP)
    starts = np.arange(0.0, 1.0, PERIOD).tolist()
    scans = [scan_while_moving(ROOM, STANDING, start, lidar_in_body=MOUNTING) for start in starts]
    first_ns, last_ns = scans[0].end_stamp_ns, scans[-1].end_stamp_ns
    for scan in scans:
        estimator.update(scan)
        stamp_ns, tight = scan.end_stamp_ns, 1e-6 * np.eye(3)
        estimator.update(PoseIncrement(first_ns, stamp_ns, np.zeros(3), tight, stamp_ns == first_ns))
    tag = lift(POSE, HEIGHT) @ np.append(TAG, 1.0)
    slants = [float(np.linalg.norm(anchor - tag[:3])) for anchor in (HIDDEN, FREE)]
    report = estimator.update(range_frame(last_ns, [0, 1], slants))
    assert report.verdicts == (Verdict.OBSTRUCTED, Verdict.ACCEPTED)


def test_scans_with_anything_in_them_do_no_harm() -> None:
    visibility = shown(STANDING)
    scan = scan_while_moving(ROOM, STANDING, 10.0)
    for bad in (np.nan, np.inf, -1.0, 0.0, 1e300):
        ranges = np.full(len(scan.ranges), bad)
        show(visibility, Scan(scan.stamp_ns, scan.angles, ranges, scan.beam_times, ranges), known(STANDING))
    empty = np.empty(0)
    show(visibility, Scan(0, empty, empty, empty, empty), known(STANDING))
    assert visibility.log_ratio(POSE, HIDDEN) == OBSTRUCTED
    assert np.isfinite(visibility.grid.log_odds).all()


@pytest.mark.parametrize("T_map_grid", [np.zeros(3), np.array([1.0, -6.0, 0.7]), np.array([7.52, 5.03, 3.0])])
def test_a_map_tells_of_obstacles_before_the_first_scan_and_after_a_reset(T_map_grid: FloatArray) -> None:
    visibility = Visibility(2.0, replace(SETUP, floor_map=drawn(ROOM, T_map_grid)))
    for _ in range(2):
        assert visibility.log_ratio(POSE, HIDDEN) == OBSTRUCTED
        assert visibility.log_ratio(POSE, FREE) == 0.0
        visibility.reset()


def test_no_ray_slips_between_the_cells_of_a_map_that_lies_askew() -> None:
    visibility = Visibility(2.0, replace(SETUP, floor_map=drawn(ROOM, np.array([1.0, -6.0, 0.7]))))
    rng = np.random.default_rng(0)
    for x, y, yaw in rng.uniform([0.5, 0.5, -3.0], [3.8, 4.0, 3.0], (200, 3)):
        beyond = np.array([7.0, rng.uniform(0.5, 4.0), 2.1])
        assert visibility.log_ratio(np.array([x, y, yaw]), beyond) == OBSTRUCTED


def test_no_ray_slips_through_cells_larger_than_those_of_the_grid() -> None:
    wall = FloorMap(np.ones((40, 1), bool), np.zeros((40, 1), bool), 0.2, np.array([4.5, -1.0, 0.2]))
    visibility = Visibility(2.0, replace(SETUP, floor_map=wall))
    rng = np.random.default_rng(0)
    for x, y, yaw in rng.uniform([0.5, 0.5, -3.0], [2.3, 4.0, 3.0], (200, 3)):
        beyond = np.array([7.0, rng.uniform(0.5, 4.0), 2.1])
        assert visibility.log_ratio(np.array([x, y, yaw]), beyond) == OBSTRUCTED


def test_what_is_gone_since_the_map_was_made_is_forgotten() -> None:
    visibility = Visibility(2.0, replace(SETUP, floor_map=drawn(ROOM, np.zeros(3))))
    without_box = rectangle(0.0, 0.0, 6.0, 4.5)
    for start in np.arange(0.0, 4.0, PERIOD).tolist():
        show(
            visibility,
            scan_while_moving(without_box, STANDING, start, lidar_in_body=MOUNTING),
            known(STANDING),
        )
    assert visibility.log_ratio(POSE, HIDDEN) == 0.0
