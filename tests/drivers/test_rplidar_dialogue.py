"""The talk with an RPLIDAR of each generation, and with all that can be wrong at the end of the line."""

import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.rplidar import Rplidar
from drivers.rplidar_nodes import encode_standard_node
from drivers.rplidar_protocol import (
    AccBoardFlag,
    AnswerType,
    Command,
    ConfKey,
    DeviceInfo,
    Health,
    HealthStatus,
    encode_answer,
)
from estimators.messages import Scan
from tests import vectors
from tests.drivers.rplidar_fake import (
    BANNER,
    DENSE,
    EXPRESS,
    FLAG,
    GOOD,
    HEALTH,
    INFO,
    MOTORS,
    RATE,
    RESET,
    ROTATION,
    SCAN,
    STANDARD,
    STOP,
    TYPICAL,
    ULTRA,
    FakeDevice,
    Line,
    a1,
    a2m8,
    a2m12,
    a3,
    c1,
    conf_answer,
    express,
    kind_of,
    name_of,
    pwm,
    rpm,
    s1,
    time_of,
)
from tests.drivers.rplidar_streams import MS, SECOND, T0_NS, stream

Make = Callable[[], FakeDevice]
a1_of_2018, a1_of_2016 = partial(a1, (1, 20)), partial(a1, (1, 16))

ASK = [STOP, INFO, HEALTH]


def asked_of(mode: int) -> list[bytes]:
    return [kind_of(mode), name_of(mode), time_of(mode)]


def motor_commands(device: FakeDevice) -> list[bytes]:
    return [request for request in device.heard if request[1] in MOTORS.values()]


def busiest_second(device: FakeDevice) -> int:
    """Most requests in any second."""
    times = np.array([now_ns for now_ns, _ in device.log])
    return int(max(((times >= t) & (times < t + SECOND)).sum() for t in times))


# each generation


@pytest.mark.parametrize(
    ("make", "expected", "mode", "off"),
    [
        (a1, [TYPICAL, *asked_of(3), express(3)], "Sensitivity", b""),
        (a1_of_2018, [RATE, express(0)], "express", b""),
        (a1_of_2016, [express(0)], "express", b""),
        (a2m8, [RATE, FLAG, pwm(660), express(0)], "express", pwm(0)),
        (a3, [TYPICAL, *asked_of(3), FLAG, ROTATION, pwm(660), express(3)], "Sensitivity", pwm(0)),
        (c1, [TYPICAL, *asked_of(1), FLAG, express(1)], "DenseBoost", b""),
        (s1, [TYPICAL, *asked_of(1), ROTATION, rpm(600), express(1)], "DenseBoost", rpm(0)),
    ],
    ids=["A1 1.29", "A1 1.20", "A1 1.16", "A2 1.20", "A3", "C1", "S1"],
)
def test_each_generation_is_asked_made_to_turn_and_to_scan_in_its_best_mode(
    make: Make, expected: list[bytes], mode: str, off: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    line = Line(make())
    scans = line.run(1.0)
    assert line.device.heard == [*ASK, *expected]
    assert line.rplidar.mode == mode
    assert line.rplidar.info is not None
    assert encode_answer(line.rplidar.info) == line.device.answers[INFO]
    assert line.rplidar.health == GOOD
    assert line.rplidar.closing() == [STOP, *([off] if off else [])]
    assert len(scans) > 6
    source = line.device.scans[line.device.heard[-1]]
    # the oldest firmware does not say how long a sample takes, and is off by 1.6 % from what is assumed
    np.testing.assert_allclose(np.median(np.diff(scans[-1].beam_times)), source.sample_ns * 1e-9, rtol=0.02)
    assert not caplog.messages


@pytest.mark.parametrize("stem", vectors.stems("rplidar_sdk_session_A2"))
def test_the_device_of_the_sdk_s_session_scans_as_with_the_sdk(stem: str) -> None:
    exchanges = vectors.load(stem)["exchanges"]
    said = {bytes.fromhex(exchange["host"]): exchange["device"] for exchange in exchanges}
    line = Line(a2m12(stem))
    scans = line.run(1.0)
    heard = line.device.heard
    assert heard == [*ASK, TYPICAL, *asked_of(3), FLAG, ROTATION, pwm(660), express(3)]
    assert set(heard) <= set(said)
    assert said[express(3)] == [line.device.scans[express(3)].descriptor.hex()]
    assert line.rplidar.mode == "Sensitivity"
    assert line.rplidar.info == DeviceInfo(0x2C, (1, 32), 6, "000102030405060708090A0B0C0D0E0F")
    assert line.rplidar.closing() == [STOP, pwm(0)]
    assert len(scans) > 6
    np.testing.assert_allclose(np.median(np.diff(scans[-1].beam_times)), 63e-6, rtol=0.001)


@pytest.mark.parametrize(("make", "motor"), [(a3, pwm(660)), (s1, rpm(600))], ids=["A3", "S1"])
def test_there_is_a_pause_after_stop_and_after_a_motor_command(make: Make, motor: bytes) -> None:
    device = make()
    Line(device).run(1.0, step_ns=MS)
    assert device.when(INFO)[0] - device.when(STOP)[0] >= 100 * MS
    assert device.when(device.heard[-1])[0] - device.when(motor)[0] >= 10 * MS


def test_nothing_is_said_without_a_port() -> None:
    rplidar = Rplidar(Rplidar.Config())
    assert rplidar.poll(T0_NS) == b""
    assert rplidar.closing() == [STOP]


# motor


@pytest.mark.parametrize(
    ("make", "wish", "config", "expected"),
    [
        (a3, (600, 700), {}, pwm(700)),
        (a3, (600, 700), {"motor_pwm": 500}, pwm(500)),
        (a3, (600, 700), {"motor_rpm": 500}, pwm(700)),
        (s1, (720, 0), {}, rpm(720)),
        (s1, (720, 0), {"motor_rpm": 500}, rpm(500)),
        (s1, (720, 0), {"motor_pwm": 500}, rpm(720)),
        (a3, (0, 0), {}, pwm(660)),
        (s1, (0, 0), {}, rpm(600)),
    ],
)
def test_the_motor_turns_as_set_or_else_as_the_device_wishes(
    make: Make, wish: tuple[int, int], config: dict[str, int], expected: bytes
) -> None:
    device = make()
    device.answers[ROTATION] = conf_answer(ConfKey.DESIRED_ROTATION, "<HH", *wish)
    Line(device, **config).run(0.5)
    assert motor_commands(device) == [expected]


@pytest.mark.parametrize("bit", range(32))
def test_a_wish_with_a_wrong_bit_never_turns_the_motor_too_slowly_or_too_fast(bit: int) -> None:
    (damaged,) = struct.unpack("<I", struct.pack("<HH", 600, 660))
    for make, sent_by in ((a3, pwm), (s1, rpm)):
        device = make()
        device.answers[ROTATION] = conf_answer(ConfKey.DESIRED_ROTATION, "<I", damaged ^ 1 << bit)
        Line(device).run(0.3)
        (sent,) = motor_commands(device)
        assert sent in [sent_by(speed) for speed in range(300, 1024)]


@pytest.mark.parametrize(("make", "expected"), [(a3, pwm(660)), (s1, rpm(600))], ids=["A3", "S1"])
def test_a_motor_whose_wish_is_unknown_turns_as_usual(make: Make, expected: bytes) -> None:
    device = make()
    del device.answers[ROTATION]
    Line(device).run(1.2)
    assert motor_commands(device) == [expected]


def test_the_motor_is_left_alone_without_an_accessory_board() -> None:
    device = a2m8()
    device.answers[FLAG] = encode_answer(AccBoardFlag(False))
    line = Line(device)
    line.run(0.5)
    assert device.heard == [*ASK, RATE, FLAG, express(0)]
    assert line.rplidar.closing() == [STOP]


# modes


@pytest.mark.parametrize(
    ("make", "wanted", "name", "request_"),
    [
        (a1, "boost", "Boost", express(2)),
        (a1, "STABILITY", "Stability", express(4)),
        (a1, "Standard", "Standard", SCAN),
        (a1, "AUTO", "Sensitivity", express(3)),
        (a1_of_2018, "Standard", "standard", SCAN),
        (a1_of_2018, "EXPRESS", "express", express(0)),
        (a1_of_2018, "Auto", "express", express(0)),
    ],
)
def test_a_mode_is_asked_for_by_its_name_in_any_case(
    make: Make, wanted: str, name: str, request_: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    line = Line(make(), mode=wanted)
    assert len(line.run(1.0)) > 5
    assert line.device.heard[-1] == request_
    assert line.rplidar.mode == name
    assert not caplog.messages


@pytest.mark.parametrize(
    ("make", "names", "mode"),
    [
        (a1, "Standard, Express, Boost, Sensitivity, Stability", "Sensitivity"),
        (s1, "Standard, DenseBoost", "DenseBoost"),
        (a1_of_2018, "standard, express", "express"),
    ],
    ids=["A1", "S1", "A1 1.20"],
)
def test_for_a_mode_that_the_device_lacks_it_chooses_itself_and_a_warning_names_those_it_has(
    make: Make, names: str, mode: str, caplog: pytest.LogCaptureFixture
) -> None:
    line = Line(make(), mode="UltraBoost")
    assert len(line.run(1.0)) > 5
    assert line.rplidar.mode == mode
    (warning,) = caplog.messages
    assert "'UltraBoost'" in warning
    assert f"it has {names};" in warning


@pytest.mark.parametrize("wanted", ["auto", "boost"])
def test_a_device_that_answers_no_conf_still_scans(wanted: str, caplog: pytest.LogCaptureFixture) -> None:
    device = a3()
    device.answers = {
        request: answer for request, answer in device.answers.items() if request[1] != Command.GET_LIDAR_CONF
    }
    line = Line(device, mode=wanted)
    assert len(line.run(4.0)) > 5
    assert device.heard[-2:] == [pwm(660), SCAN]
    assert line.rplidar.mode == "standard"
    assert caplog.messages[-1] == "RPLIDAR gets no better mode than the standard scan"


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        (TYPICAL, conf_answer(ConfKey.TYPICAL_MODE, "<H", 7)),  # no such mode: its questions are not answered
        (TYPICAL, conf_answer(ConfKey.TYPICAL_MODE, "<H", 259)),  # no room for it in the request to scan
        (kind_of(3), conf_answer(ConfKey.MODE_ANSWER_TYPE, "<B", 0x87)),  # packets that nobody knows
        (kind_of(3), b""),
    ],
)
def test_without_a_best_mode_that_can_be_read_the_scan_is_standard(request_: bytes, answer: bytes) -> None:
    device = a1()
    device.answers[kind_of(259)] = device.answers[kind_of(3)]
    device.answers[request_] = answer
    line = Line(device)
    (*_, scan) = line.run(2.5)
    assert device.heard[-1] == SCAN
    assert line.rplidar.mode == "standard"
    np.testing.assert_allclose(np.median(np.diff(scan.beam_times)), 508e-6, rtol=0.001)


def test_a_mode_that_gives_no_samples_twice_makes_place_for_the_standard_scan_for_good(
    caplog: pytest.LogCaptureFixture,
) -> None:
    device = a1()
    device.scans[express(3)] = stream(ULTRA, 0.0)  # a descriptor, and nothing after it
    line = Line(device)
    assert len(line.run(12.0)) > 5
    assert [request for request in device.heard if request in device.scans] == [express(3), express(3), SCAN]
    assert line.rplidar.mode == "standard"
    assert [message.split(";")[0] for message in caplog.messages] == [
        "RPLIDAR gives no scan in mode Sensitivity",
        "RPLIDAR gets no better mode than the standard scan",
    ]
    device.stall()
    assert len(line.run(3.0)) > 5
    assert device.heard.count(express(3)) == 2
    assert RESET not in device.heard
    line.rplidar.connected(line.now_ns)
    line.run(1.0)
    assert device.heard[-1] == express(3)


def test_a_mode_that_was_asked_for_and_gives_no_samples_makes_place_as_well() -> None:
    device = a1()
    del device.scans[express(2)]
    line = Line(device, mode="boost")
    assert len(line.run(5.0)) > 5
    assert device.heard.count(express(2)) == 2
    assert line.rplidar.mode == "standard"


def test_a_device_that_scans_in_no_mode_is_reset() -> None:
    device = a1()
    device.scans.clear()
    Line(device).run(8.5)
    tried = [request for request in device.heard if request in (SCAN, express(3), RESET)]
    assert tried == [express(3), express(3), SCAN, SCAN, RESET, express(3)]


# health


def test_a_device_that_stopped_itself_is_reset_and_asked_again(caplog: pytest.LogCaptureFixture) -> None:
    device = a1()
    device.answers[HEALTH] = encode_answer(Health(HealthStatus.ERROR, 0x8001))
    device.after_reset = {HEALTH: encode_answer(GOOD)}
    scans = Line(device).run(3.0)
    assert device.heard == [*ASK, RESET, *ASK, TYPICAL, *asked_of(3), express(3)]
    assert device.when(STOP)[1] - device.when(RESET)[0] >= 1000 * MS
    assert len(scans) > 5
    (warning,) = caplog.messages
    assert "0x8001" in warning


def test_a_device_that_stays_in_error_is_reset_for_ever_and_warned_of_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    device = a1()
    device.answers[HEALTH] = encode_answer(Health(HealthStatus.ERROR, 1))
    line = Line(device)
    line.run(10.0)
    assert device.heard[:28] == [*ASK, RESET] * 7
    assert len(caplog.messages) == 1
    device.lost = [INFO]
    line.run(10.0)
    assert len(caplog.messages) == 2  # silence is news once, the error after it is none


def test_a_warning_does_not_stop_the_dialogue() -> None:
    device = a1()
    warning = Health(HealthStatus.WARNING, 3)
    device.answers[HEALTH] = encode_answer(warning)
    line = Line(device)
    assert len(line.run(1.0)) > 5
    assert RESET not in device.heard
    assert line.rplidar.health == warning


# silence and noise


@pytest.mark.parametrize("deaf_to", [INFO, HEALTH], ids=["info", "health"])
def test_a_silent_device_is_asked_slowly_for_ever_and_reset_every_third_time(
    deaf_to: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    device = a1()
    answer = device.answers.pop(deaf_to)
    line = Line(device)
    line.run(60.0)
    round_ = ASK[: ASK.index(deaf_to) + 1]
    cycle = [*round_ * 3, RESET]
    assert device.heard[: 10 * len(cycle)] == cycle * 10
    assert busiest_second(device) <= 4
    (warning,) = caplog.messages
    assert "baud rate" in warning
    device.answers[deaf_to] = answer
    assert len(line.run(5.0)) > 5


def test_another_device_s_bytes_are_answered_with_few_requests_and_a_hint(
    caplog: pytest.LogCaptureFixture,
) -> None:
    frames = vectors.stream("linktrack_stream_tag") * 4
    chunks = [frames[i : i + 60] for i in range(0, len(frames), 60)]
    rplidar, device = Rplidar(Rplidar.Config()), FakeDevice({}, {})
    rplidar.connected(0)
    for now_ns, data in zip(range(0, 10 * SECOND, 5 * MS), chunks, strict=False):
        device.exchange(rplidar.poll(now_ns), now_ns)
        assert rplidar.feed(data, now_ns) == []
    assert rplidar.info is None
    assert len(device.heard) > 10
    assert busiest_second(device) <= 5
    (warning,) = caplog.messages
    assert "other device, other baud rate" in warning


def test_a_line_that_is_never_quiet_does_not_keep_a_device_from_being_asked() -> None:
    device = a1()
    device.answers[STOP] = bytes(20)
    device.fault = lambda request, answer: (answer, 90 if request == STOP else 0)  # when it should be quiet
    assert len(Line(device).run(1.5)) > 5


@pytest.mark.parametrize(
    "kind", [STANDARD, EXPRESS, ULTRA, DENSE, AnswerType.ULTRA_DENSE_SCAN, AnswerType.HQ_SCAN]
)
@pytest.mark.parametrize("cut_ms", [0, 7, 14, 21])
def test_a_scan_left_running_is_stopped_though_stop_gets_lost_at_first_and_cuts_a_packet(
    kind: AnswerType, cut_ms: int
) -> None:
    device = s1()
    device.turns = True
    line = Line(device)
    device.scan_from(stream(kind, 1.0), line.now_ns - (200 + cut_ms) * MS)
    device.lost = [STOP]
    scans = line.run(1.0)
    assert device.heard == [STOP, *ASK, TYPICAL, *asked_of(1), ROTATION, rpm(600), express(1)]
    assert device.when(INFO)[0] - device.when(STOP)[1] >= 100 * MS
    assert len(scans) > 5


# scans that stop, and ports that close


def test_scans_that_stop_are_started_again(caplog: pytest.LogCaptureFixture) -> None:
    device = s1()
    line = Line(device)
    assert len(line.run(4.0)) > 30
    first = list(device.heard)
    device.stall()
    assert line.run(1.9) == []
    assert device.heard == first
    assert len(line.run(1.1)) > 5
    assert device.heard == first * 2
    assert len(caplog.messages) == 1
    device.stall()
    assert len(line.run(3.0)) > 5
    assert len(caplog.messages) == 2


def test_samples_without_a_revolution_are_a_stop_as_well() -> None:
    device = a1()
    line = Line(device)
    line.run(1.0)
    begun = len(device.heard)
    node = encode_standard_node(5000, 4000, 15, False)
    device.scan_from(replace(stream(STANDARD, 0.0), packets=(node,) * 6000), line.now_ns)  # the head stands
    line.run(1.9)
    assert len(device.heard) == begun
    line.run(0.5)
    assert device.heard[begun : begun + 3] == ASK


def test_on_a_port_that_was_reopened_everything_begins_again() -> None:
    device = s1()
    line = Line(device)
    line.run(1.0)
    first = list(device.heard)
    line.rplidar.connected(line.now_ns)
    assert line.rplidar.info is None
    assert line.rplidar.health is None
    assert line.rplidar.mode == ""
    assert len(line.run(1.0)) > 5
    assert device.heard == first * 2


def test_a_port_that_was_reopened_in_the_midst_of_a_question_begins_again() -> None:
    device = a1()
    del device.answers[HEALTH]
    line = Line(device)
    line.run(0.5)
    line.rplidar.connected(line.now_ns)
    line.run(0.05)
    assert device.heard == [*ASK, STOP]


# damaged, wrong and late answers

ASKED_OF_S1 = [INFO, HEALTH, TYPICAL, *asked_of(1), ROTATION]


@pytest.mark.parametrize("junk", [BANNER, b"\xa5", b"\xa5\x5a\x14\x00", bytes(range(256))], ids=repr)
def test_garbage_before_every_answer_does_not_matter(junk: bytes) -> None:
    device = s1()
    device.fault = lambda _, answer: (junk + answer, 0)
    assert len(Line(device).run(1.0)) > 5
    assert device.heard == [STOP, *ASKED_OF_S1, rpm(600), express(1)]


@pytest.mark.parametrize("request_", ASKED_OF_S1, ids=bytes.hex)
@pytest.mark.parametrize("missing", [1, 4, 10, 1000])
def test_an_answer_that_was_cut_short_or_lost_is_asked_for_again(request_: bytes, missing: int) -> None:
    device = s1()

    def cut_once(request: bytes, answer: bytes) -> tuple[bytes, int]:
        is_first = request == request_ and device.heard.count(request) == 1
        return (answer[:-missing] if is_first else answer), 0

    device.fault = cut_once
    line = Line(device)
    assert len(line.run(2.0)) > 5
    assert device.heard.count(request_) == 2
    assert line.rplidar.mode == "DenseBoost"
    assert device.heard[-2:] == [rpm(600), express(1)]


@pytest.mark.parametrize("request_", ASKED_OF_S1, ids=bytes.hex)
def test_an_answer_to_another_question_is_none(request_: bytes) -> None:
    for other in {INFO, HEALTH, ROTATION, FLAG} - {request_}:
        device = s1()
        wrong = device.answers[other]

        def other_once(
            request: bytes, answer: bytes, device: FakeDevice = device, wrong: bytes = wrong
        ) -> tuple[bytes, int]:
            return (wrong if request == request_ and device.heard.count(request) == 1 else answer), 0

        device.fault = other_once
        line = Line(device)
        assert len(line.run(2.0)) > 5
        assert device.heard.count(request_) == 2
        assert line.rplidar.mode == "DenseBoost"


@pytest.mark.parametrize("late", [[0], [1], [2], range(5)], ids=str)
def test_a_name_that_comes_too_late_is_not_taken_for_the_next_mode_s(
    late: Sequence[int], caplog: pytest.LogCaptureFixture
) -> None:
    device = a1()
    late_names = [name_of(mode) for mode in late]
    device.fault = lambda request, answer: (answer, 320 if request in late_names else 0)
    line = Line(device, mode="boost")
    assert len(line.run(3.0)) > 5
    if not caplog.messages:  # with an answer in doubt it may choose itself, but not without a word
        assert (line.rplidar.mode, device.heard[-1]) == ("Boost", express(2))


def test_an_answer_after_the_time_for_it_does_not_confuse_the_next_round() -> None:
    device = a1()
    device.fault = lambda request, answer: (answer, 1050 if request == INFO else 0)
    line = Line(device)
    line.run(2.3)
    assert device.heard == [STOP, INFO, STOP, INFO, STOP]
    device.fault = lambda _, answer: (answer, 0)
    assert len(line.run(2.0)) > 5


@settings(deadline=None, max_examples=40)
@given(
    st.lists(
        st.tuples(st.just("flip"), st.integers(0, 400))
        | st.tuples(st.just("cut"), st.integers(0, 30))
        | st.tuples(st.just("late"), st.sampled_from([100, 310, 1010])),
        max_size=25,
    ),
    st.sampled_from([a1, a3, s1, c1]),
    st.sampled_from(["auto", "standard", "denseboost"]),
)
def test_whatever_happened_to_answers_scans_come_in_the_end(
    faults: list[tuple[str, int]], make: Make, mode: str
) -> None:
    coming = iter(faults)

    def spoilt(_: bytes, answer: bytes) -> tuple[bytes, int]:
        kind, number = next(coming, ("late", 0))
        if kind == "flip":
            damaged = bytearray(answer)
            damaged[number // 8 % len(answer)] ^= 1 << number % 8
            answer = bytes(damaged)
        elif kind == "cut":
            answer = answer[: max(0, len(answer) - number)]
        return answer, number if kind == "late" else 0

    device = make()
    device.fault = spoilt
    line = Line(device, mode=mode)
    assert any(line.run(1.0) for _ in range(60))
    speeds = [struct.unpack_from("<H", command, 3)[0] for command in motor_commands(device)]
    assert all(200 <= speed <= 1500 for speed in speeds)
    assert busiest_second(device) <= 40  # as many as there are questions


# replay


@pytest.mark.parametrize("make", [a1, a3, s1, c1, a2m8], ids=["A1", "A3", "S1", "C1", "A2 1.20"])
def test_what_came_in_gives_the_same_scans_without_a_dialogue_over_a_reconnection_too(make: Make) -> None:
    line = Line(make())
    live = line.run(1.234)
    line.device.stall()  # unplugged inside a packet
    line.now_ns += 700 * MS
    line.rplidar.connected(line.now_ns)
    live += line.run(1.2)
    line.device.lost = [STOP]
    line.rplidar.connected(line.now_ns)  # lost and found at once, while the scan goes on
    live += line.run(1.2)
    replay = Rplidar(Rplidar.Config())
    replayed = [scan for data, now_ns in line.arrived for scan in replay.feed(data, now_ns)]
    assert len(replayed) == len(live) > 20
    for scan, reference in zip(replayed, live, strict=True):
        assert isinstance(scan, Scan)
        assert scan.stamp_ns == reference.stamp_ns
        for field in ("angles", "ranges", "beam_times", "quality"):
            np.testing.assert_array_equal(getattr(scan, field), getattr(reference, field))
    assert replay.info == line.rplidar.info
    assert replay.stats == line.rplidar.stats
