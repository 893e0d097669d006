"""Poses in north, east, down: signs, attitude, covariance, velocity."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from companion.mavlink.pose_out import to_ned
from estimators.geometry import lift
from estimators.messages import FloatArray, PoseEstimate

angles = st.floats(-3.1, 3.1)


def estimate(T: FloatArray, cov: FloatArray | None = None, stamp_ns: int = 0) -> PoseEstimate:
    return PoseEstimate(stamp_ns, T, np.eye(6) if cov is None else cov, 0)


def planar(x: float, y: float, yaw_deg: float) -> FloatArray:
    return lift(np.array([x, y, np.deg2rad(yaw_deg)]), 0.5)


@pytest.mark.parametrize(
    ("heading_deg", "pose", "north", "east", "yaw_deg"),
    [
        # Map x to the north: y, which is left of it, is west.
        (0.0, (2.0, 0.0, 0.0), 2.0, 0.0, 0.0),
        (0.0, (0.0, 3.0, 90.0), 0.0, -3.0, -90.0),
        # Map x to the east: y is north; a robot facing along y faces north.
        (90.0, (2.0, 0.0, 0.0), 0.0, 2.0, 90.0),
        (90.0, (0.0, 3.0, 90.0), 3.0, 0.0, 0.0),
        # The demo room: map x points 30 deg east of north.
        (30.0, (1.0, 0.0, 0.0), np.cos(np.pi / 6), 0.5, 30.0),
        (30.0, (0.0, 1.0, 45.0), 0.5, -np.cos(np.pi / 6), -15.0),
    ],
)
def test_signs(
    heading_deg: float, pose: tuple[float, float, float], north: float, east: float, yaw_deg: float
) -> None:
    ned = to_ned(estimate(planar(*pose)), np.deg2rad(heading_deg))
    assert ned.position == pytest.approx([north, east, -0.5])
    assert np.rad2deg(ned.roll_pitch_yaw) == pytest.approx([0.0, 0.0, yaw_deg])


@given(roll=st.floats(-1.5, 1.5), pitch=st.floats(-1.5, 1.5), yaw=angles, heading=angles)
def test_attitude_agrees_with_rotation_matrices(
    roll: float, pitch: float, yaw: float, heading: float
) -> None:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    flip = np.diag([1.0, -1.0, -1.0])
    R_ned_map = Rotation.from_euler("Z", heading).as_matrix() @ flip
    expected = Rotation.from_matrix(R_ned_map @ T[:3, :3] @ flip)
    roll_ned, pitch_ned, yaw_ned = to_ned(estimate(T), heading).roll_pitch_yaw
    given_out = Rotation.from_euler("ZYX", [yaw_ned, pitch_ned, roll_ned])
    assert (expected.inv() * given_out).magnitude() < 1e-6


def test_covariance_agrees_with_samples() -> None:
    rng = np.random.default_rng(0)
    root = rng.standard_normal((6, 6)) * [0.1, 0.2, 0.05, 0.01, 0.01, 0.02]
    cov = root @ root.T
    heading = np.deg2rad(37.0)
    mean = np.array([1.0, 2.0, 0.3, 0.0, 0.0, 0.6])
    samples = rng.multivariate_normal(mean, cov, 5_000)
    out = []
    for x, y, z, roll, pitch, yaw in samples:
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
        T[:3, 3] = x, y, z
        ned = to_ned(estimate(T, cov), heading)
        out.append(np.concatenate([ned.position, ned.roll_pitch_yaw]))
    sampled = np.cov(np.array(out).T)
    stated = to_ned(estimate(planar(0, 0, 0), cov), heading).cov
    scale = np.sqrt(np.outer(np.diag(cov), np.diag(cov)).max())
    assert np.abs(sampled - stated).max() < 0.06 * scale


def test_velocity_turns_with_the_map() -> None:
    given_out = PoseEstimate(
        0, planar(0, 0, 0), np.eye(6), 0, np.array([1.0, 0.0, 0.5]), np.diag([4.0, 1.0, 9.0])
    )
    ned = to_ned(given_out, np.deg2rad(90.0))
    assert ned.velocity == pytest.approx([0.0, 1.0, -0.5])
    assert ned.velocity_cov == pytest.approx(np.diag([1.0, 4.0, 9.0]))
