"""Motion models: constant velocity as a semigroup with white acceleration, the increment's Jacobians."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad_vec

from estimators.geometry import compose
from estimators.messages import FloatArray
from estimators.models.motion import constant_velocity, increment
from tests.estimators.models.finite_differences import numerical_jacobian
from tests.strategies import poses

steps = st.floats(-3.0, 3.0)
densities = st.floats(1e-3, 10.0)


@given(steps, steps, densities, densities)
def test_two_steps_are_one(a: float, b: float, accel: float, yaw_accel: float) -> None:
    F_a, F_b = (constant_velocity(dt, accel, yaw_accel)[0] for dt in (a, b))
    np.testing.assert_allclose(F_a @ F_b, constant_velocity(a + b, accel, yaw_accel)[0], atol=1e-14)


@given(st.floats(0.0, 3.0), st.floats(0.0, 3.0), densities, densities)
def test_noise_of_two_steps_is_that_of_one(a: float, b: float, accel: float, yaw_accel: float) -> None:
    (_, Q_a), (F_b, Q_b) = (constant_velocity(dt, accel, yaw_accel) for dt in (a, b))
    whole = constant_velocity(a + b, accel, yaw_accel)[1]
    np.testing.assert_allclose(F_b @ Q_a @ F_b.T + Q_b, whole, rtol=1e-9, atol=1e-12)


@given(steps, densities, densities)
def test_noise_is_symmetric_and_positive_semidefinite(dt: float, accel: float, yaw_accel: float) -> None:
    Q = constant_velocity(dt, accel, yaw_accel)[1]
    np.testing.assert_array_equal(Q, Q.T)
    values = np.linalg.eigvalsh(Q)
    assert values[0] >= -1e-14 * values[-1]


@pytest.mark.parametrize("dt", [0.02, 0.5, 2.0, -0.02, -0.5, -2.0])
def test_noise_is_the_integral_of_white_acceleration(dt: float) -> None:
    accel, yaw_accel = 0.7, 1.9
    # An impulse of acceleration s seconds from the end moves velocity by 1 and position by s.
    power = np.diag([0.0, 0.0, 0.0, accel**2, accel**2, yaw_accel**2])

    def spread(s: float) -> FloatArray:
        F = np.eye(6)
        F[0, 3] = F[1, 4] = F[2, 5] = s * np.sign(dt)
        return F @ power @ F.T

    integral, _ = quad_vec(spread, 0.0, abs(dt))
    np.testing.assert_allclose(constant_velocity(dt, accel, yaw_accel)[1], integral, atol=1e-12)


def test_standing_still_takes_no_time() -> None:
    F, Q = constant_velocity(0.0, 0.7, 1.9)
    np.testing.assert_array_equal(F, np.eye(6))
    np.testing.assert_array_equal(Q, np.zeros((6, 6)))


@given(poses, poses)
def test_increment_leads_from_the_reference_to_the_pose(reference: FloatArray, pose: FloatArray) -> None:
    difference = compose(reference, increment(reference, pose)[0]) - pose
    difference[2] = np.angle(np.exp(1j * difference[2]))
    np.testing.assert_allclose(difference, 0.0, atol=1e-11)


@given(poses, poses)
def test_jacobians_of_the_increment(reference: FloatArray, pose: FloatArray) -> None:
    _, by_reference, by_pose = increment(reference, pose)
    numerical = numerical_jacobian(lambda x: increment(x, pose)[0], reference, angle_rows=(2,))
    np.testing.assert_allclose(by_reference, numerical, atol=1e-6)
    numerical = numerical_jacobian(lambda x: increment(reference, x)[0], pose, angle_rows=(2,))
    np.testing.assert_allclose(by_pose, numerical, atol=1e-6)
