"""What an autopilot measures: units, axes, stamps, echoes; increments of wheels and odometry."""

from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from pymavlink.dialects.v20 import all as mavlink2
from scipy.spatial.transform import Rotation

from drivers.autopilot import Autopilot
from drivers.autopilot_clock import AutopilotClock
from estimators.geometry import between, compose, exponential
from estimators.messages import Attitude, FloatArray, Height, ImuSample, Measurement, PoseIncrement

SYSTEM = 7
BOOT_NS = 3_000_000_000
"""Host time at which the autopilot's clock showed 0."""
MS = 1_000_000
FLIP = np.diag([1.0, -1.0, -1.0])


class Line:
    """An autopilot and, beside it, an odometry computer."""

    def __init__(self, kind: float = mavlink2.MAV_AUTOPILOT_ARDUPILOTMEGA, **settings: float) -> None:
        self.sensor = Autopilot(Autopilot.Config.model_validate(settings))
        self.now_ns = BOOT_NS + 60_000 * MS
        self.say(mavlink2.MAVLink_heartbeat_message(2, kind, 0, 0, 3, 3))

    @property
    def boot_ms(self) -> int:
        return (self.now_ns - BOOT_NS) // MS

    def say(self, message: Any, component: int = 1, system: int = SYSTEM) -> list[Measurement]:
        data = message.pack(mavlink2.MAVLink(None, srcSystem=system, srcComponent=component))
        return self.sensor.feed(bytes(data), self.now_ns)

    def attitude(self, roll: float, pitch: float, yaw: float) -> list[Measurement]:
        return self.say(mavlink2.MAVLink_attitude_message(self.boot_ms, roll, pitch, yaw, 0, 0, 0))


@given(roll=st.floats(-3.1, 3.1), pitch=st.floats(-1.5, 1.5), yaw=st.floats(-3.1, 3.1))
def test_attitude_of_forward_left_up_axes_in_a_level_frame(roll: float, pitch: float, yaw: float) -> None:
    (attitude,) = Line(attitude=50).attitude(roll, pitch, yaw)
    assert isinstance(attitude, Attitude)
    w, x, y, z = attitude.quat_wxyz
    R_ned_frd = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    expected = Rotation.from_matrix(FLIP @ R_ned_frd @ FLIP)
    assert (Rotation.from_quat([x, y, z, w]).inv() * expected).magnitude() < 1e-5


@pytest.mark.parametrize(
    ("kind", "autopilot"), [("RAW_IMU", 3), ("SCALED_IMU", 3), ("HIGHRES_IMU", 12), ("HIGHRES_IMU", 3)]
)
def test_inertial_samples_in_si_units_and_forward_left_up(kind: str, autopilot: int) -> None:
    line = Line(autopilot, imu=100)
    usec = line.boot_ms * 1000
    message = {
        "RAW_IMU": mavlink2.MAVLink_raw_imu_message(usec, 100, 200, -1000, 10, 20, 30, 0, 0, 0),
        "SCALED_IMU": mavlink2.MAVLink_scaled_imu_message(line.boot_ms, 100, 200, -1000, 10, 20, 30, 0, 0, 0),
        "HIGHRES_IMU": mavlink2.MAVLink_highres_imu_message(
            usec, 0.980665, 1.96133, -9.80665, 0.01, 0.02, 0.03, 0, 0, 0, 0, 0, 0, 0, 63
        ),
    }[kind]
    (sample,) = line.say(message)
    assert isinstance(sample, ImuSample)
    assert sample.accel == pytest.approx([0.980665, -1.96133, 9.80665], rel=1e-6)
    assert sample.gyro == pytest.approx([0.01, -0.02, -0.03], rel=1e-6)
    assert sample.stamp_ns == line.now_ns


def test_of_several_inertial_messages_only_the_best_is_used() -> None:
    line = Line(imu=100)
    scaled = mavlink2.MAVLink_scaled_imu_message(line.boot_ms, 0, 0, -1000, 0, 0, 0, 0, 0, 0)
    raw = mavlink2.MAVLink_raw_imu_message(line.boot_ms * 1000, 0, 0, -1000, 0, 0, 0, 0, 0, 0)
    second = mavlink2.MAVLink_raw_imu_message(line.boot_ms * 1000, 0, 0, -1000, 0, 0, 0, 0, 0, 0, id=1)
    assert [len(line.say(message)) for message in (scaled, raw, scaled, raw, second)] == [1, 1, 0, 1, 0]


def test_units_of_raw_imu_are_known_of_ardupilot_alone() -> None:
    line = Line(mavlink2.MAV_AUTOPILOT_PX4, imu=100)
    assert line.say(mavlink2.MAVLink_raw_imu_message(1, 0, 0, -1000, 0, 0, 0, 0, 0, 0)) == []


def distance(boot_ms: int, centimetres: int, covariance: int = 4, orientation: int = 25, **more: Any) -> Any:
    return mavlink2.MAVLink_distance_sensor_message(
        boot_ms, 5, 700, centimetres, 0, 0, orientation, covariance, **more
    )


def test_height_of_a_sensor_that_looks_down() -> None:
    line = Line(height=10)
    (height,) = line.say(distance(line.boot_ms, 123))
    assert isinstance(height, Height)
    assert (height.height, height.sigma) == pytest.approx((1.23, 0.02))
    for useless in (
        distance(line.boot_ms, 4),
        distance(line.boot_ms, 701),
        distance(line.boot_ms, 123, orientation=0),
        distance(line.boot_ms, 123, signal_quality=1),
    ):
        assert line.say(useless) == []
    (unsure,) = line.say(distance(line.boot_ms, 123, covariance=255))
    assert isinstance(unsure, Height)
    assert 0.01 < unsure.sigma < 0.2


def test_rangefinder_serves_where_there_is_no_distance_sensor() -> None:
    line = Line(height=10)
    rangefinder = mavlink2.MAVLink_rangefinder_message(0.8, 0.0)
    (height,) = line.say(rangefinder)
    assert isinstance(height, Height)
    assert height.height == pytest.approx(0.8)
    line.say(distance(line.boot_ms, 80))
    assert line.say(rangefinder) == []


def test_nothing_is_measured_that_was_not_asked_for_or_by_a_stranger() -> None:
    line = Line()
    assert line.attitude(0, 0, 0) == []
    assert line.say(distance(line.boot_ms, 123)) == []
    line = Line(attitude=10)
    message = mavlink2.MAVLink_attitude_message(line.boot_ms, 0, 0, 0, 0, 0, 0)
    assert line.say(message, system=8) == []
    assert line.say(message, component=2) == []
    assert len(line.say(message)) == 1


def test_stamps_are_those_of_the_measurement_not_of_its_arrival() -> None:
    rng = np.random.default_rng(1)
    line = Line(attitude=50)
    errors = []
    for _ in range(300):
        line.now_ns += 20 * MS
        true_ns, boot_ms = line.now_ns, line.boot_ms
        line.now_ns += round(rng.uniform(0, 30) * MS)
        request = line.now_ns - round(rng.uniform(0, 30) * MS)
        line.say(mavlink2.MAVLink_timesync_message(true_ns - BOOT_NS, request - (line.now_ns - true_ns)))
        message = mavlink2.MAVLink_attitude_message(boot_ms, 0, 0, 0, 0, 0, 0)
        (attitude,) = line.say(message)
        assert isinstance(attitude, Attitude)
        assert attitude.stamp_ns <= line.now_ns
        errors.append(attitude.stamp_ns - true_ns)
        line.now_ns = true_ns
    assert np.abs(errors[100:]).max() < 2 * MS


def test_a_clock_that_was_set_anew_is_followed_at_once() -> None:
    clock = AutopilotClock()
    for i in range(50):
        clock.answered(i * 100 * MS, i * 100 * MS + 7_000 * MS, i * 100 * MS + 4 * MS)
    assert clock.offset_ns == pytest.approx(6_998 * MS, abs=MS)
    clock.answered(5_000 * MS, 1_000 * MS, 5_004 * MS)
    assert clock.offset_ns == pytest.approx(-4_002 * MS, abs=MS)
    clock.answered(5_100 * MS, 90_000 * MS, 5_104 * MS)
    assert clock.offset_ns == pytest.approx(84_898 * MS, abs=MS)


def odometry(line: Line, pose: FloatArray, frame: int, **more: Any) -> Any:
    """ODOMETRY of a planar pose in forward-left-up, written in the frame."""
    down = frame in (1, 20)
    x, y, yaw = pose * ([1, -1, -1] if down else [1, 1, 1])
    fields = {"reset_counter": 0, "estimator_type": mavlink2.MAV_ESTIMATOR_TYPE_VIO, "quality": 0, **more}
    quat = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
    return mavlink2.MAVLink_odometry_message(
        line.boot_ms * 1000, frame, 12, x, y, 0.0, quat, *[0.0] * 6, [0.0] * 21, [0.0] * 21, **fields
    )


def walk(line: Line, frame: int, steps: int = 20) -> tuple[FloatArray, list[PoseIncrement]]:
    """Poses of a curved walk and the increments that come out."""
    pose, poses, found = np.array([1.0, 2.0, 0.5]), [], []
    for _ in range(steps):
        line.now_ns += 50 * MS
        found += line.say(odometry(line, pose, frame), component=197)
        poses.append(pose)
        pose = compose(pose, exponential(np.array([0.03, 0.002, 0.04])))
    assert all(isinstance(item, PoseIncrement) for item in found)
    return np.array(poses), found  # type: ignore[return-value]


@pytest.mark.parametrize("frame", [1, 20, 21, 4])
def test_odometry_in_any_frame_gives_the_increments_of_the_walk(frame: int) -> None:
    line = Line(odometry=20)
    poses, found = walk(line, frame)
    assert len(found) == len(poses)
    assert found[0].from_stamp_ns == found[0].stamp_ns
    for i, increment in enumerate(found[1:], 1):
        assert increment.increment == pytest.approx(between(poses[i - 1], poses[i]), abs=1e-6)
        assert increment.from_stamp_ns == found[i - 1].stamp_ns
        assert increment.is_keyframe
        assert np.linalg.eigvalsh(increment.cov)[0] > 0.0


def test_an_echo_of_the_autopilots_own_pose_is_no_odometry() -> None:
    line = Line(odometry=20)
    assert line.say(odometry(line, np.zeros(3), 1, estimator_type=8), component=197) == []
    assert line.say(odometry(line, np.zeros(3), 1)) == []


def test_odometry_begins_anew_after_a_reset_a_gap_a_jump_and_a_failure() -> None:
    line = Line(odometry=20)

    def step(x: float, seconds: float = 0.05, **more: Any) -> Any:
        line.now_ns += round(seconds * 1e9)
        found = line.say(odometry(line, np.array([x, 0.0, 0.0]), 20, **more), component=197)
        return found[0] if found else None

    def founds(increment: Any) -> bool:
        return bool(increment.from_stamp_ns == increment.stamp_ns)

    assert founds(step(0.0))
    assert not founds(step(0.1))
    assert founds(step(0.1, reset_counter=1))
    assert not founds(step(0.2, reset_counter=1))
    assert founds(step(0.3, seconds=1.5, reset_counter=1))
    assert founds(step(50.0, reset_counter=1))
    assert step(50.1, reset_counter=1, quality=-1) is None
    assert founds(step(50.2, reset_counter=1))
    assert step(np.nan, reset_counter=1) is None


def test_two_wheels_give_the_arc_that_they_rolled() -> None:
    line = Line(wheels=20, wheel_track=0.4)
    left = right = 0.0
    pose = np.zeros(3)
    for _ in range(40):
        line.now_ns += 50 * MS
        distances = [left, right] + [0.0] * 14
        (found,) = line.say(mavlink2.MAVLink_wheel_distance_message(line.boot_ms * 1000, 2, distances))
        assert isinstance(found, PoseIncrement)
        pose = compose(pose, found.increment)
        left, right = left + 0.02, right + 0.03
    # A circle of radius track / 2 * (r + l) / (r - l) = 1 m, driven for 39 * 0.025 rad.
    angle = 39 * 0.025
    assert pose == pytest.approx([np.sin(angle), 1.0 - np.cos(angle), angle], abs=1e-3)


def test_two_odometries_at_once_are_refused() -> None:
    with pytest.raises(ValidationError, match="cannot be chained"):
        Autopilot.Config.model_validate({"odometry": 10.0, "wheels": 10.0})


@given(data=st.binary(max_size=400), cut=st.integers(0, 400))
def test_any_bytes_in_any_chunks_do_no_harm(data: bytes, cut: int) -> None:
    line = Line(attitude=50, imu=100, height=10, odometry=10)
    for chunk in (data[:cut], data[cut:]):
        line.sensor.feed(chunk, line.now_ns)
    # At most one message is lost in the longest frame that the garbage may have begun.
    for _ in range(12):
        line.now_ns += 20 * MS
        last = line.attitude(0.1, 0.2, 0.3)
    assert len(last) >= 1


@given(
    numbers=st.lists(st.floats(width=32), min_size=3, max_size=3),
    kind=st.sampled_from(["attitude", "highres", "rangefinder", "odometry", "wheels"]),
)
def test_no_number_in_a_message_makes_a_measurement_that_is_not_finite(
    numbers: list[float], kind: str
) -> None:
    line = Line(attitude=1, imu=1, height=1, **{"wheels" if kind == "wheels" else "odometry": 1.0})
    a, b, c = numbers
    usec = line.boot_ms * 1000
    message = {
        "attitude": lambda: mavlink2.MAVLink_attitude_message(line.boot_ms, a, b, c, 0, 0, 0),
        "highres": lambda: mavlink2.MAVLink_highres_imu_message(usec, a, b, c, a, b, c, *[0.0] * 7, 63),
        "rangefinder": lambda: mavlink2.MAVLink_rangefinder_message(a, b),
        "odometry": lambda: mavlink2.MAVLink_odometry_message(
            usec, 20, 12, a, b, 0.0, [1.0, 0.0, 0.0, 0.0], *[0.0] * 6, [c] * 21, [c] * 21
        ),
        "wheels": lambda: mavlink2.MAVLink_wheel_distance_message(usec, 2, [a, b] + [c] * 14),
    }[kind]()
    for measurement in line.say(message, component=197 if kind == "odometry" else 1):
        values = [getattr(measurement, field.name) for field in fields(measurement)]
        assert all(np.isfinite(value).all() for value in values)


@pytest.mark.parametrize("field", range(6))
@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_one_number_that_is_not_finite_spoils_an_inertial_sample_and_no_other(
    field: int, number: float
) -> None:
    line = Line(imu=100)
    sound = [0.5, -0.5, 3e38, 3e38, 3e38, 1.0]  # their sum is finite
    bad = [*sound[:field], number, *sound[field + 1 :]]
    found = [
        line.say(mavlink2.MAVLink_highres_imu_message(line.boot_ms * 1000, *values, *[0.0] * 7, 63))
        for values in (sound, bad, sound)
    ]
    assert [len(each) for each in found] == [1, 0, 1]
