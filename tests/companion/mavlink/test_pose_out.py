"""Poses for the autopilot: signs, covariance, and nothing that is not finite."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink2
from scipy.spatial.transform import Rotation

from companion.mavlink.pose_out import ned_pose, to_ned, vision_position_estimate
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
    samples = rng.multivariate_normal(mean, cov, 20_000)
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
    assert np.abs(sampled - stated).max() < 0.03 * scale


def test_message_survives_pymavlinks_own_parser() -> None:
    rng = np.random.default_rng(1)
    root = rng.standard_normal((6, 6))
    cov = root @ root.T
    pose = PoseEstimate(123_456_789_000, planar(1.25, -2.5, 10.0), cov, 300)
    message = vision_position_estimate(pose, 0.5)
    assert message is not None
    frame = bytes(message.pack(mavlink2.MAVLink(None, srcSystem=7, srcComponent=197)))
    assert frame[0] == 0xFD  # MAVLink 2
    parsed = mavlink2.MAVLink(None).parse_buffer(frame)[0]
    assert (parsed.usec, parsed.reset_counter) == (123_456_789, 300 - 256)
    expected, received = to_ned(pose, 0.5), ned_pose(parsed)
    assert received.position == pytest.approx(expected.position, rel=1e-6)
    assert received.roll_pitch_yaw == pytest.approx(expected.roll_pitch_yaw, rel=1e-6)
    assert received.cov == pytest.approx(expected.cov, rel=1e-5)
    # The six variances stand where the protocol says.
    assert [parsed.covariance[i] for i in (0, 6, 11, 15, 18, 20)] == pytest.approx(
        np.diag(expected.cov).tolist(), rel=1e-6
    )


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_nothing_that_is_not_finite_leaves(bad: float) -> None:
    cov = np.eye(6)
    cov[5, 5] = bad
    assert vision_position_estimate(estimate(planar(0, 0, 0), cov), 0.0) is None
    T = planar(0, 0, 0)
    T[0, 3] = bad
    assert vision_position_estimate(estimate(T), 0.0) is None
    T = planar(0, 0, 0)
    T[0, 0] = bad
    assert vision_position_estimate(estimate(T), 0.0) is None
