"""Scans from RPLIDAR bytes: geometry, gaps, and the times of the beams against a simulated device's."""

import random
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise, repeat

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from drivers import make_sensor
from drivers.rplidar import Rplidar
from drivers.rplidar_nodes import encode_standard_node
from drivers.rplidar_protocol import (
    Answer,
    AnswerType,
    ConfKey,
    DeviceInfo,
    LidarConf,
    SampleRate,
    encode_answer,
    encode_descriptor,
)
from estimators.messages import IntArray, Scan
from tests import vectors
from tests.drivers.rplidar_streams import (
    LEFT,
    MS,
    REVOLUTIONS_PER_S,
    RIGHT,
    SAMPLE_NS,
    SECOND,
    T0_NS,
    Stream,
    cut,
    random_sizes,
    read_by_a_busy_host,
    room_range,
    stream,
)

LEAST_DELAY_NS = 2 * MS
LONG = 6.3  # seconds
WITH_QUALITY = {
    AnswerType.STANDARD_SCAN: 120.0,
    AnswerType.HQ_SCAN: 200.0,
    AnswerType.ULTRA_DENSE_SCAN: 80.0,
}
# 1/64 deg of angle is at most 5 mm on a wall seen at a slant; ultra-dense rounds distances to 3 mm, ultra to
# 8 mm, and its beams leave at an angle that depends on that
TOLERANCE = dict.fromkeys(SAMPLE_NS, 0.006) | {
    AnswerType.ULTRA_DENSE_SCAN: 0.009,
    AnswerType.ULTRA_SCAN: 0.012,
}

every_kind = pytest.mark.parametrize("kind", list(SAMPLE_NS), ids=lambda kind: kind.name.lower())
STANDARD, EXPRESS = AnswerType.STANDARD_SCAN, AnswerType.EXPRESS_SCAN


def scans_of(rplidar: Rplidar, pieces: Iterable[tuple[bytes, int]]) -> list[Scan]:
    scans = [scan for data, stamp_ns in pieces for scan in rplidar.feed(data, stamp_ns)]
    assert all(isinstance(scan, Scan) for scan in scans)
    return [scan for scan in scans if isinstance(scan, Scan)]


def decoded(pieces: Iterable[tuple[bytes, int]], **config: float) -> list[Scan]:
    return scans_of(Rplidar(Rplidar.Config.model_validate(config)), pieces)


def times_ns(scan: Scan) -> IntArray:
    return scan.stamp_ns + np.rint(scan.beam_times * 1e9).astype(np.int64)


def first_sample(scan: Scan, source: Stream, near: int) -> int:
    """Number of a scan's first sample, by directions; `near` is right within a third of a turn."""
    reach = int(SECOND / REVOLUTIONS_PER_S / source.sample_ns / 3)
    numbers = np.arange(max(0, near - reach), near + reach)
    compared = scan.angles[:32]  # the beams of express jump to and fro, so one alone could be mistaken
    off = source.angles[numbers[:, None] + np.arange(len(compared))] - compared
    return int(numbers[np.argmin(np.abs(np.angle(np.exp(1j * off))).sum(axis=1))])


def errors_ns(scan: Scan, source: Stream, delay_ns: int = 0) -> IntArray:
    """How much later than they were taken the samples of a scan are stamped, beyond a delay that all have."""
    first = first_sample(scan, source, (scan.stamp_ns - delay_ns - T0_NS) // source.sample_ns)
    taken_ns = T0_NS + source.sample_ns * np.arange(first, first + len(scan.angles))
    return times_ns(scan) - delay_ns - taken_ns


def worst_error_ms(
    scans: Sequence[Scan], source: Stream, from_ns: int, delay_ns: int = LEAST_DELAY_NS
) -> float:
    """Greatest error of any beam from some time on."""
    late = [scan for scan in scans if scan.stamp_ns > from_ns]
    assert len(late) > 5
    return max(float(np.abs(errors_ns(scan, source, delay_ns)).max()) for scan in late) / MS


def assert_ascending(scans: Sequence[Scan]) -> None:
    assert len(scans) > 1
    assert (np.diff(np.concatenate([times_ns(scan) for scan in scans])) > 0).all()


# geometry


@every_kind
def test_scans_show_the_room_counter_clockwise_in_metres(kind: AnswerType) -> None:
    rplidar = Rplidar(Rplidar.Config())
    scans = scans_of(rplidar, stream(kind, 1.0).on_time())
    assert len(scans) == 9  # from 200 deg on 9.7 turns: the last begins 90 deg before the end
    assert rplidar.dropped_scans == 0
    for scan in scans:
        expected = 1e9 / REVOLUTIONS_PER_S / SAMPLE_NS[kind]
        assert abs(len(scan.angles) - expected) <= 2
        assert scan.angles.min() >= -np.pi
        assert scan.angles.max() < np.pi
        np.testing.assert_allclose(scan.ranges, room_range(scan.angles), atol=TOLERANCE[kind])
        left = np.argmin(np.abs(scan.angles - np.pi / 2))
        assert scan.ranges[left] == pytest.approx(LEFT, abs=0.01)
        right = np.argmin(np.abs(scan.angles + np.pi / 2))
        assert scan.ranges[right] == pytest.approx(-RIGHT, abs=0.01)
        # the head turns clockwise
        turned = -np.diff(np.unwrap(scan.angles)).sum()
        assert turned == pytest.approx(2 * np.pi, abs=0.3)


@every_kind
def test_quality_is_the_device_s_own_and_zero_where_it_gives_none(kind: AnswerType) -> None:
    (scan, *_) = decoded(stream(kind, 0.4).on_time())
    assert set(scan.quality) == {WITH_QUALITY.get(kind, 0.0)}


def test_returns_outside_the_limits_become_no_return() -> None:
    (scan, *_) = decoded(stream(EXPRESS, 0.4).on_time(), min_range=2.0, max_range=3.5)
    truth = room_range(scan.angles)
    inside = (truth > 2.01) & (truth < 3.49)
    outside = (truth < 1.99) | (truth > 3.51)
    assert (scan.ranges[inside] > 0).all()
    assert (scan.ranges[outside] == 0).all()
    assert inside.sum() > 50
    assert outside.sum() > 50


@pytest.mark.parametrize("stem", vectors.stems("rplidar_*_clean", "rplidar_sitl_*"))
def test_the_sdk_s_clean_streams_give_a_scan_between_every_two_starts(stem: str) -> None:
    vector = vectors.load(stem)
    scans = decoded([(vectors.stream(stem), T0_NS)])
    starts = vector["start_flag_indexes"]
    assert [len(scan.angles) for scan in scans] == [end - first for first, end in pairwise(starts)]
    expected = np.array([row[1] / 4000 for row in vector["nodes"][starts[0] : starts[-1]]])
    expected[(expected < 0.15) | (expected > 40)] = 0
    np.testing.assert_array_equal(np.concatenate([scan.ranges for scan in scans]), expected)


# time


@every_kind
def test_beam_times_are_exact_when_packets_arrive_on_time(kind: AnswerType) -> None:
    source = stream(kind, 1.0)
    for scan in decoded(source.on_time()):
        np.testing.assert_array_equal(errors_ns(scan, source), 0)


@every_kind
@pytest.mark.parametrize("longest", [3, 60, 700])
def test_beam_times_and_content_do_not_depend_on_the_chunks(kind: AnswerType, longest: int) -> None:
    source = stream(kind, 1.0)
    whole = decoded(source.on_time())
    scans = decoded(cut(*source.line(), random_sizes(random.Random(longest), longest)))
    assert len(scans) == len(whole)
    for scan, reference in zip(scans, whole, strict=True):
        np.testing.assert_array_equal(scan.angles, reference.angles)
        np.testing.assert_array_equal(scan.ranges, reference.ranges)
        assert scan.beam_times[0] == 0
        # a chunk that ends inside a packet tells nothing of it, so at first times are late by up to one
        errors = errors_ns(scan, source)
        assert errors.min() >= -1
        assert errors.max() <= source.packet_ns
    assert_ascending(scans)


@every_kind
def test_all_packets_in_one_chunk_are_spaced_as_they_were_taken(kind: AnswerType) -> None:
    source = stream(kind, 0.5)
    data = source.descriptor + b"".join(source.packets)
    scans = decoded([(data, T0_NS + 500 * MS)])
    assert len(scans) == 4
    times = np.concatenate([times_ns(scan) for scan in scans])
    np.testing.assert_array_equal(np.diff(times), source.sample_ns)
    assert T0_NS + 300 * MS < times[-1] < T0_NS + 500 * MS


@every_kind
@pytest.mark.parametrize("seed", range(2))
def test_jitter_and_stalls_of_the_host_are_removed_within_three_seconds(kind: AnswerType, seed: int) -> None:
    source = stream(kind, LONG)
    chunks = read_by_a_busy_host(*source.line(), LEAST_DELAY_NS, seed)
    scans = decoded(chunks)
    assert_ascending(scans)
    assert worst_error_ms(scans, source, T0_NS + 3 * SECOND) < 1.0


@pytest.mark.parametrize("factor", [0.985, 1.015])
@pytest.mark.parametrize("kind", [STANDARD, EXPRESS, AnswerType.DENSE_SCAN])
def test_a_sample_duration_that_is_slightly_wrong_is_learnt(kind: AnswerType, factor: float) -> None:
    source = stream(kind, 6.0, round(SAMPLE_NS[kind] * factor))
    scans = decoded(read_by_a_busy_host(*source.line(), LEAST_DELAY_NS, 7))
    assert_ascending(scans)
    assert worst_error_ms(scans, source, T0_NS + 4 * SECOND) < 1.0


@pytest.mark.parametrize("factor", [0.3, 0.9, 1.1, 2.0])
def test_a_sample_duration_that_is_quite_wrong_is_found_out(
    factor: float, caplog: pytest.LogCaptureFixture
) -> None:
    source = stream(EXPRESS, 10.0, round(SAMPLE_NS[EXPRESS] * factor))
    scans = decoded(read_by_a_busy_host(*source.line(), LEAST_DELAY_NS, 11))
    assert_ascending(scans)
    assert worst_error_ms(scans, source, T0_NS + 7 * SECOND) < 1.0
    (warning,) = caplog.messages
    assert f"not {SAMPLE_NS[EXPRESS]}" in warning


ANY_DEVICE = DeviceInfo(0x18, (1, 29), 7, "00" * 16)
OF_ONE_MODE = LidarConf(ConfKey.MODE_SAMPLE_TIME, (508 * 256).to_bytes(4, "little"))


@pytest.mark.parametrize(
    ("kind", "answers"),
    [
        (STANDARD, [SampleRate(508, 254)]),
        (EXPRESS, [SampleRate(1016, 508)]),
        (AnswerType.ULTRA_SCAN, [OF_ONE_MODE]),
        (EXPRESS, [LidarConf(ConfKey.MODE_SAMPLE_TIME, bytes(4)), SampleRate(1016, 508)]),  # 0 is none
        (EXPRESS, [replace(OF_ONE_MODE, data=b"\1\1\0\0"), ANY_DEVICE, SampleRate(1016, 508)]),  # a new one
    ],
)
def test_the_sample_duration_is_what_the_device_says(kind: AnswerType, answers: list[Answer]) -> None:
    source = stream(kind, 0.4)
    data = b"".join(map(encode_answer, answers)) + source.descriptor + b"".join(source.packets)
    (scan, *_) = decoded([(data, T0_NS)])
    np.testing.assert_allclose(np.diff(scan.beam_times), 508e-6, atol=2e-9)


@pytest.mark.parametrize("told", [b"\x01\0\0\0", b"\0\x08\0\0", b"\xff\xff\xff\xff"], ids=bytes.hex)
def test_a_damaged_answer_does_not_set_a_wrong_sample_duration_for_ever(told: bytes) -> None:
    source = stream(EXPRESS, 10.0)
    rplidar = Rplidar(Rplidar.Config())
    rplidar.feed(encode_answer(LidarConf(ConfKey.MODE_SAMPLE_TIME, told)), T0_NS)
    scans = scans_of(rplidar, read_by_a_busy_host(*source.line(), LEAST_DELAY_NS, 13))
    assert_ascending(scans)
    assert worst_error_ms(scans, source, T0_NS + 7 * SECOND) < 1.0


def test_packets_that_are_late_now_and_then_do_not_move_the_times() -> None:
    source = stream(EXPRESS, 5.0)
    packets, on_time_ns = zip(*source.on_time(), strict=True)
    late_ns = np.where(np.arange(len(packets)) % 125 == 60, 40 * MS, 0)  # once a second
    arrivals = np.maximum.accumulate(np.array(on_time_ns) + late_ns)
    scans = decoded(zip(packets, arrivals.tolist(), strict=True))
    assert worst_error_ms(scans, source, T0_NS, delay_ns=0) < 0.01


@every_kind
def test_bytes_that_are_late_for_seconds_do_not_move_the_times(kind: AnswerType) -> None:
    source = stream(kind, 10.0)
    data, arrivals = source.line()
    is_late = (arrivals > T0_NS + 5500 * MS) & (arrivals < T0_NS + 9500 * MS)
    arrivals = np.maximum.accumulate(arrivals + np.where(is_late, 200 * MS, 0))
    scans = decoded(read_by_a_busy_host(data, arrivals, LEAST_DELAY_NS, 11))
    assert worst_error_ms(scans, source, T0_NS + 5 * SECOND) < 1.0


def test_a_pause_of_the_device_is_over_in_some_seconds() -> None:
    source = stream(EXPRESS, 12.0)
    data, arrivals = source.line()
    pause_ns = 1200 * MS
    arrivals[arrivals > T0_NS + 4 * SECOND] += pause_ns
    scans = decoded(read_by_a_busy_host(data, arrivals, LEAST_DELAY_NS, 5))
    assert_ascending(scans)
    assert worst_error_ms(scans, source, T0_NS + 11 * SECOND, pause_ns + LEAST_DELAY_NS) < 1.0


def test_latency_is_taken_off() -> None:
    source = stream(EXPRESS, 1.0)
    late = decoded(source.on_time(), latency_ms=7.5)
    assert len(late) == 9
    for scan in late:
        np.testing.assert_array_equal(errors_ns(scan, source), -7_500_000)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32), st.sampled_from(list(SAMPLE_NS)), st.integers(0, 30))
def test_late_chunks_never_put_beams_out_of_order_or_ahead_of_arrival(
    seed: int, kind: AnswerType, delay_ms: int
) -> None:
    rng = random.Random(seed)
    rplidar = Rplidar(Rplidar.Config())
    arrival_ns = 0
    scans: list[Scan] = []
    for data, stamp_ns in cut(*stream(kind, 0.6).line(), random_sizes(rng, 300)):
        arrival_ns = max(arrival_ns + 100_000, stamp_ns + rng.randint(0, delay_ms) * MS)
        new = scans_of(rplidar, [(data, arrival_ns)])
        assert all(scan.end_stamp_ns <= arrival_ns for scan in new)
        scans += new
    assert len(scans) == 5
    assert_ascending(scans)


# gaps


@every_kind
def test_a_revolution_with_a_gap_is_dropped_and_counted(kind: AnswerType) -> None:
    source = stream(kind, 1.0)
    complete = decoded(source.on_time())
    middle_ns = (complete[2].stamp_ns + complete[2].end_stamp_ns) // 2
    chunks = source.on_time()
    hurt = next(i for i, (_, stamp_ns) in enumerate(chunks) if stamp_ns >= middle_ns)
    chunks[hurt] = (chunks[hurt][0][:3], chunks[hurt][1])
    rplidar = Rplidar(Rplidar.Config())
    scans = scans_of(rplidar, chunks)
    kept = [scan for i, scan in enumerate(complete) if i != 2]
    assert [len(scan.angles) for scan in scans] == [len(scan.angles) for scan in kept]
    for scan, reference in zip(scans, kept, strict=True):
        np.testing.assert_array_equal(scan.ranges, reference.ranges)
        assert scan.stamp_ns == pytest.approx(reference.stamp_ns, abs=1)
    assert rplidar.dropped_scans == 1


@every_kind
@pytest.mark.parametrize("cut_packets", [False, True])
def test_times_are_right_again_within_a_second_after_lost_bytes(kind: AnswerType, cut_packets: bool) -> None:
    source = stream(kind, LONG)
    data, arrivals = source.line()
    from_byte, to_byte = np.searchsorted(arrivals, [T0_NS + 4 * SECOND, T0_NS + 4100 * MS]).tolist()
    if not cut_packets:  # then nothing but the arrivals shows that some are missing
        size = len(source.packets[0])
        from_byte, to_byte = (at - (at - len(source.descriptor)) % size for at in (from_byte, to_byte))
    kept = np.r_[0:from_byte, to_byte : len(data)]
    lossy = bytes(np.frombuffer(data, np.uint8)[kept])
    scans = decoded(read_by_a_busy_host(lossy, arrivals[kept], LEAST_DELAY_NS, 3))
    assert_ascending(scans)
    assert worst_error_ms(scans, source, T0_NS + 5100 * MS) < 1.0


def test_revolutions_with_too_few_samples_are_dropped() -> None:
    rplidar = Rplidar(Rplidar.Config())
    turn = b"".join(encode_standard_node(k * 18 * 64, 4000, 15, k == 0) for k in range(20))
    assert scans_of(rplidar, [(encode_descriptor(STANDARD) + 3 * turn, T0_NS)]) == []
    assert rplidar.dropped_scans == 2


def test_revolutions_that_take_more_than_a_second_are_dropped_and_use_no_memory() -> None:
    rplidar = Rplidar(Rplidar.Config())
    turn = b"".join(encode_standard_node(k * 10, 4000, 15, k == 0) for k in range(2304))
    assert scans_of(rplidar, [(encode_descriptor(STANDARD) + 3 * turn, T0_NS)]) == []
    assert rplidar.dropped_scans == 2


def test_a_new_scan_begins_with_no_part_of_the_old_one() -> None:
    rplidar = Rplidar(Rplidar.Config())
    first = stream(EXPRESS, 0.25).on_time()
    again = [(data, stamp_ns + 400 * MS) for data, stamp_ns in first]
    scans = scans_of(rplidar, [*first, *again])
    assert len(scans) == 2
    assert all(scan.beam_times[-1] < 0.11 for scan in scans)
    assert rplidar.dropped_scans == 0


def test_an_answer_cut_short_does_not_swallow_the_next_one() -> None:
    rplidar = Rplidar(Rplidar.Config())
    answer = encode_answer(LidarConf(ConfKey.MODE_SAMPLE_TIME, bytes(4)))
    rplidar.feed(answer[:-2], T0_NS)
    source = stream(EXPRESS, 0.4)
    (descriptor, begin_ns), *packets = source.on_time()
    pieces = [(descriptor[:1], begin_ns), (descriptor[1:], begin_ns), *packets]  # as it may come
    assert len(scans_of(rplidar, [(data, stamp_ns + 100 * MS) for data, stamp_ns in pieces])) == 3


def test_a_stall_of_the_host_is_not_taken_for_a_stop_of_the_device() -> None:
    rplidar = Rplidar(Rplidar.Config())
    chunks = cut(*stream(EXPRESS, 2.0).line(), repeat(1000))  # some 95 ms each
    assert all(data[0] != 0xA5 for data, _ in chunks[1:])  # as answers begin
    assert len(scans_of(rplidar, chunks)) == 18
    assert rplidar.dropped_scans == 0


@given(st.lists(st.tuples(st.binary(max_size=60), st.integers(0, 100 * MS)), max_size=30))
def test_no_bytes_raise(pieces: list[tuple[bytes, int]]) -> None:
    rplidar = Rplidar(Rplidar.Config(max_range=20))
    now_ns = T0_NS
    opening = [encode_descriptor(kind) for kind in SAMPLE_NS]
    for number, (data, later_ns) in enumerate(pieces):
        now_ns += later_ns
        rplidar.feed(opening[number % len(opening)] + data if number % 7 == 0 else data, now_ns)
    assert rplidar.stats.skipped_bytes <= sum(len(data) + 7 for data, _ in pieces)


# config


@pytest.mark.parametrize(
    "bad",
    [
        {"motor_pwm": 1024},
        {"motor_rpm": 1501},
        {"mode": ""},
        {"latency_ms": -1},
        {"min_range": -1},
        {"max_range": 0},
        {"speed": 3},
    ],
    ids=str,
)
def test_the_config_refuses_what_the_device_cannot_do(bad: dict[str, float]) -> None:
    with pytest.raises(ValidationError, match=next(iter(bad))):
        Rplidar.Config.model_validate(bad)


def test_the_nearest_range_must_be_below_the_farthest() -> None:
    with pytest.raises(ValidationError, match=r"min_range 5\.0 is not below max_range 4\.0"):
        Rplidar.Config(min_range=5.0, max_range=4.0)


def test_by_default_the_device_chooses() -> None:
    config = Rplidar.Config()
    assert (config.mode, config.motor_pwm, config.motor_rpm, config.max_range) == ("auto", 0, 0, 40.0)


def test_the_driver_is_registered() -> None:
    assert isinstance(make_sensor("rplidar", Rplidar.Config()), Rplidar)
