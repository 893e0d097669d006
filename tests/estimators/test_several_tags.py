"""Several tags on one robot: ranges alone then tell the heading, and every filter takes the right antenna."""

from dataclasses import replace

import numpy as np
import pytest

from estimators import estimator_config_class, make_estimator
from estimators.base import Setup, Start, Verdict
from estimators.geometry import transform, wrap_angle
from estimators.messages import FloatArray, RangeFrame
from estimators.range_gate import HorizontalRanges
from estimators.relocation.window import Window
from tests.estimators.relocation.test_window import founding, step
from tests.strategies import SETUP, range_frame

ARMS = {1: np.array([0.25, 0.2, 0.3]), 2: np.array([-0.25, 0.2, 0.1]), 3: np.array([0.0, -0.3, 0.4])}
START = Start(np.array([3.5, 2.8, 0.4]), np.array([0.2, 0.2, 0.3]))
ROBOT = replace(SETUP, start=START, tag_in_body=ARMS[1], tags={tag_id: ARMS[tag_id] for tag_id in (2, 3)})


def frame_of(tag_id: int, stamp_ns: int, pose: FloatArray, noise: FloatArray | float = 0.0) -> RangeFrame:
    """Ranges of one tag of a robot."""
    arm = ARMS[tag_id]
    tag = np.array([*transform(pose, arm[None, :2])[0], ROBOT.height + arm[2]])
    slants = np.array([np.linalg.norm(tag - anchor) for anchor in ROBOT.anchors.values()]) + noise
    return replace(range_frame(stamp_ns, list(ROBOT.anchors), slants.tolist()), tag_id=tag_id)


def found_by(name: str, setup: Setup, true: FloatArray, sigma: float = 0.05) -> FloatArray:
    """Errors (3,) of the pose of a robot that stands for five seconds, in standard deviations too."""
    rng = np.random.default_rng(3)
    estimator = make_estimator(name, estimator_config_class(name).model_validate({}), setup)
    stamp_ns = 0
    for stamp_ns in range(0, 5 * 10**9, 10**8):
        for tag_id in ARMS:
            estimator.update(frame_of(tag_id, stamp_ns, true, sigma * rng.standard_normal(4)))
    pose = estimator.pose_at(stamp_ns)
    assert pose is not None
    error = np.array([*pose.xy, pose.yaw]) - true
    error[2] = wrap_angle(error[2])
    assert (np.abs(error) < 4.0 * np.sqrt(np.diag(pose.planar_cov))).all()
    return error


@pytest.mark.parametrize("name", ["ekf", "graph", "pf", "pf_ibas", "pf_ibas_graph"])
def test_three_tags_turn_a_wrong_start_heading_right(name: str) -> None:
    true = START.pose + np.array([0.1, -0.1, 0.3])
    error = found_by(name, ROBOT, true)
    assert np.hypot(*error[:2]) < 0.06
    assert abs(error[2]) < 0.12
    # As if all of them sat where the first does, their ranges say nothing of it.
    blind = replace(ROBOT, tags={})
    with pytest.raises(AssertionError):
        assert abs(found_by(name, blind, true)[2]) < 0.12


@pytest.mark.parametrize("name", ["least_squares", "linear_ls", "gd_pf"])
def test_solvers_of_single_frames_take_the_tag_that_is_theirs(name: str) -> None:
    estimator = make_estimator(name, estimator_config_class(name).model_validate({}), ROBOT)
    assert estimator.update(frame_of(2, 0, START.pose)).verdicts == (Verdict.NOT_USED,) * 4
    assert estimator.pose_at(0) is None
    assert set(estimator.update(frame_of(1, 0, START.pose)).verdicts) == {Verdict.ACCEPTED}


def test_ranges_are_reduced_by_the_height_of_their_own_tag() -> None:
    horizontal = HorizontalRanges(0.1, ROBOT)
    for tag_id, arm in ARMS.items():
        tag = transform(START.pose, arm[None, :2])[0]
        rows = horizontal.of(frame_of(tag_id, 0, START.pose), START.pose, 0.0).rows
        np.testing.assert_allclose(rows[:, 2], np.linalg.norm(rows[:, :2] - tag, axis=1))


def test_a_search_for_the_pose_places_each_tag_where_it_sits() -> None:
    way = Window(5.0, HorizontalRanges(0.1, ROBOT), ROBOT)
    way.add_increment(founding(0))
    for tag_id in ARMS:
        way.add_ranges(frame_of(tag_id, 50_000_000, START.pose))
    way.add_increment(step(0, 1, 0.0, False))
    placed = way.ranges_since(5.0)
    assert placed is not None
    np.testing.assert_allclose(placed.tags[::4], [arm[:2] for arm in ARMS.values()], atol=1e-9)
