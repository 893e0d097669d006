"""UWB with an inertial sensor: what the sensor adds, what the adaptive gain takes off, what stays unknown."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from estimators.base import Setup, Start, Verdict
from estimators.geometry import rotation, wrap_angle
from estimators.messages import (
    Attitude,
    FloatArray,
    ImuSample,
    Measurement,
    PoseEstimate,
    RangeFrame,
    measurement_stamp_ns,
)
from estimators.models.inertial import GRAVITY
from estimators.uwb.uwb_imu_adaptive_ekf import UwbImuAdaptiveEkf
from estimators.uwb.uwb_imu_ekf import UwbImuEkf
from tests.strategies import SETUP, range_frame

SECOND_NS = 10**9
ARM = np.array([0.12, -0.05])
START = Start(np.array([4.0, 1.8, 0.3]), np.array([0.05, 0.05, 0.03]))
ROOM = replace(SETUP, start=START)
NO_BURST: tuple[float, float] = (-1.0, -1.0)


class Circle:
    """A robot on a circle, its tag before and beside its origin: truth and measurements."""

    def __init__(
        self, seed: int, accel_sigma: float = 0.05, bias: float = 0.05, range_sigma: float = 0.1
    ) -> None:
        self.rng = np.random.default_rng(seed)
        self.accel_sigma, self.range_sigma = accel_sigma, range_sigma
        self.bias = bias * self.rng.standard_normal(3)
        self.yaw_error = START.sigma[2] * self.rng.standard_normal()
        self.rate = 0.5
        yaw = START.pose[2] + self.yaw_error
        self.centre = START.pose[:2] + START.sigma[:2] * self.rng.standard_normal(2)
        self.centre += np.array([-np.sin(yaw), np.cos(yaw)])

    def body(self, t: float) -> FloatArray:
        """True pose: a circle of 1 m, the heading along it."""
        yaw = START.pose[2] + self.yaw_error + self.rate * t
        return np.array([*(self.centre + np.array([np.sin(yaw), -np.cos(yaw)])), wrap_angle(yaw)])

    def tag(self, t: float) -> FloatArray:
        pose = self.body(t)
        position: FloatArray = pose[:2] + rotation(pose[2]) @ ARM
        return position

    def stream(
        self, duration: float, burst: tuple[float, float] = NO_BURST, imu: bool = True
    ) -> list[Measurement]:
        """Ranges at 10 Hz, inertial samples at 20 Hz; during the burst one range is 2 m too long."""
        found: list[Measurement] = []
        for k in range(round(duration * 20)):
            t, stamp_ns = k / 20, k * SECOND_NS // 20
            yaw = self.body(t)[2]
            if imu:
                h = 1e-3
                accel = (self.tag(t + h) - 2 * self.tag(t) + self.tag(t - h)) / h**2
                force = np.array([*(rotation(yaw).T @ accel), GRAVITY]) + self.bias
                force += self.accel_sigma * self.rng.standard_normal(3)
                heading = yaw - self.yaw_error - START.pose[2] + 1.0  # it counts from anywhere
                quat = Rotation.from_euler("z", heading).as_quat(scalar_first=True)
                found += [Attitude(stamp_ns, quat), ImuSample(stamp_ns, np.array([0, 0, self.rate]), force)]
            if k % 2 == 0:
                tag = np.array([*self.tag(t), ROOM.height + ROOM.tag_in_body[2]])
                slants = np.array([np.linalg.norm(a - tag) for a in ROOM.anchors.values()])
                slants += self.range_sigma * self.rng.standard_normal(4)
                slants[0] += 2.0 * (burst[0] <= t < burst[1])
                found.append(range_frame(stamp_ns, list(ROOM.anchors), slants.tolist()))
        return found


def followed(
    estimator: UwbImuEkf, circle: Circle, stream: list[Measurement]
) -> tuple[FloatArray, FloatArray, list[PoseEstimate]]:
    """Errors (N, 3) and covariances (N, 3, 3) after every range frame, and the poses."""
    errors, covs, poses = [], [], []
    for measurement in stream:
        estimator.update(measurement)
        if not isinstance(measurement, RangeFrame):
            continue
        pose = estimator.pose_at(measurement.stamp_ns)
        if pose is not None:
            error = np.array([*pose.xy, pose.yaw]) - circle.body(measurement.stamp_ns * 1e-9)
            error[2] = wrap_angle(error[2])
            errors.append(error)
            covs.append(pose.planar_cov)
            poses.append(pose)
    return np.array(errors), np.array(covs), poses


def jumping(measurement: Measurement, circle: Circle, burst: tuple[float, float]) -> Measurement:
    """The measurement; ranges of the burst are those of a tag 0.7 m beside the true one."""
    t = measurement_stamp_ns(measurement) * 1e-9
    if not isinstance(measurement, RangeFrame) or not burst[0] <= t < burst[1]:
        return measurement
    tag = np.array([*(circle.tag(t) + 0.5), ROOM.height + ROOM.tag_in_body[2]])
    slants = [float(np.linalg.norm(anchor - tag)) for anchor in ROOM.anchors.values()]
    return range_frame(measurement.stamp_ns, list(ROOM.anchors), slants)


def plain(setup: Setup = ROOM, **settings: float | str) -> UwbImuEkf:
    return UwbImuEkf(UwbImuEkf.Config.model_validate(settings), setup)


def adaptive(**settings: float | str) -> UwbImuAdaptiveEkf:
    return UwbImuAdaptiveEkf(UwbImuAdaptiveEkf.Config.model_validate(settings), ROOM)


def rms(errors: FloatArray) -> float:
    return float(np.sqrt((errors[:, :2] ** 2).sum(axis=1).mean()))


def test_exact_measurements_leave_no_error_of_pose_and_heading() -> None:
    circle = Circle(0, accel_sigma=0.0, bias=0.0, range_sigma=0.0)
    errors, *_ = followed(plain(), circle, circle.stream(20.0))
    # It had to find the heading, which the start had wrong by degrees.
    assert np.abs(errors[-20:, :2]).max() < 0.01
    assert np.abs(errors[-20:, 2]).max() < np.deg2rad(0.5)
    assert abs(circle.yaw_error) < 3 * START.sigma[2]


def test_the_inertial_sensor_makes_the_position_better_and_heading_known() -> None:
    with_imu: list[float] = []
    without: list[float] = []
    for seed in range(3):
        for imu, into in ((True, with_imu), (False, without)):
            circle = Circle(seed)
            errors, covs, _ = followed(plain(), circle, circle.stream(12.0, imu=imu))
            into.append(rms(errors[len(errors) // 4 :]))
            assert np.isfinite(covs[-1][2, 2]) == imu
    assert np.mean(with_imu) < 0.6 * np.mean(without)


def test_pose_and_heading_are_as_uncertain_as_claimed() -> None:
    nees = []
    for seed in range(10):
        circle = Circle(seed)
        estimator = plain(imu_accel_sigma=0.05, jerk_noise=1.0, heading_walk_deg=0.0, bias_walk=0.0)
        errors, covs, _ = followed(estimator, circle, circle.stream(12.0))
        late = slice(len(errors) // 3, None, 20)
        nees += np.einsum("ni,nij,nj->n", errors[late], np.linalg.inv(covs[late]), errors[late]).tolist()
    # Instants seconds apart still share the heading's error: each walk counts as one sample.
    low, high = chi2.ppf(1e-3, 3 * 10) / 10, chi2.ppf(1 - 1e-3, 3 * 10) / 10
    assert low < np.mean(nees) < high


@pytest.mark.parametrize(("positions", "until"), [("momentum_gd", 6.8), ("momentum_gd", 9.0), ("gd_pf", 9.0)])
def test_bursts_move_the_adaptive_filter_much_less(positions: str, until: float) -> None:
    settings: dict[str, Any] = {"positions": positions, "particles": 300}
    worst: dict[str, list[float]] = {"plain": [], "adaptive": []}
    for seed in range(3):
        for name, estimator in (("plain", plain(**settings)), ("adaptive", adaptive(**settings))):
            circle = Circle(seed)
            errors, *_ = followed(estimator, circle, circle.stream(9.5, burst=(6.0, until)))
            worst[name].append(float(np.hypot(errors[:, 0], errors[:, 1])[50:].max()))
    assert np.mean(worst["adaptive"]) <= 0.6 * np.mean(worst["plain"])


def test_without_bursts_the_adaptive_filter_is_nearly_as_good() -> None:
    squares = []
    for seed in range(6):
        circle = Circle(seed)
        stream = circle.stream(8.0)
        squares.append([rms(followed(each, circle, stream)[0]) ** 2 for each in (plain(), adaptive())])
    unchanged, adapted = np.sqrt(np.mean(squares, axis=0))
    assert adapted < 1.1 * unchanged


@pytest.mark.parametrize(
    ("limit", "burst"), [({"top_speed": 50.0}, (6.0, 6.8)), ({"max_distance": 100.0}, (6.0, 6.05))]
)
def test_either_limit_alone_lessens_the_gain(limit: dict[str, float], burst: tuple[float, float]) -> None:
    # A robot's speed tells of the first position of a burst alone, the distance of all. The ranges agree.
    circle = Circle(1, range_sigma=0.0)
    stream = [jumping(measurement, circle, burst) for measurement in circle.stream(8.0)]
    worst = []
    for limits in ({"top_speed": 50.0, "max_distance": 100.0}, limit):
        errors, *_ = followed(adaptive(**limits), circle, stream)
        worst.append(float(np.hypot(errors[:, 0], errors[:, 1])[50:].max()))
    same, *_ = followed(plain(), circle, stream)
    # Neither limit is left, and without disagreement nothing else lessens the gain.
    assert worst[0] == pytest.approx(float(np.hypot(same[:, 0], same[:, 1])[50:].max()))
    assert worst[1] < 0.8 * worst[0]


def test_ranges_that_disagree_lessen_the_gain_for_as_long_as_something_blocks_them() -> None:
    off = {"top_speed": 50.0, "max_distance": 100.0}
    nees: dict[float, list[float]] = {0.05: [], 2.0: []}
    for seed in range(4):
        for blocked_time, into in nees.items():
            circle = Circle(seed)
            estimator = adaptive(blocked_time=blocked_time, **off)
            errors, covs, _ = followed(estimator, circle, circle.stream(7.0, burst=(4.0, 7.0)))
            blocked = slice(40, 70, 5)
            e, P = errors[blocked, :2], covs[blocked, :2, :2]
            into += np.einsum("ni,nij,nj->n", e, np.linalg.inv(P), e).tolist()
    # Instants of one burst err alike: each walk counts as one sample.
    low, high = chi2.ppf(1e-3, 2 * 4) / 4, chi2.ppf(1 - 1e-3, 2 * 4) / 4
    assert low < np.mean(nees[2.0]) < high
    assert np.mean(nees[0.05]) > 1.5 * np.mean(nees[2.0])


def test_particle_positions_can_be_observed_too() -> None:
    circle = Circle(2)
    errors, *_ = followed(plain(positions="gd_pf", particles=300), circle, circle.stream(8.0))
    assert rms(errors[30:]) < 0.15


def test_an_unknown_start_heading_leaves_the_sensor_unused() -> None:
    lost = replace(ROOM, start=Start(START.pose, np.array([0.05, 0.05, np.pi])))
    circle = Circle(0)
    estimator = plain(lost)
    verdicts = [estimator.update(m).verdicts[0] for m in circle.stream(2.0) if isinstance(m, ImuSample)]
    assert set(verdicts) == {Verdict.NOT_USED}
    _, covs, _ = followed(plain(lost), circle, circle.stream(2.0))
    assert np.isinf(covs[:, 2, 2]).all()


def test_it_begins_at_the_start_and_a_blocked_first_range_hardly_matters() -> None:
    circle = Circle(0)
    first = []
    for start in (START, Start(START.pose, np.array([0.05, 0.05, np.pi]))):
        estimator = UwbImuAdaptiveEkf(UwbImuAdaptiveEkf.Config(), replace(ROOM, start=start))
        errors, *_ = followed(estimator, circle, circle.stream(0.1, burst=(0.0, 1.0)))
        first.append(float(np.hypot(*errors[0, :2])))
    assert first[0] < 0.2 < first[1]


def test_the_start_is_that_of_the_body_not_of_the_tag() -> None:
    level = Attitude(0, np.array([1.0, 0.0, 0.0, 0.0]))
    tag = np.array([*(START.pose[:2] + rotation(START.pose[2]) @ ROOM.tag_in_body[:2]), 0.6])
    estimator = plain()
    estimator.update(level)
    slants = [float(np.linalg.norm(anchor - tag)) for anchor in ROOM.anchors.values()]
    estimator.update(range_frame(0, list(ROOM.anchors), slants))
    pose = estimator.pose_at(0)
    assert pose is not None
    np.testing.assert_allclose([*pose.xy, pose.yaw], START.pose, atol=1e-6)


def test_long_silence_places_it_anew() -> None:
    circle = Circle(0)
    estimator = plain()
    _, _, poses = followed(estimator, circle, circle.stream(3.0))
    tag = np.array([6.0, 4.0, ROOM.height + ROOM.tag_in_body[2]])
    slants = [float(np.linalg.norm(a - tag)) for a in ROOM.anchors.values()]
    estimator.update(range_frame(60 * SECOND_NS, list(ROOM.anchors), slants))
    pose = estimator.pose_at(60 * SECOND_NS)
    assert pose is not None
    assert pose.reset_counter == poses[-1].reset_counter + 1
    np.testing.assert_allclose(pose.xy, [6.0, 4.0], atol=0.01)
    assert np.isinf(pose.planar_cov[2, 2])
