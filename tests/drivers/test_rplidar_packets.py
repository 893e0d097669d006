"""Scan packets of every mode: encoded values come back, refused ones say why."""

import random
import re
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from drivers.framing import DecodeStats
from drivers.rplidar_capsules import encode_dense_capsule, encode_express_capsule, framed, start_word
from drivers.rplidar_decoder import AnswerDecoder
from drivers.rplidar_nodes import TURN_Q6, encode_hq_packet, encode_standard_node
from drivers.rplidar_protocol import PACKET_SAMPLES, AnswerType, Event, Samples, encode_descriptor
from drivers.rplidar_ultra import encode_ultra_capsule, encode_ultra_dense_capsule, ultra_offset_q16
from estimators.messages import FloatArray
from tests import vectors
from tests.drivers.rplidar_samples import CAPSULES, Node, feed, nodes, packets, rngs
from tests.fuzz.well_formed import held_bytes

angles_q6 = st.integers(0, TURN_Q6 - 1)
spans_q6 = st.integers(1, 45 * 64)


def decode(scan_type: AnswerType, *sent: bytes) -> Samples:
    """The samples of packets that come without a gap."""
    _, samples = feed([encode_descriptor(scan_type) + b"".join(sent)])
    assert isinstance(samples, Samples)
    return samples


def each(count: int, values: st.SearchStrategy[int]) -> st.SearchStrategy[list[int]]:
    return st.lists(values, min_size=count, max_size=count)


def heads_deg(start_q6: int, span_q6: int, count: int) -> FloatArray:
    return start_q6 / 64 + np.arange(count, dtype=np.float64) * (span_q6 / 64 / count)


def assert_angles(samples: Samples, expected_deg: FloatArray) -> None:
    error_deg = samples.columns.angle_q14 * 90 / 16384 - expected_deg
    # rounded down: to 1/64 deg, to 90/16384 deg, and every step to 1/65536 deg
    most_deg = 1 / 64 + 90 / 16384 + len(expected_deg) / 65536
    assert np.abs((error_deg + 180) % 360 - 180).max() <= most_deg


# samples with their own direction


@given(angles_q6, st.integers(0, 0xFFFF), st.integers(0, 63), st.booleans())
def test_a_standard_node_round_trips(angle_q6: int, distance_q2: int, quality: int, start: bool) -> None:
    samples = decode(AnswerType.STANDARD_SCAN, encode_standard_node(angle_q6, distance_q2, quality, start))
    assert nodes([samples]) == [(angle_q6 * 256 // 90, distance_q2, quality * 4, int(start))]


def test_a_standard_node_beyond_a_turn_is_none() -> None:
    beyond = (encode_standard_node(TURN_Q6 + i, 4000, 15, False) for i in range(4))
    assert nodes(feed([encode_descriptor(AnswerType.STANDARD_SCAN), *beyond])) == []


@settings(max_examples=30)
@given(
    st.integers(0, 2**64 - 1),
    st.lists(
        st.tuples(st.integers(0, 65535), st.integers(0, 2**32 - 1), st.integers(0, 255), st.integers(0, 1)),
        min_size=96,
        max_size=96,
    ),
)
def test_an_hq_packet_round_trips(device_time: int, sent: list[Node]) -> None:
    angles_q14, distances_q2, qualities, starts = zip(*sent, strict=True)
    packet = encode_hq_packet(device_time, angles_q14, distances_q2, qualities, list(map(bool, starts)))
    assert nodes([decode(AnswerType.HQ_SCAN, packet)]) == sent


# samples between two directions


@given(angles_q6, spans_q6, each(32, st.integers(0, 16383)), each(32, st.integers(0, 63)))
@example(TURN_Q6 - 5, 32, [1000] * 32, [0] * 32)  # a sample is taken at 0
def test_an_express_capsule_round_trips(
    start_q6: int, span_q6: int, distances_mm: list[int], offsets_q3: list[int]
) -> None:
    first = encode_express_capsule(start_q6, True, distances_mm, offsets_q3)
    following = encode_express_capsule((start_q6 + span_q6) % TURN_Q6, False, [0] * 32, [0] * 32)
    samples = decode(AnswerType.EXPRESS_SCAN, first, following)
    assert samples.columns.distance_q2.tolist() == [4 * mm for mm in distances_mm]
    assert samples.columns.quality.tolist() == [188 if mm else 0 for mm in distances_mm]
    heads = heads_deg(start_q6, span_q6, 32)
    assert_angles(samples, heads - np.array(offsets_q3) / 8)
    # a revolution starts with the last direction before 0
    assert samples.starts == [i for i, a in enumerate(heads) if a < 360 <= a + span_q6 / 64 / 32]


@given(angles_q6, spans_q6, each(40, st.integers(0, 65535)))
def test_a_dense_capsule_round_trips(start_q6: int, span_q6: int, distances_mm: list[int]) -> None:
    first = encode_dense_capsule(start_q6, True, distances_mm)
    following = encode_dense_capsule((start_q6 + span_q6) % TURN_Q6, False, [0] * 40)
    samples = decode(AnswerType.DENSE_SCAN, first, following)
    assert samples.columns.distance_q2.tolist() == [4 * mm for mm in distances_mm]
    assert samples.columns.quality.tolist() == [188 if mm else 0 for mm in distances_mm]
    assert_angles(samples, heads_deg(start_q6, span_q6, 40))


def ultra_grid_mm(distance_mm: int) -> int:
    """Step between the distances that an ultra packet can tell around this one."""
    return next(
        step for end, step in ((512, 1), (2048, 2), (4096, 4), (16384, 8), (2**20, 16)) if distance_mm < end
    )


walls = st.integers(300, 20_000).flatmap(lambda mm: each(97, st.integers(mm, mm + 200)))
rooms = each(97, st.one_of(st.just(0), st.integers(1, 28_656)))


@given(angles_q6, spans_q6, walls)
def test_an_ultra_capsule_round_trips_along_a_wall(
    start_q6: int, span_q6: int, distances_mm: list[int]
) -> None:
    samples = ultra(start_q6, span_q6, distances_mm)
    for sent_mm, got_q2 in zip(distances_mm, samples.columns.distance_q2.tolist(), strict=False):
        # the step is that of a neighbour, which may lie beyond the next limit
        assert abs(got_q2 / 4 - sent_mm) <= ultra_grid_mm(sent_mm + 200)
    offsets_deg = ultra_offset_q16(samples.columns.distance_q2 >> 2) / 65536
    assert_angles(samples, heads_deg(start_q6, span_q6, 96) - offsets_deg)
    assert set(samples.columns.quality.tolist()) == {188}


@given(rooms)
def test_an_ultra_capsule_tells_any_distance_or_no_return(distances_mm: list[int]) -> None:
    samples = ultra(0, 2000, distances_mm)
    got_mm = [q2 / 4 for q2 in samples.columns.distance_q2.tolist()]
    for i, (sent, got) in enumerate(zip(distances_mm, got_mm, strict=False)):
        told = distances_mm[i // 3 * 3], distances_mm[i // 3 * 3 + 3]
        base = told[0] if i % 3 == 0 else (told[0] or told[1]) if i % 3 == 1 else told[1]
        grid = ultra_grid_mm(base + 8)
        if sent == 0:
            assert got == 0
        elif i % 3 == 0 or abs(sent - base) <= 509 * ultra_grid_mm(max(0, base - 8)):
            assert abs(got - sent) <= grid
        else:
            assert got == 0 or abs(got - sent) <= grid
    assert samples.columns.quality.tolist() == [188 if mm else 0 for mm in got_mm]


def ultra(start_q6: int, span_q6: int, distances_mm: list[int]) -> Samples:
    *own, following_mm = distances_mm
    first = encode_ultra_capsule(start_q6, True, own, following_mm)
    following = encode_ultra_capsule((start_q6 + span_q6) % TURN_Q6, False, [following_mm] * 96, 0)
    return decode(AnswerType.ULTRA_SCAN, first, following)


@pytest.mark.parametrize("stem", vectors.stems("rplidar_varbitscale"))
def test_ultra_distances_are_rounded_as_by_the_peer(stem: str) -> None:
    rows = vectors.load(stem)["rows"]
    for i in range(0, len(rows), 32):
        part = (rows[i : i + 32] * 32)[:32]
        # first difference 1, second "no return"
        words = np.array([major | 1 << 12 | 0x200 << 22 for major, _, _ in part], "<u4")
        first = framed(start_word(0, True) + words.tobytes())
        following = framed(start_word(1000, False) + words.tobytes())
        threes = decode(AnswerType.ULTRA_SCAN, first, following).columns.distance_q2.reshape(-1, 3) // 4
        assert threes[:, 0].tolist() == [mm for _, mm, _ in part]
        assert [one for one, (_, mm, _) in zip(threes[:, 1], part, strict=True) if mm] == [
            mm + (1 << level) for _, mm, level in part if mm
        ]
        assert not threes[:, 2].any()


def test_ultra_differences_below_zero_are_no_return() -> None:
    assert ultra_threes(100, -101, -100) == [[400, 0, 0]] * 32


def test_both_marks_of_no_return_in_ultra_are_read() -> None:
    assert ultra_threes(2000, -511, 510) != ultra_threes(2000, -512, 511)
    assert [three[1:] for three in ultra_threes(2000, -512, 511)] == [[0, 0]] * 32
    assert [three[1:] for three in ultra_threes(2000, 511, -512)] == [[0, 0]] * 32


def ultra_threes(major: int, difference1: int, difference2: int) -> list[list[int]]:
    """Distances [mm/4] of a packet that has the same word everywhere."""
    word = major | (difference1 & 0x3FF) << 12 | (difference2 & 0x3FF) << 22
    words = np.full(32, word, "<u4").tobytes()
    first, following = framed(start_word(0, True) + words), framed(start_word(1000, False) + words)
    threes: list[list[int]] = (
        decode(AnswerType.ULTRA_SCAN, first, following).columns.distance_q2.reshape(-1, 3).tolist()
    )
    return threes


@pytest.mark.parametrize(
    ("distance_mm", "degrees"), [(0, 7.5), (49, 7.5), (100, -5.9), (170, 0.0), (1000, 6.66), (20_000, 8.0)]
)
def test_ultra_beams_leave_as_the_optics_have_it(distance_mm: int, degrees: float) -> None:
    (offset,) = ultra_offset_q16(np.array([distance_mm])) / 65536
    assert offset == pytest.approx(degrees, abs=0.1)


def test_the_angle_of_a_near_beam_in_ultra_is_cut_not_rounded_down() -> None:
    # k = 98361 // 400 = 245; 9150 - 64 * 245 - 245**3 // 98304 = -6679, of which a turn has 2 pi * 65536
    assert ultra_offset_q16(np.array([100])).tolist() == [int(-6679 * 180 / 3.14159265)]


@given(angles_q6, spans_q6, each(64, st.integers(2047, 65522)), each(64, st.integers(0, 255)))
def test_an_ultra_dense_capsule_round_trips_for_far_targets(
    start_q6: int, span_q6: int, distances_mm: list[int], qualities: list[int]
) -> None:
    samples = ultra_dense(start_q6, span_q6, distances_mm, qualities)
    for sent, got_q2, quality, got_quality in zip(
        distances_mm,
        samples.columns.distance_q2.tolist(),
        qualities,
        samples.columns.quality.tolist(),
        strict=True,
    ):
        scale = 1 if sent <= 8187 else 2 if sent <= 24567 else 3
        assert abs(got_q2 / 4 - sent) <= (2 + scale) / 2
        assert got_quality == quality >> scale << scale
    assert_angles(samples, heads_deg(start_q6, span_q6, 64))


near = st.integers(0, 2046)
near_walls = near.flatmap(lambda mm: each(64, st.integers(max(0, mm - 4), min(2046, mm + 4))))


@given(st.one_of(each(64, near), near_walls), st.booleans())
@example([0, 2] * 32, True)
@example([2, 4, 6, 8] * 16, True)
def test_near_targets_of_ultra_dense_are_smoothed_as_in_the_sdk(
    distances_mm: list[int], in_two_packets: bool
) -> None:
    distances_mm = [mm // 2 * 2 for mm in distances_mm]
    expected: list[int] = []
    before = 0
    for mm in distances_mm * (1 + in_two_packets):
        q2 = 4 * mm
        if before and abs(q2 - before) <= 8:
            q2 = (q2 + before) // 2
        expected.append(q2)
        before = q2
    sent = [
        encode_ultra_dense_capsule(1000 * i, i == 0, distances_mm, [7] * 64, 0)
        for i in range(2 + in_two_packets)
    ]
    for chunks in (sent, [b"".join(sent)]):
        events = feed([encode_descriptor(AnswerType.ULTRA_DENSE_SCAN), *chunks])
        assert [q2 for _, q2, _, _ in nodes(events)] == expected


@pytest.mark.parametrize("scan_type", CAPSULES)
@given(rng=rngs)
def test_when_samples_are_asked_for_does_not_matter(scan_type: AnswerType, rng: random.Random) -> None:
    if scan_type is AnswerType.ULTRA_DENSE_SCAN:  # so near each other that each depends on the one before
        near_mm = [[rng.randint(998, 1002) for _ in range(64)] for _ in range(12)]
        sent = [
            encode_ultra_dense_capsule(1000 * i, False, distances_mm, [7] * 64, 0)
            for i, distances_mm in enumerate(near_mm)
        ]
    else:
        sent = packets(scan_type, range(100, 12_000, 1000), rng, first_flag=False)
    lost = rng.randrange(1, 11)
    sent[lost : lost + rng.choice((0, 0, 8))] = []  # so many that there is a gap
    sent.insert(0, encode_descriptor(scan_type))
    decoder, events = AnswerDecoder(DecodeStats()), list[Event]()
    for packet in sent:
        events += decoder.feed(packet)
        if rng.random() < 0.4:
            nodes([rng.choice(events)])
    for event in rng.sample(events, len(events)):
        nodes([event])
    assert nodes(events) == nodes(feed([b"".join(sent)]))


@pytest.mark.parametrize("scan_type", CAPSULES)
def test_packets_that_nobody_asks_for_do_not_pile_up(scan_type: AnswerType) -> None:
    sent = packets(scan_type, range(0, 1_000_000, 1000), random.Random(0), first_flag=False)
    decoder = AnswerDecoder(DecodeStats())
    last = feed([encode_descriptor(scan_type), *sent])[-1]
    decoder.feed(encode_descriptor(scan_type))
    events = [decoder.feed(packet) for packet in sent][-1]
    assert held_bytes(decoder) < 250_000
    assert nodes(events) == nodes([last])


def test_smoothing_does_not_reach_across_a_gap() -> None:
    def sent(start_q6: int, distance_mm: int) -> bytes:
        return encode_ultra_dense_capsule(start_q6, False, [distance_mm] * 64, [7] * 64, 0)

    # without the third packet the second cannot be decoded either
    lost = [sent(0, 1000), sent(1000, 1002), sent(12_000, 1002), sent(13_000, 1002)]
    cut = [sent(0, 1000), sent(1000, 1002), sent(2000, 1000)[:-9], sent(3000, 1002), sent(4000, 1002)]
    for chunks in (lost, [b"".join(lost)], cut, [b"".join(cut)]):
        first, second = feed([encode_descriptor(AnswerType.ULTRA_DENSE_SCAN), *chunks])[1:]
        assert isinstance(first, Samples)
        assert isinstance(second, Samples)
        assert set(first.columns.distance_q2.tolist()) == {4000}
        assert set(second.columns.distance_q2.tolist()) == {4008}


def ultra_dense(start_q6: int, span_q6: int, distances_mm: list[int], qualities: list[int]) -> Samples:
    first = encode_ultra_dense_capsule(start_q6, True, distances_mm, qualities, 2**32 - 1)
    following = encode_ultra_dense_capsule((start_q6 + span_q6) % TURN_Q6, False, [0] * 64, [0] * 64, 0)
    return decode(AnswerType.ULTRA_DENSE_SCAN, first, following)


# starts of revolutions


@pytest.mark.parametrize("scan_type", CAPSULES)
@given(start_q6=angles_q6, spans=st.lists(spans_q6, min_size=2, max_size=40), in_one_chunk=st.booleans())
@example(start_q6=TURN_Q6 - 7, spans=[7, 7], in_one_chunk=True)
@example(start_q6=TURN_Q6 - 7, spans=[7, 7], in_one_chunk=False)
def test_each_time_the_head_passes_0_there_is_one_start(
    scan_type: AnswerType, start_q6: int, spans: list[int], in_one_chunk: bool
) -> None:
    turned_q6 = np.cumsum([start_q6, *spans])
    assume(turned_q6[-1] % TURN_Q6)  # then it may belong to the last packet, which waits
    sent = packets(scan_type, turned_q6.tolist(), random.Random(0))
    opening = encode_descriptor(scan_type)
    events = feed([opening + b"".join(sent)] if in_one_chunk else [opening, *sent])
    starts = [start for _, _, _, start in nodes(events)]
    group = PACKET_SAMPLES[scan_type]
    assert len(starts) == len(spans) * group
    passed_q6 = np.arange(1, turned_q6[-1] // TURN_Q6 + 1) * TURN_Q6
    numbers = np.flatnonzero(starts)
    assert len(numbers) == len(passed_q6)
    head_q6 = np.interp(numbers, np.arange(len(turned_q6)) * group, turned_q6)
    step_q6 = np.array(spans)[numbers // group] / group
    # it is the last sample before 0; the steps of the wire's arithmetic add up to 0.1 less in a packet
    assert (head_q6 <= passed_q6 + 0.1).all()
    assert (head_q6 + step_q6 >= passed_q6 - 0.1).all()


@pytest.mark.parametrize("scan_type", [AnswerType.ULTRA_SCAN, AnswerType.DENSE_SCAN])
def test_a_packet_that_begins_at_0_has_the_start_when_the_steps_before_fall_short(
    scan_type: AnswerType,
) -> None:
    sent = packets(scan_type, [TURN_Q6 - 7, 0, 700], random.Random(0))
    for chunks in (sent, [b"".join(sent)]):
        starts = [start for _, _, _, start in nodes(feed([encode_descriptor(scan_type), *chunks]))]
        assert [i for i, start in enumerate(starts) if start] == [PACKET_SAMPLES[scan_type]]


# what cannot be told


@pytest.mark.parametrize(
    ("encode", "complaint"),
    [
        (lambda: encode_express_capsule(TURN_Q6, False, [0] * 32, [0] * 32), "start_angle_q6: 23040"),
        (lambda: encode_express_capsule(0, False, [0] * 31, [0] * 32), "distances_mm: 31 values, 32 are"),
        (lambda: encode_express_capsule(0, False, [0x4000] * 32, [0] * 32), "distances_mm: 16384..16384"),
        (
            lambda: encode_express_capsule(0, False, [0] * 32, [64] * 32),
            "offsets_q3: 64..64 is not within 0..63",
        ),
        (lambda: encode_dense_capsule(-1, False, [0] * 40), "start_angle_q6: -1"),
        (lambda: encode_dense_capsule(0, False, [-1] * 40), "distances_mm: -1..-1 is not within 0..65535"),
        (lambda: encode_ultra_capsule(0, False, [28_657] * 96, 0), "distances_mm: 28657..28657"),
        (lambda: encode_ultra_capsule(0, False, [0] * 96, -1), "next_distance_mm: -1..-1"),
        (lambda: encode_ultra_dense_capsule(0, False, [65_523] * 64, [0] * 64, 0), "0..65522"),
        (lambda: encode_ultra_dense_capsule(0, False, [0] * 64, [256] * 64, 0), "qualities: 256..256"),
        (lambda: encode_hq_packet(0, [65_536] * 96, [0] * 96, [0] * 96, [False] * 96), "angles_q14: 65536"),
        (lambda: encode_hq_packet(0, [0] * 96, [0] * 95, [0] * 96, [False] * 96), "distances_q2: 95 values"),
    ],
)
def test_values_that_no_packet_can_tell_are_refused(encode: Callable[[], bytes], complaint: str) -> None:
    with pytest.raises(ValueError, match=re.escape(complaint)):
        encode()
