"""Damaged RPLIDAR streams: no false sample, little lost, every gap told."""

import difflib
import random
from collections.abc import Sequence
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.rplidar_protocol import PACKET_SAMPLES, AnswerType, Samples, encode_descriptor
from tests import vectors
from tests.drivers.rplidar_samples import (
    CAPSULES,
    CHECKED,
    STANDARD,
    Node,
    Placed,
    cut,
    feed,
    nodes,
    one_by_one,
    packets,
    reference,
    rngs,
    standard_nodes,
)

CAPSULE_VECTORS = vectors.stems(
    "rplidar_*express_damaged", "rplidar_*ultra*_damaged", "rplidar_*dense_damaged"
)
NODE_VECTORS = vectors.stems("rplidar_standard*_damaged")

STEP_Q6 = {
    AnswerType.EXPRESS_SCAN: 60 * 64,
    AnswerType.ULTRA_SCAN: 75 * 64,
    AnswerType.DENSE_SCAN: 40 * 64,
    AnswerType.ULTRA_DENSE_SCAN: 30 * 64,
    AnswerType.HQ_SCAN: 30 * 64,
}
"""From packet to packet; twice as much is more than any device turns in one."""
PACKETS = 9


# damage as other people's programs see it


@pytest.mark.parametrize("stem", CAPSULE_VECTORS)
def test_damaged_capsules_give_more_than_in_the_sdk_and_no_wrong_point(stem: str) -> None:
    vector = vectors.load(stem)
    clean = reference(vector["clean_nodes"])
    allowed = [node for first, end, _ in vector["allowed_ranges"] for node in clean[first:end]]
    due = sum(end - first for first, end, is_due in vector["allowed_ranges"] if is_due)
    got = nodes(feed([vectors.stream(stem)]))
    remaining = iter(allowed)
    assert all(node in remaining for node in got)  # in this order
    assert len(got) >= vector["baseline"]["sdk_emitted"]
    assert len(got) >= 0.95 * due


@pytest.mark.parametrize("stem", NODE_VECTORS)
def test_damaged_nodes_are_no_worse_than_with_the_better_peer_in_either_count(stem: str) -> None:
    vector = vectors.load(stem)
    baseline = vector["baseline"]
    _, peer_right, peer_wrong = next(value for name, value in baseline.items() if name.startswith("lds2d"))
    got = nodes(feed([vectors.stream(stem)]))
    right = matched(got, reference(vector["clean_nodes"]))
    assert right >= max(peer_right, baseline["sdk_emitted_equal_to_clean_in_order"])
    # half of what the better peer gets wrong; more is a regression
    assert len(got) - right <= min(peer_wrong, baseline["sdk_bogus"]) / 2


def matched(got: list[Node], expected: list[Node]) -> int:
    matcher = difflib.SequenceMatcher(None, got, expected, autojunk=False)
    return sum(block.size for block in matcher.get_matching_blocks())


# damage packet by packet


def scan(scan_type: AnswerType, seed: int) -> list[bytes]:
    return packets(scan_type, [100 + i * STEP_Q6[scan_type] for i in range(PACKETS)], random.Random(seed))


def groups(scan_type: AnswerType, chunks: Sequence[bytes]) -> tuple[list[tuple[Node, ...]], list[int]]:
    """Samples packet by packet, and which packets come after a gap."""
    placed = [
        each for each in one_by_one(feed([encode_descriptor(scan_type), *chunks])) if isinstance(each, Placed)
    ]
    size = PACKET_SAMPLES[scan_type]
    parts = [placed[i : i + size] for i in range(0, len(placed), size)]
    for part in parts:
        assert len(part) == size
        assert [b.number - a.number for a, b in pairwise(part)] == [1] * (size - 1)
    return [tuple(each.node for each in part) for part in parts], [
        i for i, part in enumerate(parts) if part[0].gap
    ]


@pytest.mark.parametrize("scan_type", CHECKED)
@given(
    hurt=st.integers(0, PACKETS - 1),
    place=st.floats(0, 1, exclude_max=True),
    flipped=st.integers(1, 255),
    rng=rngs,
)
def test_a_wrong_byte_costs_what_its_packet_is_needed_for(
    scan_type: AnswerType, hurt: int, place: float, flipped: int, rng: random.Random
) -> None:
    sent = scan(scan_type, 9)
    clean, _ = groups(scan_type, sent)
    damaged = bytearray(sent[hurt])
    damaged[int(place * len(damaged))] ^= flipped
    sent[hurt] = bytes(damaged)
    got, gaps = groups(scan_type, cut(b"".join(sent), rng))
    lost = {hurt} if scan_type is AnswerType.HQ_SCAN else {hurt - 1, hurt}
    # What is left of a packet can look like one by chance, once in some thousand times; it costs another.
    assert is_between(
        [i for i in range(len(clean)) if i not in lost], clean, got, spare=range(hurt, hurt + 3)
    )
    before = len([i for i in range(len(clean)) if i < min(lost)])
    assert gaps == ([before] if before < len(got) else [])


@pytest.mark.parametrize("scan_type", CHECKED)
@given(
    hurt=st.integers(1, PACKETS - 1),
    place=st.floats(0, 1, exclude_max=True),
    dropped=st.integers(0, 100),
    noise=st.binary(max_size=60),
    rng=rngs,
)
def test_lost_and_foreign_bytes_give_no_false_sample_and_later_packets_are_decoded(
    scan_type: AnswerType, hurt: int, place: float, dropped: int, noise: bytes, rng: random.Random
) -> None:
    sent = scan(scan_type, 10)
    clean, _ = groups(scan_type, sent)
    data = b"".join(sent)
    at = hurt * len(sent[0]) + int(place * len(sent[0]))
    got, gaps = groups(scan_type, cut(data[:at] + noise + data[at + dropped :], rng))
    assert is_between(range(len(clean)), clean, got, spare=range(hurt - 1, hurt + 5))
    assert len(gaps) <= 1


def is_between(
    wanted: Sequence[int], clean: list[tuple[Node, ...]], got: list[tuple[Node, ...]], spare: range
) -> bool:
    """Whether the packets are the wanted ones in their order, but for some of the spare ones."""
    found = [clean.index(each) if each in clean else -1 for each in got]
    needed = [i for i in wanted if i not in spare]
    return found == sorted(set(found)) and set(found) <= set(wanted) and set(needed) <= set(found)


@pytest.mark.parametrize("scan_type", CAPSULES)
def test_a_packet_lost_whole_or_repeated_is_a_gap(scan_type: AnswerType) -> None:
    sent = scan(scan_type, 11)
    clean, gaps = groups(scan_type, sent)
    assert gaps == []
    for chunks in (sent[:4] + sent[5:], [b"".join(sent[:4] + sent[5:])]):
        assert groups(scan_type, chunks) == (clean[:3] + clean[5:], [3])
    for chunks in (sent[:5] + sent[4:], [b"".join(sent[:5] + sent[4:])]):
        assert groups(scan_type, chunks) == (clean, [4])


@pytest.mark.parametrize("scan_type", CAPSULES)
def test_a_restarted_encoder_is_a_gap(scan_type: AnswerType) -> None:
    step = STEP_Q6[scan_type]
    rng = random.Random(12)
    sent = packets(scan_type, [0, step, 2 * step], rng) + packets(scan_type, [3 * step, 4 * step], rng)
    got, gaps = groups(scan_type, sent)
    assert (len(got), gaps) == (3, [2])


@pytest.mark.parametrize(
    ("scan_type", "sample_us"),
    [
        (AnswerType.EXPRESS_SCAN, 254),
        (AnswerType.ULTRA_SCAN, 201),
        (AnswerType.DENSE_SCAN, 200),
        (AnswerType.ULTRA_DENSE_SCAN, 62.5),
    ],
)
def test_packets_are_paired_up_to_the_fastest_rotation_of_the_slowest_device(
    scan_type: AnswerType, sample_us: float
) -> None:
    turned_q6 = round(PACKET_SAMPLES[scan_type] * sample_us * 15 * 360e-6 * 64)
    assert len(groups(scan_type, packets(scan_type, [0, turned_q6], random.Random(0)))[0]) == 1
    for too_far_q6 in (140 * 64, 180 * 64, -64):
        assert groups(scan_type, packets(scan_type, [100, 100 + too_far_q6], random.Random(0)))[0] == []


@pytest.mark.parametrize("scan_type", CAPSULES)
def test_a_direction_beyond_a_turn_is_not_used(scan_type: AnswerType) -> None:
    at = 8 if scan_type is AnswerType.ULTRA_DENSE_SCAN else 2
    for hurt in (0, 2, 8):
        sent = scan(scan_type, 13)
        clean, _ = groups(scan_type, sent)
        damaged = bytearray(sent[hurt])
        checksum = damaged[at + 1] ^ 0x7F
        damaged[at + 1] = 0x7F  # 127 * 256 / 64 deg and more
        damaged[0] ^= checksum & 15
        damaged[1] ^= checksum >> 4
        sent[hurt] = bytes(damaged)
        got, _ = groups(scan_type, sent)
        assert got == [part for i, part in enumerate(clean) if i not in (hurt - 1, hurt)]


def test_nodes_cut_anywhere_go_on_after_a_gap() -> None:
    clean = nodes(feed([STANDARD + standard_nodes(60)]))
    for at in range(100, 110):
        for dropped in range(1, 30):
            data = standard_nodes(60)
            events = feed([STANDARD, data[:at] + data[at + dropped :]])
            samples = [event for event in events if isinstance(event, Samples)]
            got = nodes(samples)
            right = matched(got, clean)
            assert right >= 60 - dropped // 5 - 3
            assert len(got) - right <= 2
            assert [event.gap for event in samples] in ([False], [False, True])
