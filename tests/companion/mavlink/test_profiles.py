"""Messages as ArduPilot and PX4 read them, field by field, after pymavlink's own parser."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink2
from scipy.spatial.transform import Rotation

from companion.mavlink.pose_out import to_ned
from companion.mavlink.profiles import PROFILES, reported_covariance
from companion.mavlink_table import MavlinkTable
from companion.sim.autopilot import ned_pose
from estimators.geometry import lift
from estimators.messages import FloatArray, PoseEstimate
from tests.companion.mavlink.flight import messages

HEADING = np.deg2rad(30.0)
DIAGONAL = (0, 6, 11, 15, 18, 20)


def estimate(cov: FloatArray | None = None, velocity: FloatArray | None = None) -> PoseEstimate:
    T = lift(np.array([1.25, -2.5, np.deg2rad(10.0)]), 0.5)
    root = np.random.default_rng(1).standard_normal((6, 6)) * [0.1, 0.1, 0.05, 0.02, 0.02, 0.03]
    velocity_cov = None if velocity is None else np.diag([0.01, 0.02, 0.03])
    return PoseEstimate(123_456_789_000, T, root @ root.T if cov is None else cov, 0, velocity, velocity_cov)


def sent(profile: str, pose: PoseEstimate, **settings: Any) -> list[Any]:
    table = MavlinkTable.model_validate(settings)
    packer = mavlink2.MAVLink(None, srcSystem=7, srcComponent=197)
    packed = PROFILES[profile].messages(pose, HEADING, table, 44, 100)
    return messages(b"".join(bytes(message.pack(packer)) for message in packed))


def ardupilot_errors(cov: list[float]) -> tuple[float, float]:
    """Position error [m] as ArduPilot makes it of the variances: before 2026, and after."""
    x, y, z = (cov[i] for i in DIAGONAL[:3])
    return float(np.cbrt(x**2 + y**2 + z**2)), float(np.sqrt(x + y + z))


@pytest.mark.parametrize("profile", PROFILES)
def test_every_field_of_vision_position_estimate(profile: str) -> None:
    pose = estimate()
    (message,) = sent(profile, pose, height=True)
    expected, received = to_ned(pose, HEADING), ned_pose(message)
    assert (message.get_type(), message.usec, message.reset_counter) == (
        "VISION_POSITION_ESTIMATE",
        123_456_789,
        44,
    )
    c, s = np.cos(HEADING), np.sin(HEADING)
    assert received.position == pytest.approx([1.25 * c - 2.5 * s, 1.25 * s + 2.5 * c, -0.5], rel=1e-6)
    assert np.rad2deg(received.roll_pitch_yaw) == pytest.approx([0.0, 0.0, 20.0], abs=1e-5)
    assert received.cov == pytest.approx(expected.cov, rel=1e-5)
    # The six variances stand where the protocol says.
    assert [message.covariance[i] for i in DIAGONAL] == pytest.approx(np.diag(expected.cov), rel=1e-6)


@pytest.mark.parametrize(("profile", "frame"), [("ardupilot", 20), ("px4", 1)])
def test_every_field_of_odometry(profile: str, frame: int) -> None:
    pose = estimate(velocity=np.array([0.5, 0.0, 0.0]))
    (message,) = sent(profile, pose, message="odometry", height=True)
    assert (message.frame_id, message.child_frame_id) == (frame, 12)
    assert (message.estimator_type, message.quality, message.reset_counter) == (2, 100, 44)
    assert message.time_usec == 123_456_789
    expected = to_ned(pose, HEADING)
    assert [message.x, message.y, message.z] == pytest.approx(expected.position, rel=1e-6)
    w, x, y, z = message.q
    assert abs(np.linalg.norm(message.q) - 1.0) < 1e-6
    turned = Rotation.from_quat([x, y, z, w]).as_euler("ZYX", degrees=True)
    assert turned == pytest.approx([20.0, 0.0, 0.0], abs=1e-4)
    # Along the map's x axis, with the robot turned 10 deg left of it: forward and to its right.
    assert [message.vx, message.vy, message.vz] == pytest.approx(
        [0.5 * np.cos(np.deg2rad(10)), 0.5 * np.sin(np.deg2rad(10)), 0.0], abs=1e-6
    )
    assert np.isnan([message.rollspeed, message.pitchspeed, message.yawspeed]).all()
    assert [message.pose_covariance[i] for i in DIAGONAL] == pytest.approx(np.diag(expected.cov), rel=1e-6)
    assert all(message.velocity_covariance[i] > 0.0 for i in DIAGONAL)


def test_odometry_without_velocity_says_so_and_does_not_say_zero() -> None:
    (message,) = sent("ardupilot", estimate(), message="odometry")
    assert np.isnan([message.vx, message.vy, message.vz, message.velocity_covariance[0]]).all()


def test_speed_goes_to_ardupilot_alone_which_reads_it() -> None:
    pose = estimate(velocity=np.array([0.5, 0.0, 0.0]))
    assert [m.get_type() for m in sent("px4", pose, speed=True)] == ["VISION_POSITION_ESTIMATE"]
    _, speed = sent("ardupilot", pose, speed=True)
    assert speed.get_type() == "VISION_SPEED_ESTIMATE"
    assert [speed.x, speed.y, speed.z] == pytest.approx(
        [0.5 * np.cos(HEADING), 0.5 * np.sin(HEADING), 0.0], abs=1e-6
    )
    assert [speed.covariance[i] for i in (0, 4, 8)] == pytest.approx([0.0125, 0.0175, 0.03], rel=1e-5)
    assert speed.reset_counter == 44


def test_unknown_covariance_is_nan_in_the_first_place_and_never_zeros() -> None:
    pose = estimate(velocity=np.array([0.5, 0.0, 0.0]))
    position, speed = sent("ardupilot", pose, speed=True, covariance="unknown")
    (odometry,) = sent("px4", pose, message="odometry", covariance="unknown")
    for covariance in (
        position.covariance,
        speed.covariance,
        odometry.pose_covariance,
        odometry.velocity_covariance,
    ):
        assert np.isnan(covariance[0])
        assert not any(covariance[1:])


@pytest.mark.parametrize("heading_variance", [0.01, np.inf])
def test_without_heading_the_attitude_is_unknown_and_its_variances_are_finite(
    heading_variance: float,
) -> None:
    cov = np.diag([0.04, 0.04, 0.0025, 0.003, 0.003, heading_variance])
    (message,) = sent("ardupilot", estimate(cov), heading=False)
    assert np.isnan([message.roll, message.pitch, message.yaw]).all()
    assert np.isfinite([message.x, message.y, message.z]).all()
    assert np.isfinite(message.covariance).all()
    assert message.covariance[20] == pytest.approx(np.pi**2 / 3)
    (odometry,) = sent("px4", estimate(cov), heading=False, message="odometry")
    assert np.isnan(odometry.q).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", ["variance", "position", "rotation", "velocity"])
def test_nothing_that_is_not_finite_leaves(bad: float, place: str) -> None:
    cov, T, velocity = np.eye(6), lift(np.zeros(3), 0.5), np.zeros(3)
    {"variance": cov[5], "position": T[0, 3:], "rotation": T[0], "velocity": velocity}[place][-1:] = bad
    if place == "rotation":
        T[0, 0] = bad
    pose = PoseEstimate(0, T, cov, 0, velocity, np.eye(3))
    assert sent("ardupilot", pose, speed=True) == []
    assert sent("px4", pose, message="odometry") == []


@given(
    sigma=st.floats(0.005, 3.0),
    ratio=st.floats(0.3, 3.0),
    height_sigma=st.floats(1e-3, 20.0),
    yaw=st.floats(1e-4, 1.0),
)
def test_what_ardupilot_makes_of_the_variances_is_sane_before_and_after_2026(
    sigma: float, ratio: float, height_sigma: float, yaw: float
) -> None:
    cov = np.diag([sigma**2, (ratio * sigma) ** 2, height_sigma**2, 0.003, 0.003, yaw])
    cov[0, 2] = cov[2, 0] = 0.5 * sigma * height_sigma
    reported = reported_covariance(cov, MavlinkTable.model_validate({}))
    assert np.linalg.eigvalsh(reported)[0] > 0.0
    widest = max(1.0, ratio) * sigma
    _, after = ardupilot_errors(reported[np.triu_indices(6)].tolist())
    # However little is known of the height, which is not used, x and y look no worse than sqrt(3) times.
    assert after <= np.sqrt(3.0) * widest * (1 + 1e-9)
    before, _ = ardupilot_errors(reported[np.triu_indices(6)].tolist())
    assert before <= np.cbrt(3.0) * widest ** (4 / 3) * (1 + 1e-9)
    # The plane is reported as it is.
    assert reported[:2, :2] == pytest.approx(cov[:2, :2])


def test_a_height_that_is_used_is_reported_as_it_is() -> None:
    cov = np.diag([0.01, 0.01, 4.0, 0.003, 0.003, 0.01])
    assert reported_covariance(cov, MavlinkTable.model_validate({"height": True}))[2, 2] == 4.0
    assert reported_covariance(cov, MavlinkTable.model_validate({}))[2, 2] == pytest.approx(0.01)


def test_no_variance_rounds_to_zero() -> None:
    (message,) = sent("ardupilot", estimate(np.eye(6) * 1e-60))
    assert all(message.covariance[i] > 0.0 for i in DIAGONAL)
