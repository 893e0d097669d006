"""Particle filters with scans held against walls, and with a gyroscope."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from companion.config import load_config
from companion.errors import UserError
from estimators.base import Setup, Verdict
from estimators.geometry import between
from estimators.messages import FloatArray, ImuSample, PoseIncrement, Scan
from estimators.particle_filter import ParticleFilter
from tests.conftest import SITE
from tests.estimators.lidar.room_scans import ROOM, Loop, drawn, scan_while_moving
from tests.strategies import SETUP

WALLS = [*ROOM]
MOUNTING = np.array([0.12, -0.05, 2.2])
LOOP = Loop()
START = LOOP.poses(np.zeros(1))[0]
IN_ROOM = replace(
    SETUP,
    start=replace(SETUP.start, pose=START, sigma=np.array([0.05, 0.05, 0.03])),
    walls=WALLS,
    lidar_in_body=MOUNTING,
)
STEP_SIGMA = np.array([0.02, 0.02, 0.01])
SECONDS = 8
NOW_NS = 10**9


def round_the_room(seed: int, setup: Setup = IN_ROOM, **settings: object) -> tuple[FloatArray, FloatArray]:
    """Errors (K, 3) and NEES (K,) of every second on scans and poor increments; no range at all."""
    pf = ParticleFilter(ParticleFilter.Config.model_validate({"seed": seed, **settings}), setup)
    rng = np.random.default_rng(seed)
    truth = LOOP.poses(np.linspace(0.0, SECONDS, 10 * SECONDS + 1))
    errors, nees = [], []
    pf.update(PoseIncrement(0, 0, np.zeros(3), np.eye(3), is_keyframe=True))
    for k in range(1, len(truth)):
        stamp_ns = k * NOW_NS // 10
        scan = scan_while_moving(ROOM, LOOP, 0.1 * (k - 1), rng, 0.02, MOUNTING)
        assert pf.update(scan).verdicts in {(Verdict.ACCEPTED,), (Verdict.NOT_USED,)}
        step = between(truth[k - 1], truth[k]) + STEP_SIGMA * rng.normal(size=3)
        cov = np.diag(STEP_SIGMA**2)
        pf.update(PoseIncrement((k - 1) * NOW_NS // 10, stamp_ns, step, cov, is_keyframe=True))
        if k % 10 == 0:
            pose = pf.pose_at(stamp_ns)
            assert pose is not None
            error = np.array([*pose.xy, pose.yaw]) - truth[k]
            error[2] = np.angle(np.exp(1j * error[2]))
            errors.append(error)
            nees.append(error @ np.linalg.solve(pose.planar_cov, error))
    return np.array(errors), np.array(nees)


def test_scans_hold_the_pose_where_it_drifts_without_them() -> None:
    runs = range(5)
    held = [round_the_room(seed, scan_likelihood=True) for seed in runs]
    drifting = [round_the_room(seed) for seed in runs]
    held_rmse, drift_rmse = (
        float(np.sqrt(np.mean([(errors[-1, :2] ** 2).sum() for errors, _ in each])))
        for each in (held, drifting)
    )
    assert held_rmse < 0.03
    assert drift_rmse > 4.0 * held_rmse
    nees = float(np.mean([values for _, values in held]))
    assert nees < float(chi2.ppf(0.995, 3 * len(runs))) / len(runs)


def test_a_map_serves_in_place_of_walls() -> None:
    on_map = replace(IN_ROOM, walls=[], floor_map=drawn(ROOM, np.array([1.0, -6.0, 0.7])))
    errors, _ = round_the_room(0, on_map, scan_likelihood=True)
    assert np.hypot(errors[:, 0], errors[:, 1]).max() < 0.06


@pytest.mark.parametrize(
    "ranges", [np.zeros(5), np.full(5, np.nan), np.full(5, -1.0)], ids=["nothing", "nan", "negative"]
)
def test_a_scan_in_which_nothing_came_back_is_impossible_and_moves_nothing(ranges: FloatArray) -> None:
    pf = ParticleFilter(ParticleFilter.Config(scan_likelihood=True), IN_ROOM)
    pf.update(scan_while_moving(ROOM, LOOP, 0.0, None, 0.0, MOUNTING))
    before = pf.particles
    empty = Scan(NOW_NS, np.arange(5.0), ranges, np.zeros(5), np.zeros(5))
    assert pf.update(empty).verdicts == (Verdict.IMPOSSIBLE,)
    for one, other in zip(before, pf.particles, strict=True):
        np.testing.assert_array_equal(one, other)
    assert pf.update(scan_while_moving(ROOM, LOOP, -1.0, None, 0.0, MOUNTING)).verdicts == (Verdict.LATE,)


def test_a_site_without_walls_cannot_have_scans_held_against_them() -> None:
    load_config(SITE, ["estimator.pf.scan_likelihood=true"])
    with pytest.raises(UserError, match=r"pf\.scan_likelihood needs a wall in site\.walls"):
        load_config(SITE, ["estimator.pf.scan_likelihood=true", "site.walls=[]"])


def test_the_mounting_of_the_lidar_and_the_walls_reach_the_estimators() -> None:
    sets = ["body.lidar=[0.1, -0.2]", "body.lidar_yaw_deg=90"]
    setup = load_config(SITE, sets).setup()
    np.testing.assert_allclose(setup.lidar_in_body, [0.1, -0.2, np.pi / 2])
    assert len(setup.walls) > 0


def turning(rate: float, **settings: object) -> ParticleFilter:
    """Filter that was told to be at the start and heard a second of a gyroscope."""
    pf = ParticleFilter(ParticleFilter.Config.model_validate(settings), IN_ROOM)
    pf.start_at(0, START, np.diag([1e-4, 1e-4, 1e-4]))
    for k in range(1, 51):
        pf.update(ImuSample(k * NOW_NS // 50, np.array([5.0, -5.0, rate]), np.zeros(3)))
    return pf


@pytest.mark.parametrize("rate", [-1.5, 0.0, 0.8])
def test_the_gyroscope_turns_the_robot_left_for_positive_rates(rate: float) -> None:
    pf = turning(rate, motion="imu")
    pose = pf.pose_at(NOW_NS)
    assert pose is not None
    turned = np.angle(np.exp(1j * (pose.yaw - START[2])))
    assert turned == pytest.approx(rate, abs=3.0 * np.sqrt(pose.cov[5, 5]))
    assert np.sqrt(pose.cov[5, 5]) < 0.06
    deaf = turning(rate).pose_at(NOW_NS)
    assert deaf is None or deaf.cov[5, 5] > 4.0 * pose.cov[5, 5]


def test_a_gyroscope_is_not_used_unless_asked_for_nor_while_the_robot_stands() -> None:
    sample = ImuSample(NOW_NS, np.zeros(3), np.zeros(3))
    assert ParticleFilter(ParticleFilter.Config(), IN_ROOM).update(sample).verdicts == (Verdict.NOT_USED,)
    still = replace(IN_ROOM, start=replace(IN_ROOM.start, still_for=5.0))
    listening = ParticleFilter(ParticleFilter.Config(motion="imu"), still)
    assert listening.update(sample).verdicts == (Verdict.NOT_USED,)


@pytest.mark.parametrize(
    ("rate", "verdict"),
    [(float("nan"), Verdict.IMPOSSIBLE), (float("inf"), Verdict.IMPOSSIBLE), (60.0, Verdict.GATED)],
)
def test_an_impossible_rate_is_not_taken(rate: float, verdict: Verdict) -> None:
    pf, undisturbed = turning(0.5, motion="imu"), turning(0.5, motion="imu")
    gyro = np.array([0.0, 0.0, rate])
    assert pf.update(ImuSample(NOW_NS, gyro, np.zeros(3))).verdicts == (verdict,)
    assert pf.update(ImuSample(NOW_NS - 1, gyro, np.zeros(3))).verdicts == (Verdict.LATE,)
    one, other = pf.pose_at(NOW_NS), undisturbed.pose_at(NOW_NS)
    assert one is not None
    assert other is not None
    np.testing.assert_allclose(one.T_map_body, other.T_map_body, atol=1e-12)
