"""Accelerations brought to a level frame, and the model that the filter holds against them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimators.messages import Attitude, ImuSample
from estimators.models.inertial import (
    GRAVITY,
    Leveller,
    is_possible,
    level_acceleration,
    predicted_acceleration,
)
from tests.estimators.models.finite_differences import numerical_jacobian

SECOND_NS = 10**9


def attitude(stamp_ns: int, rotation: Rotation) -> Attitude:
    return Attitude(stamp_ns, rotation.as_quat(scalar_first=True))


def test_gravity_is_gone_whatever_the_attitude() -> None:
    rng = np.random.default_rng(0)
    for R_level_body in Rotation.random(20, random_state=rng):
        true = np.array([*rng.normal(size=2), 0.3])
        specific_force = R_level_body.inv().apply(true + np.array([0.0, 0.0, GRAVITY]))
        np.testing.assert_allclose(
            level_acceleration(R_level_body.as_matrix(), specific_force), true[:2], atol=1e-12
        )


def test_jacobian_is_that_of_finite_differences() -> None:
    R_level_body = Rotation.from_euler("ZYX", [0.7, 0.1, -0.05]).as_matrix()
    at = np.array([0.4, -1.1, 2.2, 0.05, -0.08])
    _, analytic = predicted_acceleration(at[:2], at[2], at[3:], R_level_body)
    numeric = numerical_jacobian(
        lambda v: predicted_acceleration(v[:2], float(v[2]), v[3:], R_level_body)[0], at
    )
    np.testing.assert_allclose(analytic, numeric, atol=1e-7)


def test_prediction_is_what_a_level_sensor_measures() -> None:
    psi, yaw_level = 0.6, 0.9
    accel_map = np.array([1.0, -0.5])
    R_level_body = Rotation.from_euler("z", yaw_level)
    R_map_body = Rotation.from_euler("z", psi + yaw_level)
    specific_force = R_map_body.inv().apply([*accel_map, GRAVITY])
    predicted, _ = predicted_acceleration(accel_map, psi, np.zeros(2), R_level_body.as_matrix())
    np.testing.assert_allclose(
        level_acceleration(R_level_body.as_matrix(), specific_force), predicted, atol=1e-12
    )


def test_the_gyro_carries_the_attitude_on_until_it_is_too_old() -> None:
    leveller = Leveller()
    assert leveller.matrix(0, 1.0) is None
    assert leveller.take_attitude(attitude(0, Rotation.from_euler("z", 0.2)))
    for k in range(1, 51):
        leveller.carry_on(ImuSample(k * SECOND_NS // 100, np.array([0.0, 0.0, 0.8]), np.zeros(3)))
    R_level_body = leveller.matrix(SECOND_NS // 2, 1.0)
    assert R_level_body is not None
    np.testing.assert_allclose(R_level_body, Rotation.from_euler("z", 0.6).as_matrix(), atol=1e-12)
    assert leveller.matrix(SECOND_NS + 1, 1.0) is None


@pytest.mark.parametrize("quat", [(0.0, 0.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0), (float("nan"), 0.0, 0.0, 1.0)])
def test_what_is_no_rotation_is_no_attitude(quat: tuple[float, ...]) -> None:
    leveller = Leveller()
    assert not leveller.take_attitude(Attitude(0, np.array(quat)))
    assert leveller.matrix(0, 1.0) is None


@pytest.mark.parametrize("accel", [float("nan"), float("inf"), 1e3, -1e3])
def test_impossible_samples_are_told(accel: float) -> None:
    assert is_possible(ImuSample(0, np.zeros(3), np.array([0.0, 0.0, 9.8])))
    assert not is_possible(ImuSample(0, np.zeros(3), np.array([0.0, accel, 9.8])))
    assert not is_possible(ImuSample(0, np.array([0.0, accel, 0.0]), np.zeros(3)))
