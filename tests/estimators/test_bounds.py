"""The posterior Cramer-Rao bound against cases whose answer is known another way."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimators.bounds import landmark_information, posterior_bound, range_information, seen_from
from estimators.geometry import between, compose, wrap_angle
from estimators.messages import FloatArray
from estimators.models.motion import increment
from tests.estimators.matched_world import tag_of
from tests.estimators.models.finite_differences import numerical_jacobian
from tests.strategies import SETUP

START_COV = np.diag([0.04, 0.09, 0.01])
STEP_COV = np.array([[4e-4, 1e-4, 0.0], [1e-4, 9e-4, 1e-4], [0.0, 1e-4, 1e-4]])
SIGMA = 0.1
IDS = list(SETUP.anchors)
LANDMARKS = {0: np.array([1.0, 5.0]), 7: np.array([6.0, 1.0])}
PLACE = replace(SETUP, landmarks=LANDMARKS)

variances = st.floats(1e-4, 1.0)


def curved_path(count: int) -> FloatArray:
    """Poses (count, 3) of a walk that turns all the time."""
    poses = [np.array([3.0, 2.0, 0.7])]
    for k in range(count - 1):
        poses.append(compose(poses[-1], np.array([0.3, 0.05, 0.4 - 0.01 * k])))
    return np.array(poses)


def slant(pose: FloatArray, anchor_id: int) -> float:
    return float(np.linalg.norm(SETUP.anchors[anchor_id] - tag_of(pose, SETUP)))


def informations(poses: FloatArray) -> FloatArray:
    return np.array([range_information(pose, SETUP, IDS, SIGMA) for pose in poses])


@given(step=variances, noise=variances, start=variances)
def test_a_standing_robot_is_the_scalar_kalman_filter(step: float, noise: float, start: float) -> None:
    poses = np.zeros((300, 3))
    eye = np.eye(3)
    information = np.broadcast_to(eye / noise, (300, 3, 3))
    bounds = posterior_bound(start * eye, poses, [step * eye] * 299, information)
    first = 1.0 / (1.0 / start + 1.0 / noise)
    second = 1.0 / (1.0 / (first + step) + 1.0 / noise)
    np.testing.assert_allclose(bounds[:2], [first * eye, second * eye], rtol=1e-9, atol=1e-12)
    # The steady state solves 1/p = 1/(p + q) + 1/r.
    steady = (-step + np.sqrt(step**2 + 4.0 * step * noise)) / 2.0
    np.testing.assert_allclose(bounds[-1], steady * eye, rtol=0.01, atol=1e-12)


def test_the_recursion_gives_the_last_block_of_the_inverse_joint_information() -> None:
    poses = curved_path(12)
    count = len(poses)
    joint = np.zeros((3 * count, 3 * count))
    joint[:3, :3] = np.linalg.inv(START_COV)
    for k, information in enumerate(informations(poses)):
        joint[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += information
    for k in range(count - 1):
        _, by_reference, by_pose = increment(poses[k], poses[k + 1])
        H = np.hstack([by_reference, by_pose])
        joint[3 * k : 3 * k + 6, 3 * k : 3 * k + 6] += H.T @ np.linalg.inv(STEP_COV) @ H
    bounds = posterior_bound(START_COV, poses, [STEP_COV] * (count - 1), informations(poses))
    np.testing.assert_allclose(bounds[-1], np.linalg.inv(joint)[-3:, -3:], rtol=1e-9)


def test_it_is_the_covariance_of_an_extended_kalman_filter_at_the_truth() -> None:
    poses = curved_path(15)
    bounds = posterior_bound(START_COV, poses, [STEP_COV] * 14, informations(poses))
    P = START_COV
    for k, pose in enumerate(poses):
        if k:
            step = between(poses[k - 1], pose)
            F = numerical_jacobian(lambda at, u=step: compose(at, u), poses[k - 1], angle_rows=(2,))  # type: ignore[misc]
            G = numerical_jacobian(lambda u, at=poses[k - 1]: compose(at, u), step, angle_rows=(2,))  # type: ignore[misc]
            P = F @ P @ F.T + G @ STEP_COV @ G.T
        H = numerical_jacobian(lambda at: np.array([slant(at, i) for i in IDS]), pose)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + SIGMA**2 * np.eye(len(IDS)))
        P = P - K @ H @ P
        np.testing.assert_allclose(bounds[k], P, rtol=1e-5, atol=1e-10)


def test_a_kalman_filter_reaches_it_and_no_more() -> None:
    rng = np.random.default_rng(0)
    poses = curved_path(15)
    information = informations(poses)
    bounds = posterior_bound(START_COV, poses, [STEP_COV] * 14, information)
    root = np.linalg.cholesky(STEP_COV)
    squares = []
    for _ in range(300):
        x, P = poses[0] + np.sqrt(np.diag(START_COV)) * rng.standard_normal(3), START_COV
        for k, pose in enumerate(poses):
            if k:
                measured = between(poses[k - 1], pose) + root @ rng.standard_normal(3)
                before, x = x, compose(x, measured)
                _, by_reference, by_pose = increment(before, x)
                G = np.linalg.inv(by_pose)
                P = G @ (by_reference @ P @ by_reference.T + STEP_COV) @ G.T
            for anchor_id in IDS:
                range_ = slant(pose, anchor_id) + SIGMA * rng.standard_normal()
                H = numerical_jacobian(lambda at, i=anchor_id: np.array([slant(at, i)]), x)  # type: ignore[misc]
                gain = P @ H.T / float((H @ P @ H.T).item() + SIGMA**2)
                x = x + gain[:, 0] * (range_ - slant(x, anchor_id))
                P = P - gain @ H @ P
        error = x - poses[-1]
        error[2] = wrap_angle(error[2])
        squares.append(error**2)
    # A mean of 300 squares is known to 8 %.
    assert np.mean(squares, axis=0) == pytest.approx(np.diag(bounds[-1]), rel=0.3)


def test_range_information_is_the_square_of_the_slant_gradient() -> None:
    for pose in curved_path(8):
        H = numerical_jacobian(lambda at: np.array([slant(at, i) for i in IDS[:2]]), pose)
        information = range_information(pose, SETUP, IDS[:2], SIGMA)
        np.testing.assert_allclose(information, H.T @ H / SIGMA**2, rtol=1e-5, atol=1e-6)


def test_information_on_one_pose_tells_of_another_a_known_way_off() -> None:
    pose, way = np.array([2.0, 1.5, 0.4]), np.array([0.7, -0.3, 0.5])
    step = 1e-6
    shifted = [compose(pose + step * axis, way) - compose(pose - step * axis, way) for axis in np.eye(3)]
    by_pose = np.column_stack(shifted) / (2.0 * step)
    there = compose(pose, way)
    information = range_information(there, SETUP, IDS[:2], SIGMA)
    expected = by_pose.T @ information @ by_pose
    assert seen_from(pose, there, information) == pytest.approx(expected, rel=1e-6)


def test_landmark_information_counts_range_and_bearing() -> None:
    pose = np.array([3.0, 2.0, 0.7])
    information = landmark_information(pose, PLACE, [0, 7], 0.03, 0.01)

    def seen(at: FloatArray) -> FloatArray:
        offsets = [complex(*(p - at[:2])) * np.exp(-1j * at[2]) for p in LANDMARKS.values()]
        return np.array([*np.abs(offsets) / 0.03, *np.angle(offsets) / 0.01])

    H = numerical_jacobian(seen, pose)
    np.testing.assert_allclose(information, H.T @ H, rtol=1e-6, atol=1e-3)


def test_nothing_measured_leaves_the_start_and_the_steps() -> None:
    poses = np.zeros((4, 3))
    bounds = posterior_bound(START_COV, poses, [STEP_COV] * 3, np.zeros((4, 3, 3)))
    np.testing.assert_allclose(bounds, [START_COV + k * STEP_COV for k in range(4)], rtol=1e-9, atol=1e-15)
