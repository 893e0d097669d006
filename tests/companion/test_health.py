"""Health: what the pilot's autopilot gets, and what it does not."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config_tables import HealthTable
from companion.health import HealthMonitor, State, uwb_line
from estimators.base import Report, Verdict
from estimators.messages import FloatArray, PoseEstimate, PoseIncrement, RangeFrame

SECOND = 1_000_000_000


def pose(cov: FloatArray | None = None, x: float = 0.0) -> PoseEstimate:
    T = np.eye(4)
    T[0, 3] = x
    return PoseEstimate(0, T, np.eye(6) * 0.01 if cov is None else cov, 0)


def ranges(stamp_ns: int) -> RangeFrame:
    return RangeFrame(stamp_ns, 1, np.arange(4), np.ones(4), np.ones(4), np.ones(4))


def increment(stamp_ns: int) -> PoseIncrement:
    return PoseIncrement(stamp_ns - 1, stamp_ns, np.zeros(3), np.eye(3), False)


def monitor_at(
    seconds: float, ranges_until: float = np.inf, increments_until: float = np.inf, good: int = 4
) -> HealthMonitor:
    """A monitor that has followed a run at 10 Hz."""
    monitor = HealthMonitor(HealthTable.model_validate({}), has_ranges=True, has_scans=True)
    verdicts = (Verdict.ACCEPTED,) * good + (Verdict.GATED,) * (4 - good)
    for stamp_ns in range(0, round(seconds * SECOND) + 1, SECOND // 10):
        if stamp_ns <= ranges_until * SECOND:
            monitor.observe(ranges(stamp_ns), Report(verdicts))
        if stamp_ns <= increments_until * SECOND:
            monitor.observe(increment(stamp_ns), Report((Verdict.ACCEPTED,)))
    return monitor


def state(monitor: HealthMonitor, seconds: float, given: PoseEstimate | None) -> State:
    return monitor.judge(given, round(seconds * SECOND)).state


def test_all_well() -> None:
    health = monitor_at(5.0).judge(pose(), 5 * SECOND)
    assert (health.state, health.reason, health.sends) == (State.OK, "", True)


def test_starting_until_there_is_a_pose_and_every_sensor_was_heard() -> None:
    assert state(monitor_at(5.0), 5.0, None) is State.STARTING
    assert state(monitor_at(0.5, increments_until=-1.0), 0.5, pose()) is State.STARTING


@pytest.mark.parametrize(
    ("ranges_until", "increments_until", "what"), [(3.0, 5.0, "range"), (5.0, 3.0, "LiDAR increment")]
)
def test_degraded_but_sent_while_one_sensor_is_missing(
    ranges_until: float, increments_until: float, what: str
) -> None:
    monitor = monitor_at(5.0, ranges_until, increments_until)
    health = monitor.judge(pose(), 5 * SECOND)
    assert (health.state, health.sends) == (State.DEGRADED, True)
    assert what in health.reason


def test_dead_reckoning_without_ranges_is_bounded() -> None:
    monitor = monitor_at(30.0, ranges_until=3.0)
    assert state(monitor, 22.9, pose()) is State.DEGRADED
    health = monitor.judge(pose(), round(23.1 * SECOND))
    assert health.state is State.LOST
    assert "no range accepted for 20.1 s" in health.reason


def test_a_heading_that_nobody_needs_may_be_unknown() -> None:
    cov = np.diag([0.01, 0.01, 0.01, 0.01, 0.01, np.inf])
    for needs_heading, expected in ((True, State.LOST), (False, State.OK)):
        monitor = HealthMonitor(HealthTable.model_validate({}), True, False, needs_heading=needs_heading)
        for stamp_ns in range(0, 5 * SECOND, SECOND // 10):
            monitor.observe(ranges(stamp_ns), Report((Verdict.ACCEPTED,) * 4))
        health = monitor.judge(pose(cov), 5 * SECOND)
        assert health.state is expected
        assert health.reason.endswith("set mavlink.heading = false") is needs_heading


def test_a_sensor_that_never_speaks_is_degraded_after_a_while() -> None:
    assert state(monitor_at(5.0, increments_until=-1.0), 5.0, pose()) is State.DEGRADED


def test_lost_when_every_sensor_is_missing() -> None:
    assert state(monitor_at(5.0, ranges_until=2.0, increments_until=2.0), 5.0, pose()) is State.LOST


def go_on(monitor: HealthMonitor, begin: int, end: int, verdict: Verdict) -> None:
    for stamp_ns in range(begin * SECOND, end * SECOND, SECOND // 10):
        monitor.observe(ranges(stamp_ns), Report((verdict,) * 4))
        monitor.observe(increment(stamp_ns), Report((Verdict.ACCEPTED,)))


def test_lost_while_ranges_disagree_with_the_pose_and_back_when_they_agree() -> None:
    monitor = monitor_at(5.0)
    assert state(monitor, 5.0, pose()) is State.OK
    go_on(monitor, 5, 15, Verdict.GATED)
    assert state(monitor, 15.0, pose()) is State.LOST
    go_on(monitor, 15, 25, Verdict.ACCEPTED)
    assert state(monitor, 25.0, pose()) is State.OK


def test_starting_and_not_sent_while_the_first_ranges_disagree_with_the_start_pose() -> None:
    monitor = monitor_at(20.0, good=0)
    health = monitor.judge(pose(), 20 * SECOND)
    assert (health.state, health.sends) == (State.STARTING, False)
    assert "start mark" in health.reason
    go_on(monitor, 20, 30, Verdict.ACCEPTED)
    assert state(monitor, 30.0, pose()) is State.OK


def test_a_few_blocked_anchors_are_no_alarm() -> None:
    assert state(monitor_at(20.0, good=2), 20.0, pose()) is State.OK


@pytest.mark.parametrize(("residual", "expected"), [(0.8, State.OK), (-0.8, State.LOST)])
def test_a_range_that_is_too_short_is_an_alarm_where_a_long_one_is_none(
    residual: float, expected: State
) -> None:
    monitor = monitor_at(5.0)
    verdicts = (*(Verdict.ACCEPTED,) * 3, Verdict.GATED)
    report = Report(verdicts, np.array([0.0, 0.0, 0.0, residual]), np.zeros(4))
    for stamp_ns in range(5 * SECOND, 6 * SECOND, SECOND // 10):
        monitor.observe(ranges(stamp_ns), report)
        monitor.observe(increment(stamp_ns), Report((Verdict.ACCEPTED,)))
    assert state(monitor, 6.0, pose()) is expected


def test_a_lost_pose_must_agree_better_than_one_that_is_kept() -> None:
    # Two of five: enough to go on, not enough to begin.
    verdicts = (*(Verdict.ACCEPTED,) * 2, *(Verdict.GATED,) * 3)
    ones = np.ones(5)
    kept, lost = monitor_at(5.0), monitor_at(5.0)
    go_on(lost, 5, 15, Verdict.GATED)
    for monitor, begin in ((kept, 5), (lost, 15)):
        for stamp_ns in range(begin * SECOND, (begin + 20) * SECOND, SECOND // 10):
            monitor.observe(RangeFrame(stamp_ns, 1, np.arange(5), ones, ones, ones), Report(verdicts))
            monitor.observe(increment(stamp_ns), Report((Verdict.ACCEPTED,)))
    assert state(kept, 25.0, pose()) is State.OK
    assert state(lost, 35.0, pose()) is State.LOST


def test_lost_when_the_covariance_says_so() -> None:
    wide = np.eye(6) * 0.01
    wide[0, 0] = wide[1, 1] = wide[0, 1] = wide[1, 0] = 0.2
    wide[0, 0] = 0.3
    assert state(monitor_at(5.0), 5.0, pose(wide)) is State.LOST
    turned = np.eye(6) * 0.01
    turned[5, 5] = np.deg2rad(21.0) ** 2
    assert state(monitor_at(5.0), 5.0, pose(turned)) is State.LOST


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_nothing_that_is_not_finite_is_sent(bad: float) -> None:
    cov = np.eye(6) * 0.01
    cov[2, 2] = bad
    assert state(monitor_at(5.0), 5.0, pose(cov)) is State.LOST
    assert state(monitor_at(5.0), 5.0, pose(x=bad)) is State.LOST


def test_a_covariance_that_is_none_is_not_sent() -> None:
    cov = np.eye(6) * 0.01
    cov[0, 1] = cov[1, 0] = 0.02
    assert state(monitor_at(5.0), 5.0, pose(cov)) is State.LOST


def test_an_unknown_heading_is_named() -> None:
    cov = np.eye(6) * 0.01
    cov[5, 5] = np.inf
    health = monitor_at(5.0).judge(pose(cov), 5 * SECOND)
    assert (health.state, health.sends) == (State.LOST, False)
    assert "heading not known" in health.reason


def test_what_an_estimator_lacks_is_told_to_the_operator() -> None:
    monitor = monitor_at(5.0)
    assert monitor.judge(None, 5 * SECOND).reason == "no pose yet: waiting for measurements"
    lost = np.eye(6) * 0.01
    lost[5, 5] = np.inf
    assert monitor.judge(pose(lost), 5 * SECOND).reason.endswith("start again on the start mark")
    monitor.observe(ranges(5 * SECOND), Report((Verdict.WAITING,) * 4, note="drive a metre"))
    looking = monitor.judge(None, 5 * SECOND)
    assert (looking.reason, looking.brief) == ("looking for the pose: drive a metre", "drive a metre")
    health = monitor.judge(pose(lost), 5 * SECOND)
    assert (health.state, health.reason) == (
        State.LOST,
        "heading not known: drive a metre",
    )
    monitor.observe(ranges(5 * SECOND), Report((Verdict.ACCEPTED,) * 4))
    assert monitor.judge(None, 5 * SECOND).reason == "no pose yet: waiting for measurements"


@pytest.mark.parametrize(
    ("verdict", "expected"),
    [
        (Verdict.TOO_LONG, State.LOST),
        (Verdict.DOWNWEIGHTED, State.LOST),
        (Verdict.SUSPECT, State.OK),
        (Verdict.WEAK_FIRST_PATH, State.OK),
        (Verdict.OBSTRUCTED, State.OK),
    ],
)
def test_what_is_too_long_speaks_against_the_pose_and_what_only_stands_in_the_way_does_not(
    verdict: Verdict, expected: State
) -> None:
    monitor = monitor_at(5.0)
    report = Report((Verdict.ACCEPTED, verdict, verdict, verdict), np.full(4, 0.5), np.zeros(4))
    # One of four agrees, below `min_accepted_share`.
    for stamp_ns in range(5 * SECOND, 25 * SECOND, SECOND // 10):
        monitor.observe(ranges(stamp_ns), report)
        monitor.observe(increment(stamp_ns), Report((Verdict.ACCEPTED,)))
    assert state(monitor, 25.0, pose()) is expected


@pytest.mark.parametrize(("contradicting", "expected"), [(1, State.OK), (2, State.OK), (3, State.LOST)])
def test_anchors_that_contradict_speak_against_the_pose_when_they_outnumber_the_others(
    contradicting: int, expected: State
) -> None:
    monitor = monitor_at(5.0)
    verdicts = (Verdict.CONTRADICTS,) * contradicting + (Verdict.ACCEPTED,) * (4 - contradicting)
    for stamp_ns in range(5 * SECOND, 15 * SECOND, SECOND // 10):
        monitor.observe(ranges(stamp_ns), Report(verdicts, np.full(4, -0.5), np.zeros(4)))
        monitor.observe(increment(stamp_ns), Report((Verdict.ACCEPTED,)))
    assert state(monitor, 15.0, pose()) is expected


def test_the_operator_hears_which_anchors_are_used_and_why_the_others_are_not() -> None:
    monitor = HealthMonitor(HealthTable.model_validate({}), True, True, anchor_ids=[0, 1, 2, 3, 7])
    assert uwb_line(monitor.anchors(0)) == "UWB: 0 of 5 anchors, A0 A1 A2 A3 A7 silent"
    assert uwb_line(monitor.anchors(0), longest=35) == "UWB 0/5: A0 A1 A2 A3 A7 silent"
    assert uwb_line(monitor.anchors(0), longest=25) == "UWB 0/5: 5 silent"
    good, bad = Verdict.ACCEPTED, Verdict.WEAK_FIRST_PATH
    monitor.observe(ranges(SECOND), Report((good, Verdict.DOWNWEIGHTED, good, Verdict.IMPOSSIBLE)))
    monitor.observe(ranges(2 * SECOND), Report((good, Verdict.DOWNWEIGHTED, bad, Verdict.GATED)))
    now_ns = 2 * SECOND + SECOND // 10
    assert uwb_line(monitor.anchors(now_ns)) == "UWB: 2 of 5 anchors, A2 NLOS, A3 gated, A7 silent"
    assert [anchor.reason for anchor in monitor.anchors(now_ns)] == ["", "", bad, Verdict.GATED, ""]
    # One range that was used a moment ago is enough: a single outlier is no news.
    assert monitor.anchors(SECOND + SECOND // 2)[2].is_used
    assert not any(anchor.is_used or anchor.reason for anchor in monitor.anchors(10 * SECOND))


def test_an_estimator_without_use_for_ranges_leaves_the_anchors_silent() -> None:
    monitor = HealthMonitor(HealthTable.model_validate({}), True, True, anchor_ids=[0, 1])
    frame = RangeFrame(SECOND, 1, np.arange(2), np.ones(2), np.ones(2), np.ones(2))
    monitor.observe(frame, Report((Verdict.NOT_USED,) * 2))
    assert uwb_line(monitor.anchors(SECOND)) == "UWB: 0 of 2 anchors, A0 A1 silent"


def test_after_a_reset_ranges_must_confirm_the_pose_before_it_is_sent_again() -> None:
    monitor = monitor_at(5.0)
    good = Report((Verdict.ACCEPTED,) * 4, np.zeros(4), np.zeros(4))
    moved = replace(pose(), reset_counter=1)
    states = []
    for stamp_ns in range(5 * SECOND, 10 * SECOND, SECOND // 10):
        monitor.observe(ranges(stamp_ns), good)
        monitor.observe(increment(stamp_ns), Report((Verdict.ACCEPTED,)))
        states.append(monitor.judge(pose() if stamp_ns < 7 * SECOND else moved, stamp_ns).state)
    assert set(states[:20]) == {State.OK}
    assert set(states[20:30]) == {State.LOST}
    assert set(states[40:]) == {State.OK}


@settings(deadline=None)
@given(st.floats(0.45, 0.75), st.floats(0.01, 1.0), st.floats(0.6, 0.9))
def test_a_position_is_as_uncertain_as_along_the_longer_axis_of_its_ellipse(
    longer: float, share: float, turn: float
) -> None:
    c, s = np.cos(turn), np.sin(turn)
    axes = np.array([[c, -s], [s, c]])
    cov = np.eye(6) * 1e-4
    cov[:2, :2] = axes @ np.diag([longer**2, (share * longer) ** 2]) @ axes.T
    judged = monitor_at(1.0).judge(pose(cov), SECOND)
    limit = HealthTable.model_validate({}).max_sigma_xy
    if abs(longer - limit) > 1e-6:
        assert ("position sigma" in judged.reason) == (longer > limit)
