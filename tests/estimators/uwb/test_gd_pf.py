"""Particles on solved positions: calmer than the positions, consistent, beginning anew after silence."""

import numpy as np
from scipy.stats import chi2

from estimators.messages import FloatArray
from estimators.uwb.gd_pf import GdPf
from tests.estimators.uwb.test_frame_solvers import HIGH_AND_LOW, slants
from tests.strategies import range_frame

SECOND_NS = 10**9
NO_ARM = HIGH_AND_LOW


def walk(seed: int, steps: int = 120) -> tuple[GdPf, FloatArray, FloatArray, FloatArray]:
    """A tag pushed about by white acceleration: errors of particles and of positions, covariances."""
    rng = np.random.default_rng(seed)
    pf = GdPf(GdPf.Config(accel_noise=0.5, seed=seed, max_silence=2.0), NO_ARM)
    position, velocity = np.array([4.0, 3.0]), np.zeros(2)
    errors, raw, covs = [], [], []
    for k in range(steps):
        gained = rng.normal(0.0, 0.5 * np.sqrt(0.1), 2) - 0.02 * (position - [4.0, 3.0])
        position = position + 0.1 * (velocity + 0.5 * gained)
        velocity = velocity + gained
        tag = np.array([*position, 0.6])
        noisy = (np.array(slants(NO_ARM, tag)) + rng.normal(0.0, 0.1, 4)).tolist()
        pf.update(range_frame(k * SECOND_NS // 10, [1, 2, 3, 4], noisy))
        assert pf.fix is not None
        assert pf._solver.fix is not None
        errors.append(pf.fix.position[:2] - position)
        raw.append(pf._solver.fix.position[:2] - position)
        covs.append(pf.fix.cov[:2, :2])
    return pf, np.array(errors), np.array(raw), np.array(covs)


def test_particles_err_less_than_the_positions_they_follow_and_say_so() -> None:
    ratios, nees = [], []
    for seed in range(8):
        _, errors, raw, covs = walk(seed)
        ratios.append(np.sqrt((errors**2).sum() / (raw**2).sum()))
        nees.append(np.einsum("ni,nij,nj->n", errors[20:], np.linalg.inv(covs[20:]), errors[20:]).mean())
    assert np.mean(ratios) < 0.8
    # Errors of neighbouring steps are alike: of a walk's NEES some ten are independent.
    law = chi2(2 * 10 * len(nees))
    low, high = law.ppf(1e-3) / (10 * len(nees)), law.ppf(1 - 1e-3) / (10 * len(nees))
    assert low < np.mean(nees) < high


def test_after_long_silence_the_particles_begin_anew_where_the_tag_is() -> None:
    pf, *_ = walk(1)
    counter = pf.pose_at(119 * SECOND_NS // 10)
    pf.update(range_frame(60 * SECOND_NS, [1, 2, 3, 4], slants(NO_ARM, np.array([6.0, 4.0, 0.6]))))
    pose = pf.pose_at(60 * SECOND_NS)
    assert pose is not None
    assert counter is not None
    assert pose.reset_counter == counter.reset_counter + 1
    np.testing.assert_allclose(pose.xy, [6.0, 4.0], atol=0.05)


def test_some_light_particles_survive_with_little_weight() -> None:
    pf, *_ = walk(2)
    weights = pf._weights
    assert weights.sum() == 1.0 or abs(weights.sum() - 1.0) < 1e-12
    assert weights.min() < 0.1 * weights.max()
    assert len(np.unique(pf._positions, axis=0)) > 100


def test_positions_of_ranges_that_disagree_leave_the_particles_less_sure() -> None:
    claims = []
    for excess in (0.0, 0.6):
        pf = GdPf(GdPf.Config(particles=500), NO_ARM)
        tag = np.array([3.0, 2.0, NO_ARM.height + NO_ARM.tag_in_body[2]])
        agreeing = np.array(slants(NO_ARM, tag))
        for k in range(30):
            blocked = agreeing + excess * (k >= 20) * np.array([1.0, 0.0, 0.0, 0.0])
            pf.update(range_frame(k * SECOND_NS // 10, list(NO_ARM.anchors), blocked.tolist()))
        assert pf.fix is not None
        claims.append(float(np.sqrt(np.trace(pf.fix.cov[:2, :2]))))
    # Ten such frames leave the particles less sure than ten that agree.
    assert claims[1] > 1.5 * claims[0]


def test_disagreement_stays_with_the_particles_when_a_frame_agrees_by_chance() -> None:
    pf, *_ = walk(2, steps=30)
    tag = np.array([4.0, 3.0, 0.6])
    blocked = np.array(slants(NO_ARM, tag)) + np.array([0.8, 0.0, 0.0, 0.0])
    common = []
    for k in range(30, 80):
        measured = blocked if k < 40 else np.array(slants(NO_ARM, tag))
        pf.update(range_frame(k * SECOND_NS // 10, [1, 2, 3, 4], measured.tolist()))
        assert pf.fix is not None
        common.append(pf.fix.common_sigma)
    # It grows by the filter's gain, is still there a tenth of a second later, and gone after some seconds.
    assert 0.0 < common[0] < common[9]
    assert common[10] > 0.9 * common[9]
    assert common[-1] < 0.2 * common[9]
