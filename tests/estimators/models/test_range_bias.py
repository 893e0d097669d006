"""Range bias by bearing: value, Jacobian, and what is left of it where the heading is not well known."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from estimators.messages import FloatArray
from estimators.models.range_bias import BearingBias, without_bearing_bias
from tests.estimators.models.finite_differences import numerical_jacobian
from tests.estimators.models.test_range import arms, points
from tests.strategies import poses, range_frame

sizes = st.floats(-0.2, 0.2)
biases = st.builds(BearingBias, sizes, sizes)


def towards(pose: FloatArray, anchor: FloatArray, arm: FloatArray) -> complex:
    """From the tag to the anchor, in the body frame."""
    tag = complex(pose[0], pose[1]) + np.exp(1j * pose[2]) * complex(arm[0], arm[1])
    return complex((complex(anchor[0], anchor[1]) - tag) * np.exp(-1j * pose[2]))


@given(biases, poses, points, arms)
def test_the_bias_is_the_second_harmonic_of_the_bearing_from_the_tag(
    bias: BearingBias, pose: FloatArray, anchor: FloatArray, arm: FloatArray
) -> None:
    direction = towards(pose, anchor, arm)
    assume(abs(direction) > 0.1)
    expected = (complex(bias.cosine, -bias.sine) * (direction / abs(direction)) ** 2).real
    assert bias.at(pose, anchor, arm)[0] == pytest.approx(expected, abs=1e-9)


@given(biases, poses, points, arms, st.floats(0.0, 4.0))
def test_jacobian_of_the_bias(
    bias: BearingBias, pose: FloatArray, anchor: FloatArray, arm: FloatArray, variance: float
) -> None:
    assume(abs(towards(pose, anchor, arm)) > 0.1)  # at the anchor there is no bearing
    _, jacobian = bias.at(pose, anchor, arm, variance)
    reference = numerical_jacobian(lambda x: np.array([bias.at(x, anchor, arm, variance)[0]]), pose)
    np.testing.assert_allclose(jacobian, reference[0], atol=1e-6)


def test_an_uncertain_heading_leaves_the_mean_of_the_bias_over_it() -> None:
    bias, pose, anchor, arm = (
        BearingBias(0.03, -0.05),
        np.array([1.0, 2.0, 0.4]),
        np.array([4.0, 3.0]),
        np.zeros(2),
    )
    for sigma in (0.1, 0.5, 1.0):
        # The tag is at the body's origin: turning changes nothing but the bearing.
        yaws = pose[2] + sigma * np.linspace(-8.0, 8.0, 2001)
        weights = np.exp(-0.5 * ((yaws - pose[2]) / sigma) ** 2)
        each = [bias.at(np.array([1.0, 2.0, yaw]), anchor, arm)[0] for yaw in yaws.tolist()]
        assert bias.at(pose, anchor, arm, sigma**2)[0] == pytest.approx(np.average(each, weights=weights))
    value, jacobian = bias.at(pose, anchor, arm, np.inf)
    assert value == 0.0
    assert not jacobian.any()


def test_on_top_of_the_anchor_the_bias_is_finite() -> None:
    value, jacobian = BearingBias(0.03, 0.04).at(np.array([1.0, 2.0, 0.0]), np.array([1.0, 2.0]), np.zeros(2))
    assert abs(value) <= 0.05
    assert np.isfinite(jacobian).all()


def test_a_frame_loses_the_bias_of_anchors_that_are_known() -> None:
    bias, anchors = BearingBias(0.04, 0.0), {1: np.array([3.0, 0.0, 2.0]), 2: np.array([0.0, 3.0, 2.0])}
    frame = replace(range_frame(0, [1, 5, 2], [3.5, 4.0, np.nan]), tag_id=2)
    found = without_bearing_bias(frame, bias, np.zeros(3), anchors, np.zeros(3))
    np.testing.assert_allclose(found.ranges, [3.46, 4.0, np.nan])
    across = without_bearing_bias(frame, bias, np.array([0.0, 0.0, np.pi / 2]), anchors, np.zeros(3))
    assert across.ranges[0] == pytest.approx(3.54)
