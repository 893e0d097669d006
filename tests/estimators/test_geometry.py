"""SE(2) as (x, y, yaw): group axioms, also next to the identity and to half a turn."""

from math import cos, pi, sin

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimators.geometry import (
    between,
    compose,
    exponential,
    inverse,
    lift,
    logarithm,
    rotation,
    transform,
    transform_each,
    wrap_angle,
    wrap_angles,
)
from estimators.messages import FloatArray
from tests.strategies import angles, coordinates, poses


def assert_same_motion(actual: FloatArray, expected: FloatArray, atol: float = 1e-11) -> None:
    """Equal up to rounding, yaw as an angle: -pi and pi are one heading."""
    difference = actual - expected
    difference[2] = np.angle(np.exp(1j * difference[2]))
    np.testing.assert_allclose(difference, 0.0, atol=atol)


@given(poses)
def test_identity_changes_nothing_on_either_side(T: FloatArray) -> None:
    assert_same_motion(compose(T, np.zeros(3)), T)
    assert_same_motion(compose(np.zeros(3), T), T)


@given(poses)
def test_inverse_undoes_on_either_side(T: FloatArray) -> None:
    assert_same_motion(compose(T, inverse(T)), np.zeros(3))
    assert_same_motion(compose(inverse(T), T), np.zeros(3))
    assert_same_motion(inverse(inverse(T)), T)


@given(poses, poses, poses)
def test_composition_is_associative(A: FloatArray, B: FloatArray, C: FloatArray) -> None:
    assert_same_motion(compose(compose(A, B), C), compose(A, compose(B, C)))


@given(poses, poses)
def test_inverse_of_a_composition_is_the_reversed_composition_of_inverses(
    A: FloatArray, B: FloatArray
) -> None:
    assert_same_motion(inverse(compose(A, B)), compose(inverse(B), inverse(A)))


@given(poses, poses)
def test_between_is_what_leads_from_one_pose_to_the_other(A: FloatArray, B: FloatArray) -> None:
    assert_same_motion(compose(A, between(A, B)), B)
    assert_same_motion(between(A, compose(A, B)), B)


@given(poses, poses)
def test_composition_is_the_product_of_the_4x4_transforms(A: FloatArray, B: FloatArray) -> None:
    np.testing.assert_allclose(lift(compose(A, B), 0.7), lift(A, 0.4) @ lift(B, 0.3), atol=1e-11)


@given(poses, st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=5), coordinates)
def test_transform_agrees_with_the_4x4_transform(
    T_a_b: FloatArray, plan: list[tuple[float, float]], z: float
) -> None:
    points_b = np.array(plan)
    homogeneous = np.column_stack([points_b, np.zeros(len(points_b)), np.ones(len(points_b))])
    lifted = homogeneous @ lift(T_a_b, z).T
    np.testing.assert_allclose(transform(T_a_b, points_b), lifted[:, :2], atol=1e-11)
    np.testing.assert_array_equal(lifted[:, 2], np.full(len(points_b), z))


@given(angles)
def test_rotation_is_proper_and_turns_counter_clockwise(yaw: float) -> None:
    R = rotation(yaw)
    np.testing.assert_allclose(R.T @ R, np.eye(2), atol=1e-15)
    np.testing.assert_allclose(R @ np.array([1.0, 0.0]), [cos(yaw), sin(yaw)])
    np.testing.assert_allclose(R @ np.array([0.0, 1.0]), [-sin(yaw), cos(yaw)])


@given(st.floats(-1e4, 1e4))
def test_wrapped_angle_is_the_same_heading_in_range(angle: float) -> None:
    wrapped = wrap_angle(angle)
    assert -pi <= wrapped <= pi
    assert abs(np.exp(1j * wrapped) - np.exp(1j * angle)) < 1e-11


@given(angles, st.integers(-50, 50))
def test_whole_turns_do_not_matter(angle: float, turns: int) -> None:
    assert abs(np.exp(1j * wrap_angle(angle + 2 * pi * turns)) - np.exp(1j * angle)) < 1e-12


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [(0.0, 0.0), (pi / 2, pi / 2), (-5 * pi / 2, -pi / 2), (3.2, 3.2 - 2 * pi), (-3.2, 2 * pi - 3.2)],
)
def test_wrapped_values(angle: float, wrapped: float) -> None:
    assert wrap_angle(angle) == pytest.approx(wrapped, abs=1e-14)


@pytest.mark.parametrize("angle", [pi, -pi, 3 * pi, -3 * pi])
def test_half_a_turn_stays_half_a_turn(angle: float) -> None:
    assert abs(wrap_angle(angle)) == pytest.approx(pi, abs=1e-14)


twists = st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-3.1, 3.1)).map(np.array)


@given(twists)
def test_logarithm_inverts_exponential(twist: FloatArray) -> None:
    np.testing.assert_allclose(logarithm(exponential(twist)), twist, atol=1e-9)


@given(twists)
def test_exponential_is_many_small_steps(twist: FloatArray) -> None:
    step, pose = exponential(twist / 64.0), np.zeros(3)
    for _ in range(64):
        pose = compose(pose, step)
    expected = exponential(twist)
    np.testing.assert_allclose(pose[:2], expected[:2], atol=1e-9)
    assert np.cos(pose[2] - expected[2]) == pytest.approx(1.0)


@given(st.floats(-1e-6, 1e-6), st.floats(-1e-6, 1e-6), st.floats(-1e-5, 1e-5))
def test_exponential_near_the_identity(vx: float, vy: float, rate: float) -> None:
    np.testing.assert_allclose(exponential(np.array([vx, vy, rate])), [vx, vy, rate], atol=1e-11)


@given(st.lists(poses, min_size=1, max_size=5), coordinates, coordinates)
def test_transform_each_is_transform_pose_by_pose(many: list[FloatArray], x: float, y: float) -> None:
    point = np.array([[x, y]])
    expected = np.vstack([transform(pose, point) for pose in many])
    np.testing.assert_allclose(transform_each(np.array(many), point), expected, atol=1e-9)
    np.testing.assert_allclose(
        transform_each(np.array(many), np.repeat(point, len(many), axis=0)), expected, atol=1e-9
    )


@given(st.lists(st.floats(-50.0, 50.0), min_size=1, max_size=5))
def test_wrap_angles_is_wrap_angle_for_many(many: list[float]) -> None:
    wrapped = wrap_angles(np.array(many))
    assert ((wrapped >= -pi) & (wrapped < pi)).all()
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * np.array([wrap_angle(a) for a in many])))
