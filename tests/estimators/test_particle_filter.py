"""The particle filter: weights, consistency, determinism, and what bad data do to it."""

import numpy as np
import pytest
from hypothesis import given, settings
from scipy.stats import chi2

from estimators.base import Verdict
from estimators.ekf import Ekf
from estimators.messages import FloatArray, LandmarkFrame, Measurement, PoseIncrement
from estimators.particle_filter import ParticleFilter
from tests.estimators.matched_world import HALL, STEP_NS, matched_config, pose_error, true_ranges
from tests.estimators.particle_runs import (
    MARKED_HALL,
    errors_and_nees,
    matched_filter,
    matched_run,
    seen_landmarks,
)
from tests.strategies import hostile_streams, range_frame

SECOND_NS = 10**9
SECOND = np.array([0.0, 1.0, 0.0, 0.0])
TIGHT = np.diag([1e-6, 1e-6, 1e-7])
PARTICLE_FILTERS = pytest.mark.parametrize("name", ["pf", "pf_ibas", "pf_ibas_printed"])


def nees_bounds(runs: int) -> tuple[float, float]:
    """Two-sided 99 % bounds on a mean NEES of planar poses over independent runs."""
    law = chi2(3 * runs)
    return float(law.ppf(0.005)) / runs, float(law.ppf(0.995)) / runs


def standing(**values: object) -> ParticleFilter:
    """Filter that founded a keyframe at 0 and saw a second of exact measurements at the start pose."""
    pf = ParticleFilter(ParticleFilter.Config.model_validate(values), MARKED_HALL)
    for k in range(11):
        stamp_ns = k * SECOND_NS // 10
        pf.update(true_ranges(stamp_ns, HALL.start.pose, HALL))
        pf.update(PoseIncrement(0, stamp_ns, np.zeros(3), TIGHT, is_keyframe=k == 0))
    return pf


@PARTICLE_FILTERS
@settings(deadline=None, max_examples=30)
@given(stream=hostile_streams())
def test_weights_sum_to_one_and_particles_are_numbers_whatever_comes(
    name: str, stream: list[Measurement]
) -> None:
    cloud = matched_filter(name, particles=40)
    assert hasattr(cloud, "particles")
    for measurement in stream:
        cloud.update(measurement)
        particles, weights = cloud.particles
        assert np.isfinite(particles).all()
        assert (weights >= 0.0).all()
        assert weights.sum() == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("landmarks", [False, True])
def test_with_enough_particles_nees_is_within_both_bounds(landmarks: bool) -> None:
    runs = 30
    pf = matched_filter("pf", particles=1000)
    nees = []
    for seed in range(runs):
        pf.reset()
        nees.append(errors_and_nees(pf, seed, 2.0, landmarks)[:, 1])
    low, high = nees_bounds(runs)
    by_half_second = np.mean(nees, axis=0)
    assert (low < by_half_second).all(), by_half_second
    assert (by_half_second < high).all(), by_half_second


def test_with_enough_particles_it_errs_little_more_than_the_ekf() -> None:
    runs, pf = 15, matched_filter("pf", particles=1000)
    squares: dict[str, list[float]] = {"pf": [], "ekf": []}
    for seed in range(runs):
        pf.reset()
        for name, estimator in (("pf", pf), ("ekf", Ekf(matched_config(), HALL))):
            squares[name] += errors_and_nees(estimator, seed, 2.0, landmarks=False)[:, 0].tolist()
    rmse = {name: float(np.sqrt(np.mean(values))) for name, values in squares.items()}
    assert rmse["pf"] < 1.25 * rmse["ekf"]


@PARTICLE_FILTERS
def test_the_same_seed_gives_the_same_poses_byte_for_byte_and_another_seed_others(name: str) -> None:
    _, stream = matched_run(0, 1.0, landmarks=True)

    def poses(seed: int) -> bytes:
        cloud = matched_filter(name, seed=seed)
        said = b""
        for measurement in stream:
            cloud.update(measurement)
            pose = cloud.pose_at(measurement.stamp_ns)
            assert pose is not None
            said += pose.T_map_body.tobytes() + pose.cov.tobytes()
        return said

    assert poses(1) == poses(1)
    assert poses(1) != poses(2)


@pytest.mark.parametrize("resampling", ["systematic", "stratified"])
def test_both_ways_of_resampling_follow_the_walk(resampling: str) -> None:
    truth, stream = matched_run(3, 2.0, landmarks=True)
    pf = matched_filter("pf", resampling=resampling)
    for measurement in stream:
        pf.update(measurement)
    pose = pf.pose_at((len(truth) - 1) * STEP_NS)
    assert pose is not None
    error = pose_error(np.array([*pose.xy, pose.yaw]), truth[-1])
    assert (np.abs(error) < 5.0 * np.sqrt(np.diag(pose.planar_cov))).all()
    assert np.hypot(error[0], error[1]) < 0.1


def test_ten_seconds_without_a_believed_range_leave_a_growing_covariance() -> None:
    pf = standing()
    sigmas: list[FloatArray] = []
    exact = true_ranges(0, HALL.start.pose, HALL)
    for k in range(101):
        stamp_ns = SECOND_NS + k * SECOND_NS // 10
        wrong = range_frame(stamp_ns, exact.anchor_ids.tolist(), (exact.ranges + 500.0).tolist())
        assert pf.update(wrong).verdicts == (Verdict.TOO_LONG,) * 4
        if k % 20 == 0:
            pose = pf.pose_at(stamp_ns)
            assert pose is not None
            assert np.isfinite(pose.cov).all()
            sigmas.append(np.sqrt(np.diag(pose.planar_cov)))
    assert (np.diff(sigmas, axis=0)[:, :2] > 0.0).all()
    # By then any heading is as likely as any other: sigma is half a turn over the root of 3.
    assert sigmas[0][2] < 0.1
    assert sigmas[-1][2] == pytest.approx(np.pi / np.sqrt(3.0), rel=0.1)


def test_a_blocked_range_among_good_ones_is_rejected_and_then_its_anchor_suspect() -> None:
    pf = standing()
    exact = true_ranges(SECOND_NS + 1, HALL.start.pose, HALL)
    blocked = range_frame(SECOND_NS + 1, exact.anchor_ids.tolist(), (exact.ranges + 1.5 * SECOND).tolist())
    good = Verdict.ACCEPTED
    report = pf.update(blocked)
    assert report.verdicts == (good, Verdict.TOO_LONG, good, good)
    assert report.residuals[1] == pytest.approx(1.5, abs=0.1)
    again = pf.update(true_ranges(SECOND_NS + 2, HALL.start.pose, HALL))
    assert again.verdicts == (good, Verdict.SUSPECT, good, good)


def test_one_wrong_landmark_does_not_spoil_the_others() -> None:
    rng = np.random.default_rng(0)
    frame = seen_landmarks(SECOND_NS, HALL.start.pose, rng)
    spoiled = LandmarkFrame(
        SECOND_NS, frame.landmark_ids, frame.ranges + 2.0 * SECOND, frame.bearings, 0.03, 0.012
    )
    alone = LandmarkFrame(
        SECOND_NS,
        frame.landmark_ids[[0, 2, 3]],
        frame.ranges[[0, 2, 3]],
        frame.bearings[[0, 2, 3]],
        0.03,
        0.012,
    )
    one, other = standing(), standing()
    assert one.update(spoiled).verdicts == other.update(alone).verdicts == (Verdict.ACCEPTED,)
    a, b = one.pose_at(SECOND_NS), other.pose_at(SECOND_NS)
    assert a is not None
    assert b is not None
    np.testing.assert_allclose(a.T_map_body, b.T_map_body, atol=1e-9)


def test_late_measurements_change_nothing() -> None:
    pf = matched_filter("pf")
    _, stream = matched_run(0, 1.0, landmarks=True)
    for measurement in stream:
        pf.update(measurement)
    before = pf.pose_at(SECOND_NS)
    rng = np.random.default_rng(0)
    late: list[Measurement] = [
        true_ranges(SECOND_NS // 2, HALL.start.pose, HALL),
        seen_landmarks(SECOND_NS // 2, HALL.start.pose, rng),
        PoseIncrement(0, SECOND_NS // 2, np.ones(3), TIGHT, is_keyframe=True),
    ]
    for measurement in late:
        assert set(pf.update(measurement).verdicts) == {Verdict.LATE}
    after = pf.pose_at(SECOND_NS)
    assert before is not None
    assert after is not None
    assert before.T_map_body.tobytes() == after.T_map_body.tobytes()


def test_each_range_of_a_frame_is_judged_with_what_those_before_it_said() -> None:
    pf = ParticleFilter(ParticleFilter.Config(particles=500, nlos=()), HALL)
    particles, _ = pf.particles
    frame = true_ranges(0, HALL.start.pose + np.array([0.1, -0.1, 0.0]), HALL)
    x, y, yaw = particles[:, :3].T
    arm_x, arm_y, _ = HALL.tag_in_body
    c, s = np.cos(yaw), np.sin(yaw)
    tags = np.column_stack([x + c * arm_x - s * arm_y, y + s * arm_x + c * arm_y])
    anchors = np.array(list(HALL.anchors.values()))
    heights = np.array([HALL.height_to(anchor) for anchor in anchors])
    measured = np.sqrt(frame.ranges**2 - heights**2)
    sigmas = ParticleFilter.Config().range_sigma * frame.ranges / measured
    misses = measured - np.linalg.norm(tags[:, None] - anchors[:, :2], axis=2)
    # Whitened by the Cholesky factor of their covariance, each is conditioned on those before it.
    root = np.linalg.cholesky(np.cov(misses.T, bias=True) + np.diag(sigmas**2))
    white = np.linalg.solve(root, misses.mean(axis=0))
    report = pf.update(frame)
    assert set(report.verdicts) == {Verdict.ACCEPTED}
    np.testing.assert_allclose(report.nis, white**2, rtol=1e-6)
    np.testing.assert_allclose(report.residuals, white * np.diag(root), rtol=1e-6)
