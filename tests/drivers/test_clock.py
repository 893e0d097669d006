"""Device clocks against simulated clocks and delays whose truth is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.clock import ClockLine, DeviceClock
from estimators.messages import FloatArray, IntArray

MS = 1_000_000
SECOND = 1000 * MS
LEAST_DELAY = 1 * MS


def arrivals(true_ns: FloatArray, seed: int, stall_ms: float = 80.0) -> IntArray:
    """Arrivals in order: a least delay, jitter, and a stall now and then."""
    rng = np.random.default_rng(seed)
    stalled = (rng.random(len(true_ns)) < 0.02) * rng.uniform(0, stall_ms * MS, len(true_ns))
    jitter = rng.exponential(3 * MS, len(true_ns)) + stalled
    late: IntArray = np.maximum.accumulate(true_ns + LEAST_DELAY + jitter).astype(np.int64)
    return late


def stamps(clock: DeviceClock, ticks: IntArray, arrival_ns: IntArray) -> FloatArray:
    """What the clock makes of readings, in order."""
    return np.array(
        [clock.stamp(t, a) for t, a in zip(ticks.tolist(), arrival_ns.tolist(), strict=True)], np.float64
    )


def instants(rate: float, seconds: float) -> FloatArray:
    """Host times of regular measurements."""
    return 7 * SECOND + np.arange(int(rate * seconds)) / rate * SECOND


@pytest.mark.parametrize("drift", [-100e-6, 0.0, 50e-6])
@pytest.mark.parametrize("rate", [10.0, 50.0, 200.0])
def test_jitter_is_removed_and_quartz_drift_is_followed(rate: float, drift: float) -> None:
    true_ns = instants(rate, 60.0)
    ticks = (123_456.7 + (true_ns - true_ns[0]) * (1 + drift) / MS).astype(np.int64)
    arrival_ns = arrivals(true_ns, seed=int(rate))
    error = stamps(DeviceClock(MS, 2**32), ticks, arrival_ns) - true_ns - LEAST_DELAY
    settled = error[true_ns > true_ns[0] + 3 * SECOND]
    # a tick of quantisation downwards, part of the least jitter upwards
    assert np.abs(settled).max() < 2 * MS
    assert np.std(settled) < 0.6 * MS
    assert np.std(arrival_ns - true_ns) > 4 * MS


@given(
    zero_ns=st.integers(-(10**15), 10**18),
    point_ns=st.integers(0, 10**15),
    drift=st.floats(-0.02, 0.02),
    readings=st.lists(st.integers(-(10**6), 10**9), min_size=1, max_size=20),
)
def test_many_readings_have_the_times_that_each_has(
    zero_ns: int, point_ns: int, drift: float, readings: list[int]
) -> None:
    line = ClockLine(zero_ns, 125_000, zero_ns + point_ns, 10**9, drift)
    assert line.host_times(np.array(readings)).tolist() == [line.host_ns(reading) for reading in readings]
    for reading in readings:
        since_ns = reading * line.tick_ns - point_ns
        late_ns = line.host_ns(reading) - (zero_ns + reading * line.tick_ns + line.delay_ns)
        assert abs(late_ns - drift * since_ns) <= 0.5 + 1e-15 * abs(since_ns)


@pytest.mark.parametrize("drift", [-0.016, 0.016])
def test_a_tick_that_lasts_longer_or_shorter_than_thought_is_learnt(drift: float) -> None:
    tick_ns = 8 * MS  # one packet of an RPLIDAR, whose sample duration is only roughly known
    ticks = np.arange(4000)
    true_ns = np.asarray(7 * SECOND + ticks * tick_ns * (1 + drift), np.float64)
    error = stamps(DeviceClock(tick_ns, 2**62), ticks, arrivals(true_ns, seed=3)) - true_ns - LEAST_DELAY
    assert np.abs(error[true_ns > true_ns[0] + 4 * SECOND]).max() < 1.5 * MS


def test_the_counter_wraps_unnoticed() -> None:
    true_ns = instants(50.0, 20.0)
    ticks = np.arange(len(true_ns)) * 20 + 12345
    whole = stamps(DeviceClock(MS, 2**32), ticks, arrivals(true_ns, seed=1))
    near_end = (ticks + 2**32 - 20_000) % 2**32
    np.testing.assert_array_equal(stamps(DeviceClock(MS, 2**32), near_end, arrivals(true_ns, seed=1)), whole)


def test_a_rebooted_device_is_followed_at_once() -> None:
    before, after = instants(50.0, 10.0), instants(50.0, 10.0) + 12 * SECOND
    true_ns = np.concatenate([before, after])
    ticks = np.concatenate([90_000 + np.arange(len(before)) * 20, 300 + np.arange(len(after)) * 20])
    error = stamps(DeviceClock(MS, 2**32), ticks, arrivals(true_ns, seed=2)) - true_ns
    assert np.abs(error).max() < 100 * MS
    assert np.abs(error[true_ns > after[0] + SECOND]).max() < 3 * MS


def test_a_counter_that_leaps_ahead_is_followed_at_once() -> None:
    true_ns = instants(50.0, 20.0)
    ticks = np.arange(len(true_ns)) * 20 + np.where(true_ns > 15 * SECOND, 10_000, 0)
    arrival_ns = (true_ns + LEAST_DELAY).astype(np.int64)
    error = stamps(DeviceClock(MS, 2**32), ticks, arrival_ns) - true_ns - LEAST_DELAY
    assert np.abs(error).max() < MS


def test_stalls_of_the_host_do_not_move_the_stamps() -> None:
    true_ns = instants(50.0, 20.0)
    ticks = np.arange(len(true_ns)) * 20
    arrival_ns = arrivals(true_ns, seed=4, stall_ms=0.0)
    for end_s in (17.8, 19.8):  # all of it in one read
        stall = (true_ns > (end_s - 0.8) * SECOND) & (true_ns < end_s * SECOND)
        arrival_ns[stall] = end_s * SECOND
    error = stamps(DeviceClock(MS, 2**32), ticks, arrival_ns) - true_ns - LEAST_DELAY
    assert np.abs(error[true_ns > 10 * SECOND]).max() < 1.5 * MS


def test_a_host_clock_that_went_on_without_the_device_is_believed_after_a_second() -> None:
    true_ns = instants(50.0, 10.0)
    ticks = np.arange(len(true_ns)) * 20
    true_ns = true_ns + np.where(true_ns > 12 * SECOND, 3 * SECOND, 0)  # the device slept for 3 s
    error = stamps(DeviceClock(MS, 2**32), ticks, arrivals(true_ns, seed=5)) - true_ns
    assert np.abs(error[true_ns > 16.5 * SECOND]).max() < 50 * MS


def test_a_counter_that_stands_still_gives_arrivals() -> None:
    clock = DeviceClock(MS, 2**32)
    assert [clock.stamp(0, a * SECOND) for a in (5, 6, 8)] == [5 * SECOND, 6 * SECOND, 8 * SECOND]


def test_two_readings_of_one_instant_have_one_stamp() -> None:
    clock = DeviceClock(MS, 2**32)
    clock.stamp(0, SECOND)
    clock.stamp(20, SECOND + 20 * MS)
    assert clock.stamp(40, SECOND + 41 * MS) == clock.stamp(40, SECOND + 43 * MS) == SECOND + 40 * MS


def test_restart_forgets_the_offset_and_keeps_the_drift() -> None:
    tick_ns, drift = 8 * MS, 0.016
    clock = DeviceClock(tick_ns, 2**62)
    ticks = np.arange(1500)
    stamps(clock, ticks, (7 * SECOND + ticks * tick_ns * (1 + drift)).astype(np.int64))
    clock.restart()
    clock.observe(0, 50 * SECOND)
    assert clock.line.host_ns(0) == 50 * SECOND
    assert clock.line.host_ns(-100) == pytest.approx(50 * SECOND - 100 * tick_ns * (1 + drift), abs=MS)


readings = st.lists(
    st.tuples(st.integers(0, 2**32 - 1) | st.integers(0, 2000), st.integers(0, 2 * SECOND)), max_size=60
)


@given(readings)
def test_the_newest_reading_is_never_from_the_future(readings: list[tuple[int, int]]) -> None:
    clock, arrival_ns = DeviceClock(MS, 2**32), 0
    for ticks, later_ns in readings:
        arrival_ns += later_ns
        clock.observe(ticks, arrival_ns)
        assert clock.line.host_ns(ticks) <= arrival_ns


@given(readings)
def test_stamps_never_fall_and_never_exceed_the_arrival(readings: list[tuple[int, int]]) -> None:
    clock, arrival_ns, last_ns = DeviceClock(MS, 2**32), 0, -(2**63)
    for ticks, later_ns in readings:
        arrival_ns += later_ns
        stamp_ns = clock.stamp(ticks, arrival_ns)
        assert last_ns <= stamp_ns <= arrival_ns
        last_ns = stamp_ns
