"""RPLIDAR streams of every mode: the SDK's values, any chunking, and where one ends and another begins."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.framing import DecodeStats
from drivers.rplidar_capsules import framed
from drivers.rplidar_decoder import AnswerDecoder
from drivers.rplidar_nodes import encode_standard_node
from drivers.rplidar_protocol import (
    PACKET_BYTES,
    PACKET_SAMPLES,
    Answer,
    AnswerType,
    ConfKey,
    ConfSet,
    DeviceInfo,
    Health,
    HealthStatus,
    LidarConf,
    SampleRate,
    Samples,
    ScanStarted,
    encode_answer,
    encode_descriptor,
)
from tests import vectors
from tests.drivers.rplidar_samples import (
    CAPSULES,
    CHECKED,
    EXPRESS,
    MODES,
    STANDARD,
    Placed,
    capsule,
    cut,
    decoded,
    feed,
    nodes,
    one_by_one,
    packets,
    reference,
    rngs,
    single_bytes,
    standard_nodes,
)

CLEAN = vectors.stems("rplidar_*_clean", "rplidar_*_restart", "rplidar_captured_*", "rplidar_sitl_*")
STREAMS = [*CLEAN, *vectors.stems("rplidar_*_damaged")]
GOOD = Health(HealthStatus.GOOD, 0)


# streams as the vendor's SDK reads them


@pytest.mark.parametrize("stem", CLEAN)
def test_clean_streams_decode_as_in_the_sdk(stem: str) -> None:
    assert nodes(feed([vectors.stream(stem)])) == reference(vectors.load(stem)["nodes"])


@pytest.mark.parametrize("stem", vectors.stems("rplidar_*_clean"))
def test_clean_streams_have_no_gap_and_nothing_bad(stem: str) -> None:
    stats = DecodeStats()
    started, *samples = AnswerDecoder(stats).feed(vectors.stream(stem))
    assert started == ScanStarted(AnswerType(vectors.load(stem)["data_type"]))
    assert not any(event.gap for event in samples if isinstance(event, Samples))
    assert stats == DecodeStats(good=vectors.load(stem)["packets"])


@pytest.mark.parametrize("stem", vectors.stems("rplidar_*_restart"))
def test_where_the_encoder_was_restarted_there_is_a_gap(stem: str) -> None:
    vector = vectors.load(stem)
    placed = [each for each in one_by_one(feed([vectors.stream(stem)])) if isinstance(each, Placed)]
    (after,) = [i for i, each in enumerate(placed) if each.gap]
    group = PACKET_SAMPLES[AnswerType(vector["data_type"])]
    assert after == (vector["restart_packet"] - 1) * group
    assert placed[after].number == vector["restart_packet"] * group


@pytest.mark.parametrize("stem", vectors.stems("rplidar_sitl_a2_stream"))
def test_the_simulated_a2_says_who_it_is(stem: str) -> None:
    assert feed([vectors.stream(stem)])[:3] == [
        DeviceInfo(0x28, (42, 17), 6, "00000000D0273D5BFD7F000000273D5B"),
        GOOD,
        ScanStarted(AnswerType.STANDARD_SCAN),
    ]


# chunks


@pytest.mark.parametrize("stem", STREAMS)
def test_chunks_do_not_matter(stem: str) -> None:
    data = vectors.stream(stem)[:9000]
    whole = decoded([data])
    assert decoded(single_bytes(data)) == whole
    for seed in range(5):
        assert decoded(cut(data, random.Random(seed))) == whole


damage = st.lists(
    st.one_of(
        st.tuples(st.just("flip"), st.integers(0, 7)),
        st.tuples(st.just("drop"), st.integers(1, 30)),
        st.tuples(st.just("insert"), st.binary(min_size=1, max_size=30)),
        st.tuples(
            st.just("insert"), st.sampled_from([*map(encode_descriptor, PACKET_BYTES), encode_answer(GOOD)])
        ),
    ),
    min_size=1,
    max_size=8,
)


def damaged(data: bytes, how: list[tuple[str, int | bytes]], rng: random.Random) -> bytes:
    hurt = bytearray(data)
    for kind, value in how:
        at = rng.randrange(len(hurt))
        if isinstance(value, bytes):
            hurt[at:at] = value
        elif kind == "drop":
            del hurt[at : at + value]
        else:
            hurt[at] ^= 1 << value
    return bytes(hurt)


@pytest.mark.parametrize("scan_type", MODES)
@settings(max_examples=40)
@given(how=damage, rng=rngs)
def test_chunks_do_not_matter_to_random_damage(
    scan_type: AnswerType, how: list[tuple[str, int | bytes]], rng: random.Random
) -> None:
    count = 4 if scan_type in CHECKED else 80
    sent = packets(scan_type, [100 + 500 * i for i in range(count)], random.Random(1))
    data = damaged(encode_descriptor(scan_type) + b"".join(sent), how, rng)
    whole = decoded([data])
    assert decoded(single_bytes(data)) == whole
    assert decoded(cut(data, rng)) == whole


fragments = st.lists(
    st.one_of(
        st.binary(max_size=60),
        st.sampled_from([encode_descriptor(answer_type) for answer_type in PACKET_BYTES]),
        st.binary(max_size=251).map(lambda value: encode_answer(LidarConf(ConfKey.MODE_NAME, value))),
        st.integers(0, 199).map(lambda first: standard_nodes(6, first)),
        st.builds(
            lambda scan_type, start_q6: b"".join(
                packets(scan_type, [start_q6, start_q6 + 600], random.Random(start_q6))
            ),
            st.sampled_from(CHECKED),
            st.integers(0, 23039),
        ),
    ),
    max_size=20,
).map(b"".join)


@given(fragments, rngs)
def test_any_bytes_decode_alike_in_any_chunks(data: bytes, rng: random.Random) -> None:
    whole = decoded([data])
    assert decoded(single_bytes(data)) == whole
    assert decoded(cut(data, rng, 60)) == whole


@pytest.mark.parametrize("scan_type", [None, *MODES])
def test_a_megabyte_of_noise_neither_raises_nor_fills_the_buffer(scan_type: AnswerType | None) -> None:
    rng = random.Random(7)
    stats = DecodeStats()
    decoder = AnswerDecoder(stats)
    if scan_type is not None:
        decoder.feed(encode_descriptor(scan_type))
    noise = 1_000_000
    for _ in range(noise // 10_000):
        decoder.feed(rng.randbytes(10_000))
    # all bytes were taken or skipped but for what a packet in the making may hold
    taken = 0 if scan_type is None else PACKET_BYTES[scan_type] * stats.good
    assert noise - 800 <= stats.skipped_bytes + taken <= noise


# number and end of samples


def test_samples_are_numbered_and_say_where_their_packet_ended() -> None:
    sent = [b"banner\r\n" + EXPRESS, capsule(0, True), capsule(10), capsule(20)]
    single = [event for event in feed(sent) if isinstance(event, Samples)]
    assert [(event.first, event.end) for event in single] == [(0, 15 + 84), (32, 15 + 168)]
    _, together = feed([b"".join(sent)])
    assert isinstance(together, Samples)
    assert (together.first, together.end, together.count) == (0, 15 + 168, 64)
    _, samples = feed([STANDARD + standard_nodes(3) + b"\x3e"])
    assert isinstance(samples, Samples)
    assert (samples.first, samples.end, samples.count) == (0, 7 + 15, 3)


@pytest.mark.parametrize("scan_type", MODES)
def test_numbers_go_on_until_the_next_descriptor(scan_type: AnswerType) -> None:
    sent = b"".join(packets(scan_type, range(100, 4000, 600), random.Random(3)))
    opening = encode_descriptor(scan_type)
    twice = [
        event for event in one_by_one(feed([opening + sent, opening + sent])) if isinstance(event, Placed)
    ]
    numbers = [event.number for event in twice]
    assert numbers == 2 * list(range(len(numbers) // 2))
    assert len(numbers) > PACKET_SAMPLES[scan_type]


# descriptors in a running stream

ANSWERS: list[Answer] = [
    DeviceInfo(0x18, (1, 29), 7, "0123456789ABCDEF" * 2),
    GOOD,
    Health(HealthStatus.ERROR, 300),
    SampleRate(253, 251),
    ConfSet(ConfKey.DESIRED_ROTATION, 0),
    LidarConf(ConfKey.MODE_ANSWER_TYPE, b"\x81"),
    LidarConf(ConfKey.TYPICAL_MODE, b"\3\0"),
    LidarConf(ConfKey.MODE_NAME, b"Standard\0"),
    LidarConf(ConfKey.MODE_NAME, bytes(251)),
]


@pytest.mark.parametrize("kept", range(5))
def test_an_answer_is_recognised_wherever_the_nodes_of_a_scan_were_cut(kept: int) -> None:
    for last in range(200):
        old = standard_nodes(20, last) + standard_nodes(1, last + 20)[:kept]
        answer = ANSWERS[last % len(ANSWERS)]
        assert answer in feed([STANDARD + old + encode_answer(answer) + bytes(20)]), (last, answer)


@pytest.mark.parametrize("kept", range(6))
@pytest.mark.parametrize("scan_type", MODES)
def test_a_new_scan_is_recognised_wherever_the_nodes_of_the_old_one_were_cut(
    scan_type: AnswerType, kept: int
) -> None:
    new = packets(scan_type, range(8000, 10_000, 600), random.Random(5))
    count = len(nodes(feed([encode_descriptor(scan_type), *new])))
    for last in (40, 190, 199):
        old = STANDARD + standard_nodes(40, last - 40) + standard_nodes(1, last)[:kept]
        for chunks in (
            [old + encode_descriptor(scan_type) + b"".join(new)],
            [old, encode_descriptor(scan_type), *new],
        ):
            events = feed(chunks)
            started = events.index(ScanStarted(scan_type), 1)
            assert len(nodes(events[started:])) == count > 0


@pytest.mark.parametrize("scan_type", CHECKED)
@pytest.mark.parametrize("kept", [0, 1, 2, 40, 83, -1])
def test_a_new_scan_is_recognised_wherever_a_packet_of_the_old_one_was_cut(
    scan_type: AnswerType, kept: int
) -> None:
    *old, last = packets(scan_type, [0, 600, 1200, 1800], random.Random(2))
    before = encode_descriptor(scan_type) + b"".join(old)
    events = feed([before + last[:kept] + STANDARD + standard_nodes(200)])
    started = events.index(ScanStarted(AnswerType.STANDARD_SCAN), 1)
    assert nodes(events[:started]) == nodes(feed([before]))
    assert len(nodes(events[started:])) == 200


def test_nodes_that_spell_a_descriptor_are_data_as_long_as_they_continue() -> None:
    turn = [encode_standard_node(23_000 + i, 0xA500, 15, False) for i in range(5)]
    spelt = encode_answer(Health(HealthStatus.WARNING, 3))
    data = b"".join(turn)[:-1] + spelt + b"\0" * 2
    # the last byte of a node, and then: 5A 03 00 00 00, 06 01 03 00 00
    sent = feed([STANDARD + data[:-1] + b"".join(encode_standard_node(400, 9, 1, False) for _ in range(5))])
    assert [type(event) for event in sent] == [ScanStarted, Samples]
    assert len(nodes(sent)) == 5 + 2 + 5


@pytest.mark.parametrize("scan_type", CAPSULES)
@given(
    answer_type=st.sampled_from(list(PACKET_BYTES)),
    place=st.floats(0, 1),
    rng=rngs,
)
def test_a_descriptor_inside_a_good_capsule_is_data(
    scan_type: AnswerType, answer_type: AnswerType, place: float, rng: random.Random
) -> None:
    sent = packets(scan_type, [100, 700, 1300], random.Random(4))
    body = bytearray(sent[1][2:])
    pattern = encode_descriptor(answer_type)
    at = 8 + round(place * (len(body) - 8 - len(pattern)))  # behind the direction
    body[at : at + len(pattern)] = pattern
    sent[1] = framed(bytes(body))
    events = feed(cut(encode_descriptor(scan_type) + b"".join(sent), rng, 40))
    assert {type(event) for event in events} == {ScanStarted, Samples}
    assert len(nodes(events)) == 2 * PACKET_SAMPLES[scan_type]


def test_at_the_place_of_a_packet_a_descriptor_wins_over_a_packet_that_begins_like_it() -> None:
    body = bytearray(EXPRESS[2:] + bytes(77))  # begins at 0x0054 / 64 deg
    for byte in bytes(body):
        body[-1] ^= byte
    body[-1] ^= 0xA5
    alike = framed(bytes(body))
    assert alike.startswith(EXPRESS)
    data = EXPRESS + capsule(350, True) + alike + capsule(10) + capsule(20)
    for chunks in ([data], single_bytes(data)):
        assert [type(event) for event in feed(chunks)].count(ScanStarted) == 2


def test_a_descriptor_is_not_pieced_together_across_skipped_bytes() -> None:
    last = encode_standard_node(40 * 115, 0xA500, 15, False)
    noise = bytes(40)
    data = STANDARD + standard_nodes(40) + last + noise + encode_answer(GOOD)[1:] + noise
    for chunks in ([data], single_bytes(data)):
        assert [type(e) for e in feed(chunks) if not isinstance(e, Samples)] == [ScanStarted]


@pytest.mark.parametrize("scan_type", MODES)
def test_an_answer_ends_a_stream(scan_type: AnswerType) -> None:
    health = Health(HealthStatus.WARNING, 3)
    first, second, *others = packets(scan_type, range(100, 8000, 600), random.Random(6))
    old = encode_descriptor(scan_type) + first + second
    assert feed([old + encode_answer(health) + b"".join(others)])[-1] == health


@pytest.mark.parametrize("scan_type", CHECKED)
def test_what_cannot_begin_a_packet_does_not_delay_an_answer(scan_type: AnswerType) -> None:
    old = packets(scan_type, range(100, 2000, 600), random.Random(6))
    events = feed([encode_descriptor(scan_type) + b"".join(old) + b"\0" + encode_answer(GOOD)])
    assert events[-1] == GOOD
    assert len(events) == 3


def test_a_cut_packet_or_answer_no_longer_delays_the_next_one_once_discarded() -> None:
    decoder = AnswerDecoder(DecodeStats())
    decoder.feed(EXPRESS + capsule(0, True) + capsule(10)[:50])
    decoder.discard()
    assert decoder.feed(encode_answer(GOOD)) == [GOOD]
    decoder.feed(encode_answer(GOOD)[:-1])
    decoder.discard()
    assert decoder.feed(encode_answer(GOOD)) == [GOOD]


@pytest.mark.parametrize("scan_type", MODES)
def test_discard_does_not_end_a_stream_that_goes_on(scan_type: AnswerType) -> None:
    sent = packets(scan_type, range(100, 8000, 600), random.Random(8))
    whole = feed([encode_descriptor(scan_type) + b"".join(sent)])
    half = PACKET_BYTES[scan_type] // 2
    for rest in (sent[4][half:], b""):
        decoder = AnswerDecoder(DecodeStats())
        decoder.feed(encode_descriptor(scan_type) + b"".join(sent[:4]) + sent[4][:half])
        decoder.discard()
        after = decoder.feed(rest + b"".join(sent[5:]))
        assert nodes(after) == nodes(whole)[5 * PACKET_SAMPLES[scan_type] :]
        assert [event.gap for event in after if isinstance(event, Samples)] == [True]


def test_answers_are_found_among_leftovers_and_text() -> None:
    sent: list[Answer] = [GOOD, LidarConf(ConfKey.MODE_NAME, b"Boost\0"), SampleRate(508, 254)]
    data = b"\xa5" + b"\xa5\x5a".join([b"RP LIDAR System.\r\n", *map(encode_answer, sent)]) + b"\xa5\x5a\3"
    assert feed(single_bytes(data)) == sent
