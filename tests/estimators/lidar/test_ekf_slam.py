"""EKF-SLAM as a front end: honest increments in rooms, wide ones where nothing tells, and bad scans."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.geometry import compose
from estimators.lidar.ekf_slam import EkfSlam
from estimators.messages import FloatArray, PoseIncrement, Scan
from tests.estimators.lidar.room_scans import (
    BEAMS,
    CORRIDOR,
    OTHER_ROOM,
    PERIOD,
    ROOM,
    Arc,
    Loop,
    scan_while_moving,
    true_increment,
)
from tests.estimators.lidar.test_poor_places import round_hall

DEG = np.pi / 180
RANGE_SIGMA = 0.015


def slam(**settings: float) -> EkfSlam:
    return EkfSlam(EkfSlam.Config.model_validate(settings), np.zeros(3))


def scans_along(walls: FloatArray, path: Arc | Loop, count: int, seed: int) -> list[Scan]:
    rng = np.random.default_rng(seed)
    return [scan_while_moving(walls, path, k * PERIOD, rng, RANGE_SIGMA) for k in range(count)]


def increments_of(odometry: EkfSlam, scans: list[Scan]) -> list[PoseIncrement]:
    found = [odometry.update(scan) for scan in scans]
    return [increment for increment in found if increment is not None]


def errors_of(increments: list[PoseIncrement], path: Arc | Loop) -> tuple[FloatArray, FloatArray]:
    """Errors (N, 3) and covariances (N, 3, 3) of all that have a reference."""
    errors, covs = [], []
    for found in increments:
        if found.from_stamp_ns < found.stamp_ns:
            error = found.increment - true_increment(path, found.from_stamp_ns, found.stamp_ns)
            error[2] = np.angle(np.exp(1j * error[2]))
            errors.append(error)
            covs.append(found.cov)
    return np.array(errors), np.array(covs)


def nees_of(errors: FloatArray, covs: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("ni,ni->n", errors, np.linalg.solve(covs, errors[:, :, None])[:, :, 0]))


@pytest.mark.parametrize("speed", [0.3, 1.0])
def test_increments_in_a_room_are_as_good_as_they_say(speed: float) -> None:
    nees, errors = [], []
    for seed in range(4):
        odometry = slam(stamp_sigma_ms=0.0)
        found = increments_of(odometry, scans_along(ROOM, Loop(speed), 120, seed))
        assert odometry.refused == 0
        error, cov = errors_of(found, Loop(speed))
        # The errors of increments from one keyframe are alike: of each, one is counted.
        last = [i for i, increment in enumerate(found[1:]) if increment.is_keyframe]
        nees += nees_of(error, cov)[last].tolist()
        errors.append(error)
    rms = np.sqrt((np.concatenate(errors) ** 2).mean(axis=0))
    np.testing.assert_array_less(rms, [0.005, 0.005, 0.2 * DEG])
    spread = 3.3 * np.sqrt(2.0 * 3.0 / len(nees))
    # What the scan says without the prediction is a little less than the filter knows.
    assert 3.0 / 2.0 - spread < np.mean(nees) < 3.0 + spread


def test_increments_compose_to_the_true_path() -> None:
    path = Loop(0.7)
    found = increments_of(slam(), scans_along(ROOM, path, 150, 3))
    pose = np.zeros(3)
    for before, increment in zip([found[0], *found], found, strict=False):
        assert increment.is_keyframe or increment.from_stamp_ns < increment.stamp_ns
        assert before.stamp_ns <= increment.stamp_ns
        if increment.is_keyframe:
            pose = compose(pose, increment.increment)
            newest = increment.stamp_ns
    drift = pose - true_increment(path, found[0].stamp_ns, newest)
    assert np.hypot(drift[0], drift[1]) < 0.06
    assert abs(np.angle(np.exp(1j * drift[2]))) < 1.5 * DEG


@pytest.mark.parametrize("heading", [0.0, -0.7])
def test_along_a_corridor_it_knows_that_it_knows_nothing(heading: float) -> None:
    along = np.array([np.cos(heading), -np.sin(heading)])
    path = Arc(np.array([0.0, 0.9, heading]), np.array([*(0.3 * along), 0.0]))
    odometry = slam()
    found = increments_of(odometry, scans_along(CORRIDOR, path, 40, 1))
    assert odometry.refused == 0
    errors, covs = errors_of(found, path)
    for error, cov in zip(errors[2:], covs[2:], strict=True):
        values, vectors = np.linalg.eigh(cov[:2, :2])
        assert np.sqrt(values[1]) > 0.9
        assert abs(vectors[:, 1] @ along) > 0.99
        assert np.sqrt(values[0]) < 0.02
        assert error @ np.linalg.solve(cov, error) < 25.0


@pytest.mark.parametrize("seed", [1, 2])
def test_a_round_hall_has_no_walls_to_go_by(seed: int) -> None:
    path = Arc(np.zeros(3), np.array([0.3, 0.0, 0.2]))
    found = increments_of(slam(), scans_along(round_hall(5.0), path, 25, seed))
    assert all(increment.from_stamp_ns == increment.stamp_ns for increment in found)


def test_another_room_is_not_taken_for_this_one() -> None:
    odometry = slam()
    here, elsewhere = Arc(np.array([2.2, 1.6, 0.3]), np.zeros(3)), Arc(np.array([0.5, 1.0, 0.2]), np.zeros(3))
    for k in range(3):
        odometry.update(scan_while_moving(ROOM, here, k * PERIOD))
    lost = odometry.update(scan_while_moving(OTHER_ROOM, elsewhere, 3 * PERIOD))
    assert odometry.refused == 1
    assert lost is not None
    assert lost.from_stamp_ns == lost.stamp_ns
    again = odometry.update(scan_while_moving(OTHER_ROOM, elsewhere, 4 * PERIOD))
    assert again is not None
    assert again.from_stamp_ns == lost.stamp_ns
    assert odometry.refused == 1


def test_after_a_long_gap_it_begins_anew() -> None:
    path = Arc(np.array([2.2, 1.6, 0.3]), np.zeros(3))
    odometry = slam()
    for k in range(3):
        odometry.update(scan_while_moving(ROOM, path, k * PERIOD))
    after = odometry.update(scan_while_moving(ROOM, path, 20.0))
    assert after is not None
    assert after.from_stamp_ns == after.stamp_ns


@pytest.mark.parametrize("bad", [0.0, float("nan"), float("inf"), -1.0])
def test_scans_without_returns_and_late_ones_give_nothing_and_change_nothing(bad: float) -> None:
    scans = scans_along(ROOM, Loop(), 6, 2)
    plain, disturbed = slam(), slam()
    expected = increments_of(plain, scans)
    found = increments_of(disturbed, scans[:3])
    empty = np.zeros(0)
    assert disturbed.update(replace(scans[3], ranges=np.full(BEAMS, bad))) is None
    assert disturbed.update(scans[1]) is None
    assert disturbed.update(Scan(scans[3].stamp_ns, empty, empty, empty, empty)) is None
    found += increments_of(disturbed, scans[3:])
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a.increment, b.increment)
        np.testing.assert_array_equal(a.cov, b.cov)


def test_noise_for_scans_never_raises_and_leaves_no_nan() -> None:
    rng = np.random.default_rng(7)
    odometry = slam()
    for k in range(60):
        scan = scan_while_moving(ROOM, Loop(), k * PERIOD)
        kind = k % 4
        ranges = np.where(rng.random(BEAMS) < 0.3 * kind, rng.uniform(0.0, 9.0, BEAMS), scan.ranges)
        found = odometry.update(replace(scan, ranges=ranges))
        if found is not None:
            assert np.isfinite(found.increment).all()
            assert found.from_stamp_ns == found.stamp_ns or np.linalg.eigvalsh(found.cov)[0] > 0.0


def test_the_map_stays_small_and_positive() -> None:
    odometry = slam(max_features=6)
    for scan in scans_along(ROOM, Loop(), 100, 4):
        odometry.update(scan)
        assert odometry.map is not None
        assert len(odometry.map.kinds) <= 6
        assert np.linalg.eigvalsh(odometry.map.cov)[0] > -1e-9
    assert odometry.refused == 0


def test_the_points_are_deskewed_and_lie_on_the_walls() -> None:
    path = Arc(np.array([2.0, 1.2, 0.0]), np.array([0.5, 0.0, 0.8]))
    odometry = slam()
    for k in range(8):
        odometry.update(scan_while_moving(ROOM, path, k * PERIOD))
    end = path.poses(np.array([7 * PERIOD + PERIOD * (BEAMS - 1) / BEAMS]))[0]
    c, s = np.cos(end[2]), np.sin(end[2])
    x, y = (odometry.points @ np.array([[c, s], [-s, c]]) + end[:2]).T
    outer = np.min([np.abs(x), np.abs(x - 6.0), np.abs(y), np.abs(y - 4.5)], axis=0)
    inner = np.min([np.abs(x - 4.2), np.abs(x - 5.0), np.abs(y - 2.8), np.abs(y - 3.4)], axis=0)
    assert np.percentile(np.minimum(outer, inner), 95) < 0.01
    assert (np.linalg.eigvalsh(odometry.points_cov) > 0.0).all()
