"""Who speaks is told from bytes: every sensor and MAVLink from their own, nobody from noise."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v10 import common as mavlink1
from pymavlink.dialects.v20 import common as mavlink2

from drivers.recognition import MAVLINK, NMEA, Ear, Heartbeat, find_heartbeat, find_nmea, is_running_scan
from tests.drivers.far_side import GARBAGE, NMEA_TEXT, autopilot, tag
from tests.vectors import stems, stream

FRAME = tag()(b"")


def heartbeat(dialect: object, system: int, component: int, sequence: int) -> bytes:
    packer = dialect.MAVLink(None, srcSystem=system, srcComponent=component)  # type: ignore[attr-defined]
    packer.seq = sequence
    return bytes(dialect.MAVLink_heartbeat_message(2, 12, 81, 0x60000, 4, 3).pack(packer))  # type: ignore[attr-defined]


@pytest.mark.parametrize("dialect", [mavlink1, mavlink2], ids=["MAVLink 1", "MAVLink 2"])
@given(system=st.integers(0, 255), component=st.integers(0, 255), sequence=st.integers(0, 255))
def test_a_heartbeat_names_its_sender(dialect: object, system: int, component: int, sequence: int) -> None:
    beat = heartbeat(dialect, system, component, sequence)
    assert find_heartbeat(b"\xfd\x09" + beat + b"rest") == Heartbeat(system, component)
    for i in range(len(beat)):
        broken = bytearray(beat)
        broken[i] ^= 0x10
        assert find_heartbeat(broken) is None


def test_nmea_sentences_are_found_in_between() -> None:
    assert find_nmea(GARBAGE + NMEA_TEXT + b"$GPGG") == NMEA_TEXT.rstrip()
    assert find_nmea(b"$100, and 5 * 6\r\n") is None


@pytest.mark.parametrize(
    "stem", stems("rplidar_express_clean", "rplidar_standard_clean", "rplidar_*_damaged")
)
def test_the_middle_of_a_scan_is_known_as_one(stem: str) -> None:
    data = stream(stem)
    for start in (200, 701, 1003):
        assert is_running_scan(data[start : start + 1500])


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"U" * 5000,
        b"\x55\x05" * 2000,
        GARBAGE * 30,
        NMEA_TEXT * 50,
        FRAME * 30,
        heartbeat(mavlink2, 1, 1, 0) * 100,
        random.Random(1).randbytes(50_000),
    ],
    ids=["nothing", "one byte", "two bytes", "ramp", "NMEA", "LinkTrack", "MAVLink", "noise"],
)
def test_nothing_else_is_taken_for_a_scan(data: bytes) -> None:
    assert not is_running_scan(data)


def speaker(data: bytes, chunk: int) -> tuple[str | None, str | None]:
    """What is certain on the way, and the verdict at the end."""
    ear = Ear()
    said = [ear.feed(data[i : i + chunk], i) for i in range(0, len(data), chunk)]
    assert ear.data == data
    return next(filter(None, said), None), ear.verdict()


@pytest.mark.parametrize("chunk", [1, 100, 10_000])
def test_a_tag_is_certain_after_a_few_frames_and_likely_after_one(chunk: int) -> None:
    assert speaker(FRAME[50:] + 4 * FRAME, chunk) == ("linktrack", "linktrack")
    assert speaker(FRAME[50:] + FRAME, chunk) == (None, "linktrack")


@pytest.mark.parametrize("chunk", [1, 100, 10_000])
def test_a_good_frame_in_much_else_is_a_chance(chunk: int) -> None:
    assert speaker(FRAME + GARBAGE * 10, chunk) == (None, None)


def test_good_frames_among_more_bad_ones_are_a_chance() -> None:
    bad = b"\x55\x01" + bytes(126)
    assert speaker(10 * (2 * bad + FRAME), 100) == (None, None)


@pytest.mark.parametrize("stem", stems("linktrack_stream_*", "linktrack_sitl_stream"))
def test_every_stream_of_linktrack_is_known(stem: str) -> None:
    assert speaker(stream(stem), 256)[0] == "linktrack"


def test_others_are_known_at_the_end() -> None:
    behaviour = autopilot(9)
    assert speaker(b"".join(behaviour(b"") for _ in range(60)), 7) == (None, MAVLINK)
    assert speaker(NMEA_TEXT[20:] + NMEA_TEXT, 7) == (None, NMEA)


@given(st.binary(max_size=2000), st.integers(1, 300))
def test_noise_is_nobody(data: bytes, chunk: int) -> None:
    assert speaker(data, chunk) == (None, None)


def test_a_second_of_noise_is_nobody() -> None:
    for seed in range(10):
        assert speaker(random.Random(seed).randbytes(92_160), 512) == (None, None)
