"""Filters take off what a tag's ranges add by the bearing of the anchor, as far as they know the heading."""

from dataclasses import replace

import numpy as np
import pytest

from estimators import estimator_config_class, make_estimator
from estimators.base import Setup, Start, Verdict
from estimators.geometry import wrap_angle
from estimators.messages import FloatArray, PoseEstimate, RangeFrame
from estimators.models.range import horizontal_range
from estimators.models.range_bias import BearingBias
from estimators.range_gate import Candidates, HorizontalRanges, RangeGate
from tests.estimators.models.finite_differences import numerical_jacobian
from tests.estimators.test_several_tags import ARMS, frame_of
from tests.estimators.test_several_tags import ROBOT as CENTRED

PATTERNS = {1: BearingBias(0.03, -0.07), 2: BearingBias(-0.06, 0.05), 3: BearingBias(0.05, 0.05)}
START = Start(np.array([6.5, 1.5, 0.4]), np.array([0.2, 0.2, 0.3]))
"""In a corner: amid the anchors a second harmonic cancels."""
ROBOT = replace(CENTRED, start=START)
CORRECTED = replace(ROBOT, bearing_biases=PATTERNS)
SIGMA = 0.02


def patterned(tag_id: int, stamp_ns: int, pose: FloatArray) -> RangeFrame:
    """Ranges of a tag with the bias that is its, else without noise."""
    bias = [PATTERNS[tag_id].at(pose, anchor, ARMS[tag_id])[0] for anchor in ROBOT.anchors.values()]
    return frame_of(tag_id, stamp_ns, pose, np.array(bias))


def found_by(name: str, setup: Setup, true: FloatArray) -> PoseEstimate:
    """Pose of a robot that stands for five seconds."""
    estimator = make_estimator(name, estimator_config_class(name).model_validate({}), setup)
    stamp_ns = 0
    for stamp_ns in range(0, 5 * 10**9, 10**8):
        for tag_id in ARMS:
            estimator.update(patterned(tag_id, stamp_ns, true))
    pose = estimator.pose_at(stamp_ns)
    assert pose is not None
    return pose


def errors(pose: PoseEstimate, true: FloatArray) -> tuple[float, float]:
    return float(np.hypot(*(pose.xy - true[:2]))), abs(wrap_angle(pose.yaw - true[2]))


@pytest.mark.parametrize("name", ["ekf", "graph", "pf", "pf_ibas", "pf_ibas_graph"])
def test_who_knows_a_heading_takes_the_bias_off(name: str) -> None:
    true = START.pose + np.array([0.05, -0.05, 0.15])
    _, turned = errors(found_by(name, ROBOT, true), true)
    off, left = errors(found_by(name, CORRECTED, true), true)
    assert off < 0.02
    assert left < 0.015 < 0.03 < turned


@pytest.mark.parametrize("name", ["least_squares", "linear_ls"])
def test_who_knows_no_heading_leaves_it_in(name: str) -> None:
    before, after = (found_by(name, setup, START.pose) for setup in (ROBOT, CORRECTED))
    np.testing.assert_array_equal(before.T_map_body, after.T_map_body)


def test_an_unknown_heading_leaves_it_in_a_filter_too() -> None:
    lost = Start(START.pose, np.array([0.2, 0.2, 30.0]))
    frame = patterned(1, 0, START.pose)
    config, setups = estimator_config_class("ekf").model_validate({}), (ROBOT, CORRECTED)
    reports = [make_estimator("ekf", config, replace(each, start=lost)).update(frame) for each in setups]
    np.testing.assert_array_equal(reports[0].residuals, reports[1].residuals)


def reduced(frame: RangeFrame, pose: FloatArray) -> Candidates:
    """What is left of a frame's ranges at a pose; all of them can be used."""
    candidates = HorizontalRanges(SIGMA, CORRECTED).of(frame, pose, 0.0)
    assert candidates.verdicts == [Verdict.WAITING] * 4
    return candidates


def differentiated(frame: RangeFrame) -> FloatArray:
    """Derivative (4, 3) of predicted minus measured horizontal ranges at the start, by differences."""

    def residuals(pose: FloatArray) -> FloatArray:
        arm = ARMS[frame.tag_id]
        rows = reduced(frame, pose).rows
        return np.array([horizontal_range(pose, row[:2], arm)[0] - row[2] for row in rows])

    return numerical_jacobian(residuals, START.pose)


@pytest.mark.parametrize("tag_id", ARMS)
def test_what_is_taken_off_the_horizontal_range_has_the_derivative_that_it_says(tag_id: int) -> None:
    frame = patterned(tag_id, 0, START.pose)
    candidates = reduced(frame, START.pose)
    by_pose = [horizontal_range(START.pose, row[:2], ARMS[tag_id])[1] for row in candidates.rows]
    expected = differentiated(frame)
    np.testing.assert_allclose(by_pose + candidates.bias_by_pose, expected, atol=1e-7)
    gate = RangeGate(RangeGate.Config(range_sigma=SIGMA), CORRECTED)
    _, residuals, judged_by_pose = gate.judge_at(candidates, np.zeros((3, 3)), ARMS[tag_id])
    np.testing.assert_allclose(judged_by_pose, expected, atol=1e-7)
    np.testing.assert_allclose(residuals, 0.0, atol=0.05)


def test_without_a_heading_the_bias_by_the_bearing_stays() -> None:
    frame, pose = patterned(1, 0, START.pose), START.pose
    lost = HorizontalRanges(SIGMA, CORRECTED).of(frame, pose, np.inf)
    blind = HorizontalRanges(SIGMA, ROBOT).of(frame, pose, 0.0)
    np.testing.assert_array_equal(lost.rows, blind.rows)
    np.testing.assert_array_equal(lost.bias_by_pose, 0.0)
    assert (reduced(frame, pose).rows[:, 2] != blind.rows[:, 2]).all()


@pytest.mark.parametrize("tag_id", ARMS)
def test_the_filter_learns_from_the_derivative_what_the_ranges_say_of_the_heading(tag_id: int) -> None:
    # The heading is so well known that nearly all of the bias is taken off.
    sure = Start(START.pose, np.array([0.02, 0.02, 0.02]), still_for=60.0)
    cov, frame = np.diag(sure.sigma**2), patterned(tag_id, 0, START.pose)
    H, sigmas = differentiated(frame), reduced(frame, START.pose).rows[:, 3]
    expected = H.T @ np.diag(sigmas**-2) @ H
    config = estimator_config_class("ekf").model_validate({"range_sigma": SIGMA})
    ekf = make_estimator("ekf", config, replace(CORRECTED, start=sure))
    ekf.update(frame)
    pose = ekf.pose_at(0)
    assert pose is not None
    learnt = np.linalg.inv(pose.planar_cov) - np.linalg.inv(cov)
    np.testing.assert_allclose(learnt, expected, atol=2e-3 * expected.max())
