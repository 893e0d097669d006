"""The range gate: which ranges it lets pass, why it rejects the others, and what filters make of it."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimators import estimator_config_class, make_estimator
from estimators.base import Setup, Start, Verdict
from estimators.messages import FloatArray, PoseIncrement, RangeFrame
from estimators.models.range import reduce_height
from estimators.nlos.visibility import OBSTRUCTED, Visibility
from estimators.range_gate import NlosMethod, RangeGate
from tests.estimators.matched_world import HALL, true_ranges
from tests.strategies import range_frame

SIGMA = 0.1
STEP_NS = 40_000_000
POSE = HALL.start.pose
SURE = replace(HALL, start=Start(POSE, np.array([0.02, 0.02, 0.01]), still_for=60.0))
CLEAR, WEAK, NO_POWER = 3.0, 11.0, np.nan
"""Power of everything received above that of the first path [dB]."""
EXPECTED_SIGMA = 0.11
"""Of a residual: the range's and the prediction's [m]."""
COLUMNS = ("anchor_ids", "ranges", "rx_power", "fp_power")


def gate(*methods: NlosMethod) -> RangeGate:
    return RangeGate(RangeGate.Config(range_sigma=SIGMA, nlos=methods), HALL)


def frame_at(k: int, excess: FloatArray, difference: float | FloatArray = NO_POWER) -> RangeFrame:
    """Ranges of a robot that stands at the start, too long by `excess` (4,)."""
    frame = true_ranges(k * STEP_NS, POSE, HALL)
    rx = np.full(4, -80.0)
    return replace(frame, ranges=frame.ranges + excess, rx_power=rx, fp_power=rx - difference)


def judged(of: RangeGate, k: int, residual: float, difference: float = NO_POWER) -> Verdict:
    """Verdict on the first range of a frame."""
    return judged_alone(of, first_of(frame_at(k, np.zeros(4), difference)), residual)[0]


def first_of(frame: RangeFrame) -> RangeFrame:
    """Only the first range."""
    return replace(frame, **{name: getattr(frame, name)[:1] for name in COLUMNS})


def judged_alone(
    of: RangeGate, frame: RangeFrame, residual: float, variance: float | None = None
) -> tuple[Verdict, float]:
    """Verdict on the only range of a frame, and the factor of its sigma.

    `variance` is that of the prediction; without it, the residual is expected with `EXPECTED_SIGMA`.
    """
    candidates = of.horizontal.of(frame, POSE, 0.0)
    sigma = float(candidates.rows[0, 3])
    spread = EXPECTED_SIGMA**2 - sigma**2 if variance is None else variance
    report = of.judge_together(candidates, np.array([residual]), np.array([[spread]]))
    return report.verdicts[0], float(candidates.rows[0, 3] / sigma)


def obstruct(monkeypatch: pytest.MonkeyPatch) -> None:
    """The LiDAR sees an obstacle on every line."""
    monkeypatch.setattr(Visibility, "log_ratio", lambda *_: OBSTRUCTED)


def test_without_methods_the_nis_decides_both_ways() -> None:
    plain = gate()
    assert judged(plain, 0, 0.3, WEAK) is Verdict.ACCEPTED
    assert judged(plain, 1, 0.4) is Verdict.GATED
    assert judged(plain, 2, -0.4) is Verdict.GATED
    assert judged(plain, 3, 0.3) is Verdict.ACCEPTED


def test_a_range_that_is_too_long_is_named_so_and_its_anchor_remembered() -> None:
    remembering = gate("prediction")
    assert judged(remembering, 0, 0.4) is Verdict.TOO_LONG
    assert judged(remembering, 1, 0.25) is Verdict.TOO_LONG
    assert judged(remembering, 2, 0.0) is Verdict.SUSPECT
    assert judged(remembering, 200, 0.0) is Verdict.ACCEPTED


def test_a_reset_forgets_who_was_blocked() -> None:
    remembering = gate("prediction")
    assert judged(remembering, 0, 0.4) is Verdict.TOO_LONG
    remembering.reset()
    assert judged(remembering, 1, 0.0) is Verdict.ACCEPTED


def test_an_anchor_that_was_long_clear_is_not_doubted_for_one_outlier() -> None:
    remembering = gate("prediction")
    for k in range(50):
        assert judged(remembering, k, 0.0) is Verdict.ACCEPTED
    assert judged(remembering, 50, 0.4) is Verdict.TOO_LONG
    assert judged(remembering, 51, 0.0) is Verdict.ACCEPTED


def test_a_small_excess_shows_when_it_lasts() -> None:
    remembering = gate("prediction")
    for k in range(50):
        judged(remembering, k, 0.0)
    verdicts = [judged(remembering, k, 0.25) for k in range(50, 60)]
    assert verdicts[0] is Verdict.ACCEPTED
    assert set(verdicts[-5:]) == {Verdict.TOO_LONG}


def test_a_range_that_is_too_short_is_gated_and_says_nothing_of_its_anchor() -> None:
    for methods in (("prediction",), ("robust",), ("prediction", "power", "visibility")):
        of = gate(*methods)
        for k in range(20):
            assert judged(of, k, -0.4) is Verdict.GATED
        assert judged(of, 20, 0.0) is Verdict.ACCEPTED


def test_powers_alone_reject_where_the_vendor_calls_a_blocked_range_likely() -> None:
    alone = gate("power")
    assert judged(alone, 0, 0.0, 10.0) is Verdict.WEAK_FIRST_PATH
    assert judged(alone, 1, 0.0, 9.5) is Verdict.ACCEPTED
    assert judged(alone, 2, 0.0, NO_POWER) is Verdict.ACCEPTED
    assert judged(alone, 3, 0.4, CLEAR) is Verdict.GATED


def test_an_obstacle_alone_rejects(monkeypatch: pytest.MonkeyPatch) -> None:
    assert judged(gate("visibility"), 0, 0.0) is Verdict.ACCEPTED
    obstruct(monkeypatch)
    assert judged(gate("visibility"), 0, 0.0) is Verdict.OBSTRUCTED


def test_a_low_box_and_a_weak_first_path_reject_no_range_that_agreed_all_the_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    obstruct(monkeypatch)
    combined = gate("prediction", "power", "visibility")
    verdicts = [judged(combined, k, 0.0, WEAK) for k in range(40)]
    assert Verdict.ACCEPTED not in verdicts[:1]
    assert set(verdicts[5:]) == {Verdict.ACCEPTED}
    # ... but it takes less to reject one: alone, such a residual is nothing.
    assert judged(combined, 40, 0.22, WEAK) is Verdict.OBSTRUCTED
    plain = gate("prediction")
    for k in range(40):
        judged(plain, k, 0.0)
    assert judged(plain, 40, 0.22) is Verdict.ACCEPTED


def test_the_reason_is_what_speaks_most(monkeypatch: pytest.MonkeyPatch) -> None:
    methods: tuple[NlosMethod, ...] = ("prediction", "power", "visibility")
    assert judged(gate(*methods), 0, 0.32, WEAK) is Verdict.TOO_LONG
    assert judged(gate(*methods), 0, 0.2, WEAK) is Verdict.WEAK_FIRST_PATH
    obstruct(monkeypatch)
    assert judged(gate(*methods), 0, 0.2, WEAK) is Verdict.OBSTRUCTED


def test_the_order_of_the_names_means_nothing() -> None:
    rng = np.random.default_rng(0)
    rows = [(float(rng.normal(0.1, 0.2)), float(rng.choice([CLEAR, WEAK]))) for _ in range(200)]
    orders: list[tuple[NlosMethod, ...]] = list(permutations(("prediction", "power", "robust")))
    runs = [[judged(gate_, k, *row) for k, row in enumerate(rows)] for gate_ in (gate(*o) for o in orders)]
    assert len(set(runs[0])) > 1
    assert all(run == runs[0] for run in runs)


def test_robust_uses_every_range_that_is_not_too_short_but_counts_the_long_ones_less() -> None:
    soft = gate("robust")
    factors = []
    for k, residual in enumerate((0.0, 0.2, 0.4, 2.0)):
        verdict, factor = judged_alone(soft, first_of(frame_at(k, np.zeros(4))), residual)
        assert verdict is (Verdict.DOWNWEIGHTED if residual >= 0.4 else Verdict.ACCEPTED)
        factors.append(factor)
    assert factors == sorted(factors)
    assert 1.0 <= factors[0] < 1.1
    assert factors[-1] > 50.0


@pytest.mark.parametrize("methods", [("prediction",), ("prediction", "power"), ("prediction", "robust")])
def test_biased_ranges_go_and_clean_ones_stay(methods: tuple[NlosMethod, ...]) -> None:
    rng = np.random.default_rng(4)
    of = gate(*methods)
    rejected: dict[bool, list[bool]] = {True: [], False: []}
    for k in range(3000):
        blocked = k // 250 % 2 == 1
        excess = 0.2 + rng.exponential(0.3) if blocked else 0.0
        residual = excess + SIGMA * rng.standard_normal()
        difference = (WEAK if blocked else CLEAR) + 2.0 * rng.standard_normal()
        verdict = judged(of, k, residual, difference)
        if not blocked or excess > 3.0 * SIGMA:
            rejected[blocked].append(verdict is not Verdict.ACCEPTED)
    assert np.mean(rejected[True]) > 0.98
    assert np.mean(rejected[False]) < 0.03


def test_what_is_no_range_says_what_is_wrong() -> None:
    frame = true_ranges(0, POSE, HALL)
    bad = replace(
        frame,
        anchor_ids=np.array([10, 11, 12, 99]),
        ranges=np.array([np.nan, -3.0, 0.5, 5.0]),
    )
    wrong = Verdict.IMPOSSIBLE
    candidates = gate("prediction").horizontal.of(bad, POSE, 0.0)
    assert candidates.verdicts == [wrong, wrong, wrong, Verdict.UNKNOWN_ANCHOR]
    assert np.isinf(candidates.rows[:, 3]).all()
    report = gate("prediction").judge_together(candidates, np.zeros(4), np.eye(4))
    assert list(report.verdicts) == candidates.verdicts
    assert np.isnan([report.residuals, report.nis]).all()


@pytest.mark.parametrize("methods", [(), ("prediction", "power", "visibility"), ("robust", "visibility")])
def test_what_is_judged_together_is_judged_as_by_a_kalman_filter_one_by_one(
    methods: tuple[NlosMethod, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    obstruct(monkeypatch)
    rng = np.random.default_rng(6)
    together, alone = gate(*methods), gate(*methods)
    given: set[Verdict] = set()
    for k in range(200):
        frame = frame_at(k, np.zeros(4), rng.choice([CLEAR, WEAK], 4))
        frame = replace(frame, anchor_ids=np.where(rng.random(4) < 0.1, 99, frame.anchor_ids))
        root = 0.1 * rng.standard_normal((4, 4))
        mean = root @ rng.standard_normal(4) + SIGMA * rng.standard_normal(4) + 0.5 * (rng.random(4) < 0.2)
        cov = root @ root.T
        candidates = together.horizontal.of(frame, POSE, 0.0)
        report = together.judge_together(candidates, mean.copy(), cov.copy())
        state, spread = np.zeros(4), cov
        singles = alone.horizontal.of(frame, POSE, 0.0)
        for i, verdict in enumerate(singles.verdicts):
            if verdict is not Verdict.WAITING:
                assert report.verdicts[i] is verdict
                continue
            H, sigma = np.eye(4)[i], singles.rows[i, 3]
            residual = mean[i] - state[i]
            nis = residual**2 / (spread[i, i] + sigma**2)
            one = {name: getattr(frame, name)[i : i + 1] for name in COLUMNS}
            expected, factor = judged_alone(alone, replace(frame, **one), residual, spread[i, i])
            given.add(expected)
            assert report.verdicts[i] is expected
            assert report.residuals[i] == pytest.approx(residual, abs=1e-12)
            assert report.nis[i] == pytest.approx(nis, rel=1e-9)
            assert candidates.rows[i, 3] == pytest.approx(factor * sigma if expected.is_used else np.inf)
            if expected.is_used:
                gain = spread @ H / (spread[i, i] + (factor * sigma) ** 2)
                state = state + gain * residual
                spread = spread - np.outer(gain, H @ spread)
    assert len(given) >= 3 if methods else given == {Verdict.ACCEPTED, Verdict.GATED}


@given(st.floats(-1.0, 20.0) | st.just(np.nan), st.floats(0.0, 6.0), st.floats(-1.0, 1.0))
def test_ranges_are_reduced_as_the_model_does(slant: float, height: float, lift: float) -> None:
    arm = HALL.tag_in_body + np.array([0.0, 0.0, lift])
    anchor = np.array([4.0, 2.0, HALL.height + HALL.tag_in_body[2] + height])
    setup = replace(HALL, anchors={5: anchor}, tags={2: arm})
    frame = replace(range_frame(0, [5], [slant]), tag_id=2)
    candidates = RangeGate(RangeGate.Config(range_sigma=SIGMA), setup).horizontal.of(frame, POSE, 0.0)
    expected = reduce_height(slant, SIGMA, setup.height_to(anchor) - lift)
    if expected is None:
        assert candidates.verdicts == [Verdict.IMPOSSIBLE]
    else:
        np.testing.assert_allclose(candidates.rows, [[4.0, 2.0, *expected]], rtol=1e-9)


def test_columns_of_a_table_are_ranges_like_any_others() -> None:
    frame = frame_at(0, np.array([0.0, 0.9, 0.0, 0.0]), CLEAR)
    table = np.column_stack([frame.ranges, frame.rx_power, frame.fp_power])
    strided = RangeFrame(0, frame.tag_id, np.repeat(frame.anchor_ids, 2)[::2], *table.T)
    config = estimator_config_class("pf_ibas").model_validate({})
    reports = [make_estimator("pf_ibas", config, SURE).update(each) for each in (frame, strided)]
    assert reports[0].verdicts == reports[1].verdicts
    np.testing.assert_array_equal(reports[0].residuals, reports[1].residuals)


FILTERS = ["ekf", "graph", "pf", "pf_ibas", "pf_ibas_graph"]


def stand(
    name: str, excess: FloatArray, frames: int, setup: Setup = SURE, **settings: object
) -> tuple[list[tuple[Verdict, ...]], FloatArray, FloatArray]:
    """Verdicts, pose (3,) and its covariance after so many frames at the start, with exact odometry."""
    config = estimator_config_class(name).model_validate(settings)
    estimator = make_estimator(name, config, setup)
    verdicts = []
    tight = np.diag([1e-6, 1e-6, 1e-7])
    for k in range(frames):
        increment = PoseIncrement(
            0, k * STEP_NS, np.zeros(3), tight if k else 0.0 * tight, is_keyframe=k == 0
        )
        estimator.update(increment)
        verdicts.append(estimator.update(frame_at(k, excess)).verdicts)
    pose = estimator.pose_at(frames * STEP_NS)
    assert pose is not None
    return verdicts, np.array([*pose.xy, pose.yaw]), pose.planar_cov


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("methods", [["prediction"], ["prediction", "robust"]], ids=str)
def test_every_filter_keeps_its_pose_while_half_of_the_anchors_are_blocked(
    name: str, methods: list[str]
) -> None:
    verdicts, pose, _ = stand(name, np.array([0.5, 0.0, 0.0, 0.8]), 50, nlos=methods)
    good, bad = Verdict.ACCEPTED, Verdict.DOWNWEIGHTED if "robust" in methods else Verdict.TOO_LONG
    assert set(verdicts[5:]) == {(bad, good, good, bad)}
    assert np.hypot(*(pose - POSE)[:2]) < 0.05
    _, led_astray, _ = stand(name, np.array([0.25, 0.0, 0.0, 0.25]), 50, nlos=[])
    assert np.hypot(*(led_astray - POSE)[:2]) > 0.05


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("excess", [4.0, np.nan, -30.0], ids=str)
def test_ten_seconds_without_a_range_to_believe_leave_a_pose_whose_doubt_grows(
    name: str, excess: float
) -> None:
    moving = replace(SURE, start=Start(POSE, SURE.start.sigma, still_for=0.0))
    config = estimator_config_class(name).model_validate({"particles": 50} if name == "pf" else {})
    estimator = make_estimator(name, config, moving)
    sigmas = []
    for k in range(250):
        stamp_ns = (k if k % 50 != 49 else k - 5) * STEP_NS
        report = estimator.update(replace(frame_at(0, np.full(4, excess)), stamp_ns=stamp_ns))
        if k < 50:
            assert Verdict.ACCEPTED not in report.verdicts
        estimator.update(range_frame(stamp_ns, [], []))
        pose = estimator.pose_at(stamp_ns)
        assert pose is not None
        assert np.isfinite(pose.T_map_body).all()
        assert np.linalg.eigvalsh(pose.planar_cov)[0] > 0.0
        sigmas.append(float(np.sqrt(np.trace(pose.planar_cov[:2, :2]))))
    assert sigmas[24] < sigmas[48]
    if not np.isfinite(excess) or excess < 0.0:
        assert sigmas[48] < sigmas[148] < sigmas[248]


def test_a_line_of_sight_is_looked_along_only_where_it_may_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    looks: list[int] = []

    def look(*_: object) -> float:
        looks.append(1)
        return OBSTRUCTED

    monkeypatch.setattr(Visibility, "log_ratio", look)
    of = gate("prediction", "power", "visibility")
    assert [judged(of, k, 0.0, CLEAR) for k in range(20)] == [Verdict.ACCEPTED] * 20
    assert not looks  # a clear first path and a range that fits outweigh any obstacle
    assert judged(of, 21, 0.3, WEAK) in {Verdict.WEAK_FIRST_PATH, Verdict.OBSTRUCTED, Verdict.TOO_LONG}
    assert len(looks) == 1
    soft = gate("robust", "visibility")
    judged(soft, 0, 0.0)
    assert len(looks) == 2
