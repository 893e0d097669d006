"""Anchors that contradict the others: left out, tried, believed again."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimators.anchor_trust import AnchorTrust
from estimators.kernels.anchor_trust import ALLOWED, FADES, PROBATION, note

SIGMA = 0.1
STEP_NS = 40_000_000
VARIANCE = SIGMA**2 + 0.01**2


def left_out_by(trust: AnchorTrust, stamp_ns: int, residuals: dict[int, float]) -> set[int]:
    """Anchors that are not believed when their ranges err by so much."""
    return {i for i, each in residuals.items() if not note(*trust.state, i, stamp_ns, each, VARIANCE, SIGMA)}


def hear(
    trust: AnchorTrust,
    begin: float,
    end: float,
    means: dict[int, float],
    noise: float = SIGMA,
    odometry: bool = True,
    seed: int = 7,
) -> list[set[int]]:
    """Anchors heard at 25 Hz whose residuals err by so much; who was left out after each frame."""
    rng = np.random.default_rng(seed)
    left_out = []
    for stamp_ns in range(round(begin * 1e9), round(end * 1e9), STEP_NS):
        if odometry:
            trust.note_odometry(stamp_ns)
        residuals = {i: mean + noise * rng.standard_normal() for i, mean in means.items()}
        left_out.append(left_out_by(trust, stamp_ns, residuals))
    return left_out


def agreeing(**other: float) -> dict[int, float]:
    return {0: 0.0, 1: 0.0, 2: 0.0, 3: 0.0} | {int(name[1:]): mean for name, mean in other.items()}


@pytest.mark.parametrize("shift", [-0.5, -0.15, 0.15, 0.5])
def test_an_anchor_that_errs_on_average_is_left_out_within_two_seconds_and_no_other(shift: float) -> None:
    trust = AnchorTrust(4)
    hear(trust, 0.0, 15.0, agreeing())
    left_out = hear(trust, 15.0, 17.0, agreeing(a2=shift))
    assert left_out[-1] == {2}
    assert set().union(*left_out) == {2}


def test_noise_alone_leaves_out_no_anchor_in_ten_minutes() -> None:
    assert not any(hear(AnchorTrust(4), 0.0, 600.0, agreeing()))


def test_single_outliers_leave_out_no_anchor() -> None:
    trust = AnchorTrust(4)
    hear(trust, 0.0, 15.0, agreeing())
    rng = np.random.default_rng(3)
    for stamp_ns in range(15 * 10**9, 215 * 10**9, STEP_NS):
        trust.note_odometry(stamp_ns)
        spikes = np.where(rng.random(4) < 0.05, -3.0, 0.0) + SIGMA * rng.standard_normal(4)
        assert not left_out_by(trust, stamp_ns, dict(enumerate(spikes)))


@pytest.mark.parametrize("agree_for", [0.0, 15.0])
def test_what_all_anchors_err_by_alike_is_no_anchors_fault(agree_for: float) -> None:
    trust = AnchorTrust(4)
    hear(trust, 0.0, agree_for, agreeing())
    assert not any(hear(trust, agree_for, 45.0, dict.fromkeys(range(4), 0.3)))


def test_without_odometry_every_anchor_is_believed() -> None:
    trust = AnchorTrust(4)
    hear(trust, 0.0, 15.0, agreeing())
    assert not any(hear(trust, 18.0, 28.0, agreeing(a1=0.5), odometry=False))


def test_an_anchor_alone_is_not_to_blame() -> None:
    trust = AnchorTrust(4)
    hear(trust, 0.0, 15.0, agreeing())
    assert not any(hear(trust, 18.0, 28.0, {1: -0.5}))


def test_a_pose_that_was_wrong_from_the_start_is_no_anchors_fault() -> None:
    assert not any(hear(AnchorTrust(4), 0.0, 30.0, agreeing(a2=0.5)))


def test_with_three_anchors_none_is_left_out() -> None:
    trust = AnchorTrust(3)
    hear(trust, 0.0, 15.0, dict.fromkeys(range(3), 0.0))
    assert not any(hear(trust, 15.0, 25.0, {0: 0.0, 1: 0.0, 2: -0.5}))


def test_an_anchor_that_agrees_again_is_believed_after_its_probation_which_doubles() -> None:
    trust, now = AnchorTrust(4), 15.0
    hear(trust, 0.0, now, agreeing())
    for probation in (PROBATION, 2.0 * PROBATION):
        assert hear(trust, now, now + 3.0, agreeing(a1=0.3))[-1] == {1}
        now += 3.0
        still = hear(trust, now, now + 0.9 * probation, agreeing(), noise=0.02)
        assert still[-1] == {1}
        now += 0.9 * probation
        assert hear(trust, now, now + 0.1 * probation + 5.0, agreeing(), noise=0.02)[-1] == set()
        now += 0.1 * probation + 5.0


def test_noise_casts_hardly_any_doubt_on_the_pose() -> None:
    trust, doubts = AnchorTrust(4), []
    for second in range(600):
        hear(trust, second, second + 1.0, agreeing(), seed=second)
        doubts.append(trust.doubt((second + 1) * 10**9))
    assert np.median(doubts) < 0.05 * SIGMA
    assert max(doubts) < 0.3 * SIGMA


@pytest.mark.parametrize("shift", [-0.2, 0.2])
def test_an_anchor_that_contradicts_casts_doubt_on_the_pose_which_outlasts_it(shift: float) -> None:
    trust = AnchorTrust(4)
    hear(trust, 0.0, 15.0, agreeing())
    hear(trust, 15.0, 18.0, agreeing(a2=shift))
    doubt = trust.doubt(18 * 10**9)
    assert 0.5 * abs(shift) < doubt < 1.5 * abs(shift)
    # Whether it agrees since the pose has followed it, or is not heard at all, the pose owes it as much.
    for means in (agreeing(), {}):
        later = AnchorTrust(4)
        for mine, theirs in zip(later.state, trust.state, strict=True):
            mine[:] = theirs
        hear(later, 18.0, 28.0, means)
        assert later.doubt(28 * 10**9) == pytest.approx(doubt * np.exp(-10.0 / FADES), rel=0.3)


def test_a_reset_believes_every_anchor() -> None:
    trust = AnchorTrust(4)
    hear(trust, 0.0, 15.0, agreeing())
    assert hear(trust, 15.0, 18.0, agreeing(a0=0.5))[-1] == {0}
    trust.reset()
    assert trust.doubt(18 * 10**9) == 0.0
    assert not any(hear(trust, 18.0, 21.0, agreeing(a0=0.5)))


@settings(deadline=None, max_examples=40)
@given(st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=8))
def test_never_more_are_left_out_than_a_majority_can_tell(means: list[float]) -> None:
    trust = AnchorTrust(len(means))
    hear(trust, 0.0, 13.0, dict.fromkeys(range(len(means)), 0.0))
    left_out = hear(trust, 13.0, 18.0, dict(enumerate(means)))
    assert max(len(each) for each in left_out) <= (len(means) - 2) // 2


def test_less_than_is_allowed_leaves_out_no_anchor() -> None:
    assert not any(hear(AnchorTrust(4), 0.0, 30.0, agreeing(a3=0.9 * ALLOWED * SIGMA), noise=0.0))
