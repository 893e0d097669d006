"""The frame self-test: what a walk says of the axes."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from companion.frame_check import judge_autopilot, judge_compass, judge_walk
from estimators.geometry import compose

angles = st.floats(-3.1, 3.1)


def walked(
    begin: tuple[float, float, float], angle_deg: float, length: float = 2.0, turn: float = 0.0
) -> tuple:  # type: ignore[type-arg]
    """Poses before and after a walk in a direction seen from the first."""
    step = np.array([length * np.cos(np.deg2rad(angle_deg)), length * np.sin(np.deg2rad(angle_deg)), turn])
    return np.array(begin), compose(np.array(begin), step)


@given(yaw=angles, turn=angles, error=st.floats(-20, 20))
def test_walks_as_they_should_be_agree_wherever_the_robot_looks(
    yaw: float, turn: float, error: float
) -> None:
    assert judge_walk("forward", *walked((1, 2, yaw), error, turn=turn)).agrees
    assert judge_walk("left", *walked((1, 2, yaw), 90 + error, turn=turn)).agrees


@given(yaw=angles, what=st.sampled_from(["forward", "left"]), off=st.floats(30, 330))
def test_a_pose_that_is_turned_never_agrees(yaw: float, what: str, off: float) -> None:
    meant = 0.0 if what == "forward" else 90.0
    assert judge_walk(what, *walked((1, 2, yaw), meant + off)).agrees is False


@pytest.mark.parametrize(
    ("what", "angle", "words"),
    [
        ("forward", 90.0, "to its left: the pose is turned by +90 deg"),
        ("forward", 180.0, "the other way"),
        ("forward", -90.0, "to its right: the pose is turned by -90 deg"),
        ("left", -90.0, "the map is mirrored"),
        ("left", 180.0, "to its left: the pose is turned by +90 deg"),
    ],
)
def test_each_mistake_has_its_words(what: str, angle: float, words: str) -> None:
    assert words in judge_walk(what, *walked((0, 0, 0.7), angle)).text


def test_a_mirrored_map_shows_in_the_walk_to_the_left_alone() -> None:
    mirror = np.array([1.0, -1.0, -1.0])
    begin, ahead = walked((1, 2, 0.3), 0.0)
    assert judge_walk("forward", begin * mirror, ahead * mirror).agrees
    begin, left = walked((1, 2, 0.3), 90.0)
    assert not judge_walk("left", begin * mirror, left * mirror).agrees


def test_a_step_is_no_walk() -> None:
    finding = judge_walk("forward", *walked((0, 0, 0), 0.0, length=0.3))
    assert not finding.agrees
    assert "only 0.30 m" in finding.text


@given(heading=angles, off=st.floats(-170, 170))
def test_the_compass_tells_what_to_add_to_the_maps_heading(heading: float, off: float) -> None:
    assume(abs(abs(off) - 20.0) > 0.01)
    finding = judge_compass(heading, heading + np.deg2rad(off))
    assert finding.agrees is (abs(off) <= 20.0)
    if not finding.agrees:
        assert f"add {off:+.0f} deg" in finding.text


def test_an_autopilot_that_goes_another_way_or_not_at_all() -> None:
    north = np.array([2.0, 0.0])
    assert judge_autopilot(north, north * 0.9).agrees
    assert judge_autopilot(north, np.array([0.0, 2.0])).agrees is False
    assert judge_autopilot(north, np.zeros(2)).agrees is None
