"""RPLIDAR requests and answers against the bytes of the vendor's SDK and of peers."""

import random
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.framing import DecodeStats
from drivers.rplidar_decoder import AnswerDecoder
from drivers.rplidar_protocol import (
    PACKET_BYTES,
    PACKET_SAMPLES,
    AccBoardFlag,
    Answer,
    AnswerType,
    Command,
    ConfKey,
    ConfSet,
    DeviceInfo,
    Health,
    HealthStatus,
    LidarConf,
    RequestDecoder,
    SampleRate,
    Samples,
    ScanStarted,
    decode_answer,
    encode_answer,
    encode_conf_request,
    encode_descriptor,
    encode_request,
)
from tests import vectors
from tests.drivers.rplidar_samples import cut, feed, rngs

# requests


@pytest.mark.parametrize("stem", vectors.stems("rplidar_requests"))
def test_requests_are_the_bytes_of_the_sdk(stem: str) -> None:
    for vector in vectors.load(stem)["requests"]:
        payload = bytes.fromhex(vector["payload"])
        packet = encode_request(vector["command"], payload)
        assert packet.hex() == vector["bytes"], vector["name"]
        assert RequestDecoder().feed(packet) == [(vector["command"], payload)]


@pytest.mark.parametrize(
    ("packet", "expected"),
    [
        (encode_request(Command.EXPRESS_SCAN, bytes(5)), "a58205000000000022"),
        (encode_request(Command.EXPRESS_SCAN, b"\3" + bytes(4)), "a58205030000000021"),
        (encode_request(Command.SET_MOTOR_PWM, struct.pack("<H", 660)), "a5f0029402c1"),
        (encode_request(Command.GET_ACC_BOARD_FLAG, bytes(4)), "a5ff04000000005e"),
        (encode_conf_request(ConfKey.TYPICAL_MODE), "a584047c00000059"),
        (encode_conf_request(ConfKey.MODE_SAMPLE_TIME, 3), "a5840671000000030055"),
    ],
)
def test_requests_of_the_document_and_the_sdk(packet: bytes, expected: str) -> None:
    assert packet.hex() == expected


def test_impossible_requests_are_refused() -> None:
    with pytest.raises(ValueError, match="0x25 takes no payload"):
        encode_request(Command.STOP, b"\0")
    with pytest.raises(ValueError, match="256 bytes, at most 255"):
        encode_request(Command.EXPRESS_SCAN, bytes(256))


def test_a_request_with_a_bad_checksum_is_dropped_and_the_next_one_read() -> None:
    decoder = RequestDecoder()
    damaged = bytearray(encode_request(Command.SET_MOTOR_PWM, b"\x94\x02"))
    damaged[3] ^= 1
    assert decoder.feed(bytes(damaged) + encode_request(Command.STOP)) == [(Command.STOP, b"")]
    assert decoder.stats.bad == 1


requests = st.one_of(
    st.tuples(st.integers(0, 0x7F), st.just(b"")),
    st.tuples(st.integers(0x80, 0xFF), st.binary(max_size=255)),
)


@given(st.lists(requests, max_size=8), rngs)
def test_requests_round_trip_in_any_chunks(sent: list[tuple[int, bytes]], rng: random.Random) -> None:
    decoder = RequestDecoder()
    data = b"".join(encode_request(command, payload) for command, payload in sent)
    assert [request for chunk in cut(data, rng, 20) for request in decoder.feed(chunk)] == sent


def test_a_megabyte_of_noise_leaves_the_request_decoder_bounded() -> None:
    rng = random.Random(7)
    decoder = RequestDecoder()
    taken = sum(
        len(encode_request(command, payload))
        for _ in range(100)
        for command, payload in decoder.feed(rng.randbytes(10_000))
    )
    assert 1_000_000 - 300 <= decoder.stats.skipped_bytes + taken <= 1_000_000


# answers


def answer_of(vector: dict[str, Any]) -> Answer:
    decoded = vector["decoded"]
    match vector["name"]:
        case "GET_INFO answer":
            firmware = (decoded["firmware_major"], decoded["firmware_minor"])
            return DeviceInfo(decoded["model"], firmware, decoded["hardware"], decoded["serialnumber"])
        case "GET_HEALTH answer":
            return Health(HealthStatus(decoded["status"]), decoded["error_code"])
        case name:
            assert name == "GET_SAMPLERATE answer"
            return SampleRate(decoded["t_standard_us"], decoded["t_express_us"])


@pytest.mark.parametrize("stem", vectors.stems("rplidar_answers"))
def test_answers_hold_the_values_of_the_peers(stem: str) -> None:
    for vector in vectors.load(stem)["answers"]:
        packet = bytes.fromhex(vector["bytes"])
        assert feed([packet]) == [answer_of(vector)]
        assert encode_answer(answer_of(vector)) == packet


def conf(key: int, value: str) -> LidarConf:
    return LidarConf(key, bytes.fromhex(value))


answers = st.one_of(
    st.builds(
        DeviceInfo,
        st.integers(0, 255),
        st.tuples(st.integers(0, 255), st.integers(0, 255)),
        st.integers(0, 255),
        st.binary(min_size=16, max_size=16).map(lambda b: b.hex().upper()),
    ),
    st.builds(Health, st.sampled_from(HealthStatus), st.integers(0, 0xFFFF)),
    st.builds(SampleRate, st.integers(0, 0xFFFF), st.integers(0, 0xFFFF)),
    st.builds(AccBoardFlag, st.booleans()),
    st.builds(LidarConf, st.integers(0, 2**32 - 1), st.binary(max_size=251)),
    st.builds(ConfSet, st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1)),
)


@given(st.lists(answers, max_size=6), rngs)
def test_answers_round_trip_in_any_chunks(sent: list[Answer], rng: random.Random) -> None:
    assert feed(cut(b"".join(map(encode_answer, sent)), rng, 20)) == sent


@given(st.sampled_from(AnswerType), st.binary(max_size=300))
def test_answers_of_a_wrong_length_are_none(answer_type: AnswerType, data: bytes) -> None:
    answer = decode_answer(answer_type, data)
    if answer_type is AnswerType.LIDAR_CONF:
        assert (answer is None) == (not 4 <= len(data) <= 255)
    elif answer_type in PACKET_SAMPLES or len(data) != PACKET_BYTES[answer_type]:
        assert answer is None


def test_an_impossible_health_is_counted_and_not_given_out() -> None:
    decoder = AnswerDecoder(stats := DecodeStats())
    impossible = bytes.fromhex("a55a0300000006070000")
    good = encode_answer(Health(HealthStatus.GOOD, 0))
    assert decoder.feed(impossible + good) == [Health(HealthStatus.GOOD, 0)]
    assert (stats.bad, stats.good) == (1, 1)


@pytest.mark.parametrize(
    ("answer_type", "packet"),
    [
        (AnswerType.STANDARD_SCAN, "a55a0500004081"),
        (AnswerType.EXPRESS_SCAN, "a55a5400004082"),
        (AnswerType.HQ_SCAN, "a55a0d03004083"),
        (AnswerType.ULTRA_SCAN, "a55a8400004084"),
        (AnswerType.DENSE_SCAN, "a55a5400004085"),
        (AnswerType.ULTRA_DENSE_SCAN, "a55aaa00004086"),
        (AnswerType.INFO, "a55a1400000004"),
        (AnswerType.HEALTH, "a55a0300000006"),
    ],
)
def test_descriptors_of_the_document(answer_type: AnswerType, packet: str) -> None:
    assert encode_descriptor(answer_type).hex() == packet


# configuration


def test_configuration_values_have_their_units() -> None:
    assert conf(ConfKey.DESIRED_ROTATION, "58029402").desired_rotation == (600, 660)
    assert conf(ConfKey.MODE_COUNT, "0500").mode_count == 5
    assert conf(ConfKey.TYPICAL_MODE, "0300").typical_mode == 3
    assert conf(ConfKey.MODE_SAMPLE_TIME, "003f0000").sample_ns == 63_000
    assert conf(ConfKey.MODE_SAMPLE_TIME, "80" + "00" * 3).sample_ns == 500
    assert conf(ConfKey.MODE_MAX_DISTANCE, "80280000").max_distance == 40.5
    assert conf(ConfKey.MODE_ANSWER_TYPE, "85").answer_type is AnswerType.DENSE_SCAN
    assert LidarConf(ConfKey.MODE_NAME, b"DenseBoost\0\xff").mode_name == "DenseBoost"
    assert LidarConf(ConfKey.MODE_NAME, b"Boost").mode_name == "Boost"


PROPERTIES = {
    "desired_rotation": ConfKey.DESIRED_ROTATION,
    "mode_count": ConfKey.MODE_COUNT,
    "typical_mode": ConfKey.TYPICAL_MODE,
    "sample_ns": ConfKey.MODE_SAMPLE_TIME,
    "max_distance": ConfKey.MODE_MAX_DISTANCE,
    "answer_type": ConfKey.MODE_ANSWER_TYPE,
    "mode_name": ConfKey.MODE_NAME,
}


@given(st.sampled_from(list(PROPERTIES.values())), st.binary(max_size=12))
def test_a_configuration_value_of_any_bytes_is_read_by_its_own_property_or_by_none(
    key: ConfKey, value: bytes
) -> None:
    answer = LidarConf(key, value)
    assert {name for name in PROPERTIES if getattr(answer, name) is not None} <= {
        name for name, own in PROPERTIES.items() if own is key
    }


@pytest.mark.parametrize(
    ("key", "value"),
    [
        (ConfKey.DESIRED_ROTATION, "580294"),
        (ConfKey.MODE_COUNT, "05"),
        (ConfKey.MODE_SAMPLE_TIME, "003f00"),
        (ConfKey.MODE_SAMPLE_TIME, "00000000"),
        (ConfKey.MODE_MAX_DISTANCE, "00000000"),
        (ConfKey.MODE_ANSWER_TYPE, ""),
        (ConfKey.MODE_ANSWER_TYPE, "04"),
        (ConfKey.MODE_NAME, "00"),
        (ConfKey.MODE_NAME, "c3a900"),
    ],
)
def test_short_and_impossible_configuration_values_are_none(key: ConfKey, value: str) -> None:
    assert [getattr(conf(key, value), name) for name in PROPERTIES] == [None] * len(PROPERTIES)


def test_a_configuration_value_that_no_descriptor_can_tell_is_refused() -> None:
    with pytest.raises(ValueError, match="252 bytes, at most 251"):
        encode_answer(LidarConf(ConfKey.MODE_NAME, bytes(252)))


# the vendor's SDK in dialogue with a device

SESSIONS = vectors.stems("rplidar_sdk_session_*")


@pytest.mark.parametrize("stem", SESSIONS)
def test_each_exchange_of_the_sdk_has_our_bytes(stem: str) -> None:
    for exchange in vectors.load(stem)["exchanges"]:
        packet = bytes.fromhex(exchange["host"])
        ((command, payload),) = RequestDecoder().feed(packet)
        assert Command(command).name == exchange["command"]
        assert encode_request(command, payload) == packet
        if command == Command.GET_LIDAR_CONF:
            assert encode_conf_request(*conf_arguments(payload)) == packet
        for answer_packet in map(bytes.fromhex, exchange["device"]):
            events = feed([answer_packet])
            if command == Command.RESET:  # a banner
                assert events == []
                continue
            (event,) = events
            assert not isinstance(event, Samples)
            if isinstance(event, ScanStarted):
                assert encode_descriptor(event.scan_type) == answer_packet
            else:
                assert encode_answer(event) == answer_packet


def conf_arguments(payload: bytes) -> tuple[int, int | None]:
    key = int.from_bytes(payload[:4], "little")
    return key, int.from_bytes(payload[4:], "little") if len(payload) > 4 else None


@pytest.mark.parametrize("stem", SESSIONS)
def test_scan_modes_read_as_in_the_sdk(stem: str) -> None:
    vector = vectors.load(stem)
    modes: dict[int, dict[int, LidarConf]] = {}
    for exchange in vector["exchanges"]:
        if exchange["command"] == "GET_LIDAR_CONF":
            ((_, payload),) = RequestDecoder().feed(bytes.fromhex(exchange["host"]))
            key, mode = conf_arguments(payload)
            (answer,) = feed([bytes.fromhex(exchange["device"][0])])
            assert isinstance(answer, LidarConf)
            assert answer.key == key
            if mode is not None:
                modes.setdefault(mode, {})[key] = answer
    told = [
        f" mode {mode} '{of[ConfKey.MODE_NAME].mode_name}'"
        f" us {(of[ConfKey.MODE_SAMPLE_TIME].sample_ns or 0) / 1000:.3f}"
        f" maxd {of[ConfKey.MODE_MAX_DISTANCE].max_distance:.2f}"
        f" ans {of[ConfKey.MODE_ANSWER_TYPE].answer_type:x}"
        for mode, of in sorted(modes.items())
    ]
    assert told == [line for line in vector["sdk_output"] if line.startswith(" mode ")]
    assert told
