"""Landmark model: value in complex numbers, Jacobian against finite differences."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from estimators.messages import FloatArray
from estimators.models.landmark import range_and_bearing
from tests.estimators.models.finite_differences import numerical_jacobian
from tests.strategies import poses

points = st.tuples(st.floats(-50.0, 50.0), st.floats(-50.0, 50.0)).map(np.array)


@given(poses, points)
def test_value_is_the_offset_seen_from_the_body(pose: FloatArray, landmark: FloatArray) -> None:
    seen = complex(*(landmark - pose[:2])) * np.exp(-1j * pose[2])
    assume(abs(seen) > 1e-3)
    value, _ = range_and_bearing(pose, landmark)
    assert value[0] * np.exp(1j * value[1]) == pytest.approx(seen, abs=1e-9)
    assert abs(value[1]) <= np.pi


@given(poses, points)
def test_jacobian_agrees_with_finite_differences(pose: FloatArray, landmark: FloatArray) -> None:
    assume(float(np.hypot(*(landmark - pose[:2]))) > 0.3)
    _, by_pose = range_and_bearing(pose, landmark)
    numerical = numerical_jacobian(lambda at: range_and_bearing(at, landmark)[0], pose, angle_rows=(1,))
    np.testing.assert_allclose(by_pose, numerical, atol=1e-6)


def test_a_robot_on_the_landmark_gets_finite_numbers() -> None:
    value, by_pose = range_and_bearing(np.array([1.0, 2.0, 0.3]), np.array([1.0, 2.0]))
    assert np.isfinite(value).all()
    assert np.isfinite(by_pose).all()
