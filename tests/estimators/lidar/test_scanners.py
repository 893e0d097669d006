"""Scanners of many kinds from settings alone: field of view, rate and range."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from companion.sim.world import World
from estimators.geometry import compose, wrap_angle
from estimators.lidar.expectation import clamped_bar
from estimators.lidar.scan_matching import ScanMatcher
from estimators.messages import FloatArray, Scan
from tests.estimators.lidar.room_scans import Loop, true_increment


@dataclass(frozen=True)
class Scanner:
    beams: int
    field_of_view: float
    rate: float
    reach: float
    sigma: float
    scale: float = 1.0
    """Of the world: 1 is a room of 6 m x 4.5 m."""
    turn: float = 0.0
    """How long a turn of the beam takes [s], where it waits for the next."""


RPLIDAR = Scanner(800, 2 * np.pi, 10.0, 12.0, 0.015)
RPLIDAR_SHORT = Scanner(400, 2 * np.pi, 8.0, 4.0, 0.015)
SICK_180 = Scanner(361, np.pi, 12.0, 30.0, 0.015)
SICK_270 = Scanner(811, 1.5 * np.pi, 15.0, 25.0, 0.015)
FAR = Scanner(1440, 2 * np.pi, 10.0, 80.0, 0.02, scale=15.0)
SLOW = Scanner(800, 2 * np.pi, 3.0, 12.0, 0.015)
SLOWEST = Scanner(800, 2 * np.pi, 1.0, 12.0, 0.015)
RARE = Scanner(361, np.pi, 1.0, 30.0, 0.015, turn=0.025)


def world(scale: float) -> World:
    corners = scale * np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 4.5], [0.0, 4.5], [0.0, 0.0]])
    box = (*(scale * np.array([4.6, 3.1, 0.8, 0.6])), 0.2, 2.0)
    other = (*(scale * np.array([0.7, 3.6, 0.6, 0.4])), 0.5, 2.0)
    return World([[(float(x), float(y)) for x, y in corners]], [box, other])


def scan_by(scanner: Scanner, here: World, path: Loop, start: float, rng: np.random.Generator) -> Scan:
    """Beams from left to right, as an RPLIDAR turns."""
    share = np.arange(scanner.beams) / scanner.beams
    angles = scanner.field_of_view * (0.5 - share)
    times = share * scanner.field_of_view / (2.0 * np.pi) * (scanner.turn or 1.0 / scanner.rate)
    poses = path.poses(start + times)
    # The path stays as it is while the room grows: round the middle of the lower left quarter.
    origins = poses[:, :2] + (scanner.scale - 1.0) * np.array([2.6, 1.9])
    ranges = here.ray_cast(origins, poses[:, 2] + angles, 0.4)
    ranges = ranges + rng.normal(0.0, scanner.sigma, scanner.beams)
    ranges = np.where((ranges < scanner.reach) & (ranges > 0.05), ranges, 0.0)
    return Scan(round(start * 1e9), angles, ranges, times, np.zeros(scanner.beams))


def followed(
    scanner: Scanner, speed: float, settings: dict[str, float]
) -> tuple[ScanMatcher, FloatArray, float]:
    """The matcher after ten seconds, or twenty scans; drift (3,) by then; mean NEES of its increments."""
    here, path, rng = world(scanner.scale), Loop(speed), np.random.default_rng(1)
    matcher = ScanMatcher(ScanMatcher.Config.model_validate(settings), np.zeros(3))
    pose, keyframe, nees = np.zeros(3), np.zeros(3), []
    first_ns = last_ns = 0
    for k in range(max(20, round(10.0 * scanner.rate))):
        found = matcher.update(scan_by(scanner, here, path, k / scanner.rate, rng))
        assert found is not None
        if found.from_stamp_ns == found.stamp_ns:
            first_ns = found.stamp_ns
            continue
        pose, last_ns = compose(keyframe, found.increment), found.stamp_ns
        if found.is_keyframe:
            keyframe = pose
        error = found.increment - true_increment(path, found.from_stamp_ns, found.stamp_ns)
        error[2] = wrap_angle(error[2])
        nees.append(error @ np.linalg.solve(found.cov, error))
    drift = pose - true_increment(path, first_ns, last_ns)
    drift[2] = wrap_angle(drift[2])
    return matcher, drift, float(np.mean(nees))


@pytest.mark.parametrize(
    ("scanner", "speed", "settings"),
    [
        (RPLIDAR_SHORT, 0.5, {}),
        (SICK_180, 0.5, {}),
        (SICK_270, 0.5, {}),
        (FAR, 0.5, {"keyframe_distance": 2.0, "range_sigma": 0.02}),
        (SLOW, 0.25, {"accel_noise": 0.2, "yaw_accel_noise": 0.3, "bandwidth": 0.5}),
        (SLOWEST, 0.1, {"accel_noise": 0.2, "yaw_accel_noise": 0.3, "bandwidth": 0.5}),
        (RARE, 0.5, {}),
    ],
    ids=["4 m", "180 deg", "270 deg", "80 m", "3 Hz", "1 Hz", "1 Hz of a fast one"],
)
def test_a_scanner_is_followed(scanner: Scanner, speed: float, settings: dict[str, float]) -> None:
    matcher, drift, nees = followed(scanner, speed, settings)
    assert matcher.refused == 0
    assert np.hypot(drift[0], drift[1]) < 0.05
    assert abs(np.rad2deg(drift[2])) < 1.5
    # Errors of consecutive increments are correlated: their mean is not chi-square, so a factor is asked.
    assert 3.0 / 4.0 < nees < 3.0 * 2.5


def test_a_scanner_that_is_too_slow_for_the_motion_says_how_far_it_may_be_off() -> None:
    # What the robot does within half a second is not a cubic; taken for one, this is 8.
    _, _, nees = followed(Scanner(800, 2 * np.pi, 2.0, 12.0, 0.015), 0.25, {})
    assert nees < 3.0


def test_modes_of_a_clamped_bar_have_the_variance_of_motion_between_known_ends() -> None:
    # Covariance of the Gaussian process between two known poses and velocities: (s (1 - s))**3 / 3.
    shares = np.linspace(0.0, 1.0, 41)
    variance = (clamped_bar(shares) ** 2).sum(axis=1)
    np.testing.assert_allclose(variance, (shares * (1.0 - shares)) ** 3 / 3.0, atol=0.03 / 192.0)


def test_a_screen_that_moves_along_does_not_hold_the_robot() -> None:
    # A third of the beams end on a thing 0.3 m before the scanner: there it never moves.
    here, path, rng = world(1.0), Loop(0.5), np.random.default_rng(1)
    matcher = ScanMatcher(ScanMatcher.Config(), np.zeros(3))
    pose, keyframe = np.zeros(3), np.zeros(3)
    first_ns = last_ns = 0
    for k in range(100):
        scan = scan_by(RPLIDAR, here, path, k / RPLIDAR.rate, rng)
        if k >= 20:
            scan = replace(scan, ranges=np.where(np.abs(scan.angles) < np.pi / 3, 0.3, scan.ranges))
        found = matcher.update(scan)
        assert found is not None
        first_ns = first_ns or found.stamp_ns
        pose, last_ns = compose(keyframe, found.increment), found.stamp_ns
        keyframe = pose if found.is_keyframe else keyframe
    drift = pose - true_increment(path, first_ns, last_ns)
    assert matcher.refused == 0
    assert np.hypot(drift[0], drift[1]) < 0.1
