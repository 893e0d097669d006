"""LinkTrack byte streams: every good frame comes out once, whatever lies between and however they are cut."""

import dataclasses
import random
from typing import Any

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from drivers.linktrack import LinkTrack
from drivers.linktrack_frames import FRAME_START, encode
from drivers.linktrack_types import (
    AnchorFrame0,
    AnchorRange,
    Frame,
    NodeData,
    NodeFrame0,
    NodeFrame1,
    NodeFrame4,
    NodeFrame6,
    SettingFrame0,
    TagBlock,
    TagPosition,
    TagRanges,
    UserFrame1,
)
from tests.drivers.test_linktrack_frames import (
    FRAMES,
    FRAMES_BY_TYPE,
    KINDS,
    NODE_FRAME2,
    NODE_FRAME3,
    TAG_FRAME0,
    assert_same_values,
    captured,
    with_checksum,
)
from tests.vectors import load, stems, stream

FLUSH = bytes(8000)
"""Resolves what a false start still waits for."""
LONGEST_FRAME = 7422
CHUNK_SIZES = st.lists(st.integers(1, 300), min_size=1, max_size=20)


def new_sensor() -> LinkTrack:
    return LinkTrack(LinkTrack.Config())


def in_chunks(sensor: LinkTrack, data: bytes, sizes: list[int]) -> list[Frame]:
    """Frames of a stream cut into pieces of these sizes, over and over."""
    found: list[Frame] = []
    position = turn = 0
    while position < len(data):
        size = sizes[turn % len(sizes)]
        found += sensor.frames(data[position : position + size])
        position += size
        turn += 1
    return found


def listed(frames: list[Frame], rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows of a listing that the frames are; all but optional ones must be among them, in order."""
    found: list[dict[str, Any]] = []
    for row in rows:
        if len(found) < len(frames) and type(frames[len(found)]) is KINDS[row["type"]]:
            if "decoded" in row:
                assert_same_values(frames[len(found)], row["decoded"])
            found.append(row)
        else:
            assert row.get("optional"), row
    return found


@pytest.mark.parametrize("stem", stems("linktrack_stream_*", "linktrack_sitl_stream"))
@pytest.mark.parametrize("cut", ["whole", "byte by byte", "small", "large"])
def test_exactly_the_listed_frames_come_out_of_a_stream(stem: str, cut: str) -> None:
    data, rows = stream(stem), load(stem)["frames"]
    rng = random.Random(stem)
    sizes = {
        "whole": [len(data)],
        "byte by byte": [1],
        "small": [rng.randint(1, 7) for _ in range(999)],
        "large": [rng.choice([1, 3, 64, 500, 2000]) for _ in range(999)],
    }[cut]
    sensor = new_sensor()
    frames = in_chunks(sensor, data, sizes)
    found = listed(frames, rows)
    assert len(found) == len(frames)
    assert sensor.stats.good == len(frames)
    assert sensor.stats.skipped_bytes == len(data) - sum(row["length"] for row in found)


@pytest.mark.parametrize("stem", stems("linktrack_sitl_stream"))
def test_the_simulators_settings_hold_its_anchors(stem: str) -> None:
    answers = [frame for frame in new_sensor().frames(stream(stem)) if isinstance(frame, SettingFrame0)]
    rows = [row for row in load(stem)["frames"] if row["type"] == "setting_frame0"]
    assert len(answers) == len(rows) > 0
    for answer, row in zip(answers, rows, strict=True):
        assert [list(anchor) for anchor in answer.anchors[:4]] == row["anchors_m_first4"]


@pytest.mark.parametrize("stem", stems("linktrack_rejects"))
def test_rejects_do_not_cost_the_frames_after_them(stem: str) -> None:
    for row in load(stem)["frames"]:
        wire = bytes.fromhex(row["hex"])
        sensor = new_sensor()
        assert sensor.frames(wire + TAG_FRAME0 * 2 + FLUSH) == [captured(TAG_FRAME0)] * 2, row["why"]
        assert sensor.stats.skipped_bytes == len(wire) + len(FLUSH)


@given(FRAMES, CHUNK_SIZES)
@settings(max_examples=50)
def test_a_frame_inside_user_data_is_not_a_frame(inner: Frame, sizes: list[int]) -> None:
    data = NodeData(2, 7, encode(inner))
    carriers: list[Frame] = [
        UserFrame1(5, 0, data.data),
        NodeFrame0(1, 4, (data, data)),
        NodeFrame6(1, 4, (data,)),
    ]
    frames: list[Frame] = [*carriers, captured(NODE_FRAME3)]
    assert in_chunks(new_sensor(), b"".join(map(encode, frames)), sizes) == frames


def test_a_good_frame_may_start_inside_a_bad_one() -> None:
    carrier = bytearray(encode(NodeFrame0(1, 4, (NodeData(2, 7, NODE_FRAME3),))))
    carrier[-1] ^= 1
    assert new_sensor().frames(bytes(carrier)) == [captured(NODE_FRAME3)]


@pytest.mark.parametrize(
    "head",
    [
        b"\x55\x02\xff\xff",  # longer than the cap
        b"\x55\x06\xff\xff",  # longer than the cap of Node_Frame4
        b"\x54\xf1\xff\xff\xff\xff\x05\x00\xff\xff",  # longer than the cap
        b"\x55\x04\xee\x00",  # length that no number of nodes gives
        b"\x55\x04\x00\x10",  # length of more nodes than can be counted
        b"\x55\x04\x85\x00" + bytes(115),  # length of another number of nodes
        b"\x55\x06\x64\x00" + bytes(16) + b"\xc8",  # too short for 200 tags
        b"\x55\x06\x00\x08" + bytes(16) + b"\x01",  # longer than one tag can make it
        b"\x55\x06\x00\x08" + bytes(16) + b"\xc8" + bytes(4) + b"\x11",  # a tag with 17 anchors
        b"\x55\x06\xfe\x1c" + bytes(16) + b"\xc8" + (bytes(4) + b"\x02" + bytes(8)) * 2 + bytes(4) + b"\x20",
        b"\x55\x02\x00\x08" + bytes(6) + b"\x02" + b"\x01\x02\xff\x0f",  # block beyond the end
        b"\x54\xf1\xff\xff\xff\x00",  # no User_Frame1: a constant byte is wrong
        b"\x54\xfa\x21\x00",  # no Error_Frame0: its length is wrong
        b"\x55\x00\x07\x02" + bytes(25) + b"\x08\x07",  # second block is no tag
    ],
)
def test_an_impossible_head_is_refused_with_the_byte_that_shows_it(head: bytes) -> None:
    sensor = new_sensor()
    assert sensor.frames(head[:-1]) == []
    assert sensor.stats.bad == 0
    assert sensor.frames(head[-1:]) == []
    assert sensor.stats.bad == 1
    assert sensor.frames(NODE_FRAME2) == [captured(NODE_FRAME2)]


@pytest.mark.parametrize("mark", [2, 3, 4, 5, 6, 7, 8, 9])
def test_a_length_below_the_fixed_part_is_refused_before_the_count_is_there(mark: int) -> None:
    short = with_checksum(bytearray([0x55, mark, 8, 0, 1, 2, 3, 0]))
    sensor = new_sensor()
    assert sensor.frames(short) == []
    assert (sensor.stats.good, sensor.stats.bad, sensor.stats.skipped_bytes) == (0, 1, 8)


def test_an_unknown_type_is_no_frame() -> None:
    unknown = with_checksum(bytearray(b"\x55\x0b" + bytes(30)))
    sensor = new_sensor()
    assert sensor.frames(unknown + TAG_FRAME0) == [captured(TAG_FRAME0)]
    assert sensor.stats.skipped_bytes == len(unknown)


def test_anchor_frame0_needs_plausible_roles_and_its_tail() -> None:
    tag = TagBlock(2, 3, (1.0, 2.0, 3.0), (4.0,) * 8)
    frame = AnchorFrame0(7, 1, 1000, 2000, 4.9, (tag, tag))
    real = bytearray(encode(frame))
    real[815 : 815 + len(NODE_FRAME3)] = NODE_FRAME3  # reserved bytes may hold anything
    assert new_sensor().frames(bytes(real)) == [frame]
    for offset, wrong in [(2 + 27 + 1, 1), (894, 2), (895, 0xEF)]:  # a tag's role, the sender's, the tail
        imitation = bytearray(real)
        imitation[offset] = wrong
        assert new_sensor().frames(bytes(imitation) + FLUSH) == [captured(NODE_FRAME3)]


def test_the_longest_frames_come_out_in_any_pieces() -> None:
    anchors = tuple(AnchorRange(k, 1.0 + k) for k in range(8))
    frames: list[Frame] = [
        NodeFrame4(9, 3, 0, 0, 5.0, tuple(TagRanges(k, 3.7, anchors) for k in range(200))),
        NodeFrame1(9, 3, 0, 0, 5.0, (TagPosition(2, 1, (1.0, 2.0, 3.0)),) * 255),
        dataclasses.replace(captured(NODE_FRAME2), nodes=captured(NODE_FRAME2).nodes[:1] * 255),
        NodeFrame0(1, 4, (NodeData(2, 7, bytes(4096 - 16)),)),
        UserFrame1(5, 0, bytes(4096 - 11)),
    ]
    data = b"".join(map(encode, frames))
    assert len(data) == LONGEST_FRAME + 5128 + (120 + 13 * 255) + 2 * 4096
    for sizes in ([len(data)], [1000], [1]):
        assert in_chunks(new_sensor(), data, sizes) == frames


HARMLESS = st.lists(st.integers(0, 255).filter(lambda byte: byte not in b"RTU"), max_size=60).map(bytes)
"""Neither "R", "T" nor "U": such bytes cannot start a frame."""


@given(st.lists(st.tuples(FRAMES, HARMLESS), max_size=4), HARMLESS, CHUNK_SIZES)
def test_any_chunking_gives_the_same_and_harmless_garbage_costs_no_frame(
    pairs: list[tuple[Frame, bytes]], first: bytes, sizes: list[int]
) -> None:
    frames = [frame for frame, _ in pairs]
    data = first + b"".join(encode(frame) + garbage for frame, garbage in pairs)
    whole, pieces = new_sensor(), new_sensor()
    assert whole.frames(data) == frames
    assert in_chunks(pieces, data, sizes) == frames
    assert whole.stats == pieces.stats
    assert whole.stats.skipped_bytes == len(first) + sum(len(garbage) for _, garbage in pairs)


SENTENCES = st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), max_size=80).map(
    lambda text: b"$GP" + text.encode() + b"*4B\r\n"
)


@given(st.lists(st.one_of(FRAMES.map(encode), SENTENCES), max_size=8), CHUNK_SIZES)
def test_nmea_sentences_between_frames_are_passed_over(parts: list[bytes], sizes: list[int]) -> None:
    sentences = [part for part in parts if part.startswith(b"$")]
    sensor = new_sensor()
    frames = in_chunks(sensor, b"".join(parts), sizes)
    assert [encode(frame) for frame in frames] == [part for part in parts if part not in sentences]
    assert sensor.stats.bad == 0
    assert sensor.stats.skipped_bytes == sum(map(len, sentences))


TRICKY = st.lists(
    st.one_of(
        st.sampled_from(
            [b"\x55", b"\x54\xf1\xff\xff\xff\xff", b"\x55\x00", b"\x55\x02\x10\x00", b"\x55\x06\x40\x00"]
        ),
        st.binary(max_size=20),
        st.integers(0, 9).map(bytes),
        st.just(NODE_FRAME3),
    ),
    max_size=60,
).map(b"".join)
"""Bytes that favour headers, small lengths and counts, so that false starts get far."""


@given(TRICKY, CHUNK_SIZES)
@settings(max_examples=200)
def test_any_bytes_in_any_chunking_never_raise_and_give_the_same(data: bytes, sizes: list[int]) -> None:
    whole, pieces = new_sensor(), new_sensor()
    assert whole.frames(data) == in_chunks(pieces, data, sizes)
    assert whole.stats == pieces.stats


def test_a_changed_bit_costs_one_frame_at_most() -> None:
    """Every bit of a stream of captured frames, one at a time."""
    wires = [NODE_FRAME3, TAG_FRAME0, NODE_FRAME2, NODE_FRAME3, TAG_FRAME0]
    frames = [captured(wire) for wire in wires]
    owners = [index for index, wire in enumerate(wires) for _ in wire]
    for position, owner in enumerate(owners):
        for bit in range(8):
            data = bytearray(b"".join(wires))
            data[position] ^= 1 << bit
            others = frames[:owner] + frames[owner + 1 :]
            assert new_sensor().frames(bytes(data) + FLUSH) == others, (position, bit)


# Sum, length and counts guard these against every change of one byte.
WELL_GUARDED = st.one_of(
    *[strategy for kind, strategy in FRAMES_BY_TYPE.items() if kind not in (AnchorFrame0, UserFrame1)]
)


def damaged(frame: Frame, first: int, data: st.DataObject) -> bytes:
    """Bytes of a frame, one of them changed from `first` on, in which no other frame seems to start.

    One that does is taken for a frame in one of 256 cases, as no byte of checksum can tell.
    """
    wire = bytearray(encode(frame))
    wire[data.draw(st.integers(first, len(wire) - 1))] ^= data.draw(st.integers(1, 255))
    assume(FRAME_START.search(wire, 1) is None)
    return bytes(wire)


@given(st.lists(FRAMES, max_size=2), WELL_GUARDED, st.lists(FRAMES, max_size=2), st.data())
def test_a_changed_byte_costs_only_its_own_frame(
    before: list[Frame], victim: Frame, after: list[Frame], data: st.DataObject
) -> None:
    parts = [*map(encode, before), damaged(victim, 0, data), *map(encode, after), FLUSH]
    assert new_sensor().frames(b"".join(parts)) == before + after


@given(FRAMES_BY_TYPE[AnchorFrame0], st.data())
def test_a_changed_byte_of_anchor_frame0_does_not_cost_the_next_frame(
    victim: AnchorFrame0, data: st.DataObject
) -> None:
    *false, last = new_sensor().frames(damaged(victim, 2, data) + NODE_FRAME2 + FLUSH)
    assert last == captured(NODE_FRAME2)
    assert all(isinstance(frame, AnchorFrame0) for frame in false)
    assert len(false) <= 1


@pytest.mark.parametrize("wire", [NODE_FRAME2, NODE_FRAME3, TAG_FRAME0], ids=["2", "3", "tag"])
def test_a_frame_that_breaks_off_costs_no_other(wire: bytes) -> None:
    good = [captured(NODE_FRAME2), captured(TAG_FRAME0)]
    for size in range(len(wire)):
        assert new_sensor().frames(wire[:size] + NODE_FRAME2 + TAG_FRAME0 + FLUSH) == good, size


def node_frame4_heads() -> bytes:
    """Starts of Node_Frame4 in which all counts are right, so that each has to be followed to its end."""
    head = b"\x55\x06\x06\x10" + bytes(16) + b"\xff\x00"
    return head * (200_000 // len(head))


@pytest.mark.parametrize(
    "flood",
    [
        b"\x55\x02\xff\xff" * 250_000,
        b"\x55\x02\x00\x10" * 250_000,
        b"\x55\x00" + b"\xff" * 1_000_000,
        b"\x55\x03\x08\x14" + b"\xff" * 1_000_000,  # Node_Frame1 with 255 tags
        b"\x55" * 1_000_000,
        node_frame4_heads(),
        random.Random(0).randbytes(1_000_000),
    ],
    ids=["cap", "long", "anchor", "positions", "header", "counts", "random"],
)
def test_memory_stays_bounded_and_the_next_frame_is_found(flood: bytes) -> None:
    sensor = new_sensor()
    for start in range(0, len(flood), 1000):
        sensor.frames(flood[start : start + 1000])
        assert len(sensor._buffer) < LONGEST_FRAME + 1000
    frames = sensor.frames(TAG_FRAME0 * 100)
    assert frames[-40:] == [captured(TAG_FRAME0)] * 40
