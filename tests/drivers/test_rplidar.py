"""Scans from RPLIDAR bytes: geometry, time and gaps; and the dialogue with a device of each kind."""

import json
import math
import random
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from drivers import make_sensor
from drivers.rplidar import Rplidar
from drivers.rplidar_protocol import (
    AccBoardFlag,
    AnswerType,
    Command,
    DeviceInfo,
    Health,
    HealthStatus,
    RequestDecoder,
    SampleRate,
    encode_answer,
    encode_descriptor,
    encode_express_capsule,
    encode_request,
    encode_standard_node,
)
from estimators.messages import FloatArray, Scan

DATA = Path(__file__).parents[1] / "data" / "vectors"
MS = 1_000_000
T0_NS = 5_000_000_000
SAMPLE_NS = {"standard": 500_000, "express": 250_000}
PACKET_NS = {"standard": 500_000, "express": 32 * 250_000}
SCAN_TYPE = {"standard": AnswerType.STANDARD_SCAN, "express": AnswerType.EXPRESS_SCAN}
REVOLUTIONS_PER_S = 9.7  # so that neither samples nor packets repeat from turn to turn

# A room around the lidar, in its frame (x forward, y left) [m]: the wall on the left is the near one.
FRONT, BACK, LEFT, RIGHT = 4.0, -2.5, 1.5, -3.0


def room_range(angle: FloatArray) -> FloatArray:
    """Distance to the walls [m] in directions counter-clockwise from x [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    with np.errstate(divide="ignore"):
        to_x = np.where(c > 0, FRONT / c, BACK / c)
        to_y = np.where(s > 0, LEFT / s, RIGHT / s)
    return np.minimum(np.abs(to_x), np.abs(to_y))


def device_deg(sample: int, mode: str) -> float:
    """Clockwise direction of the head when it takes a sample; the device starts at 200 deg."""
    return 200 + 360 * REVOLUTIONS_PER_S * sample * SAMPLE_NS[mode] * 1e-9


def node(sample: int) -> bytes:
    deg = device_deg(sample, "standard")
    start = math.floor(deg / 360) > math.floor(device_deg(sample - 1, "standard") / 360)
    metres = float(room_range(-np.radians(np.array(deg))))
    return encode_standard_node(int(deg % 360 * 64), round(metres * 4000), 30, start)


def capsule(number: int) -> bytes:
    """The lidar looks `offset` to the left of the head's direction, as real optics make it do."""
    samples = range(32 * number, 32 * number + 32)
    offsets_q3 = [(7 * k) % 64 for k in range(32)]
    deg = np.array([device_deg(k, "express") for k in samples]) - np.array(offsets_q3) / 8
    distances_mm = [round(float(d) * 1000) for d in room_range(-np.radians(deg))]
    start_q6 = int(device_deg(samples[0], "express") % 360 * 64)
    return encode_express_capsule(start_q6, number == 0, distances_mm, offsets_q3)


@cache
def packets(mode: str, seconds: float) -> tuple[tuple[bytes, int], ...]:
    """(bytes, time of their last sample), the first with the descriptor before it."""
    count = int(seconds * 1e9 / PACKET_NS[mode])
    encode = node if mode == "standard" else capsule
    made = [(encode(i), T0_NS + (i + 1) * PACKET_NS[mode] - SAMPLE_NS[mode]) for i in range(count)]
    return ((encode_descriptor(SCAN_TYPE[mode]) + made[0][0], made[0][1]), *made[1:])


def chunks(mode: str, seconds: float, sizes: Iterator[int]) -> list[tuple[bytes, int]]:
    """The same bytes cut anywhere; each byte arrives as soon as its packet's share of time has passed."""
    made = packets(mode, seconds)
    arrivals = [
        stamp_ns - PACKET_NS[mode] * (len(data) - 1 - i) // len(data)
        for data, stamp_ns in made
        for i in range(len(data))
    ]
    data = b"".join(packet for packet, _ in made)
    cut = []
    at = 0
    while at < len(data):
        end = min(len(data), at + next(sizes))
        cut.append((data[at:end], arrivals[end - 1]))
        at = end
    return cut


def sizes(seed: int, longest: int) -> Iterator[int]:
    rng = random.Random(seed)
    while True:
        yield rng.randint(1, longest)


def scans_of(rplidar: Rplidar, pieces: Sequence[tuple[bytes, int]]) -> list[Scan]:
    scans = [scan for data, stamp_ns in pieces for scan in rplidar.feed(data, stamp_ns)]
    assert all(isinstance(scan, Scan) for scan in scans)
    return [scan for scan in scans if isinstance(scan, Scan)]


def true_times_ns(scan: Scan, mode: str, turn: int) -> FloatArray:
    """When the samples of a scan were taken, from the sample numbers of the turn'th whole turn."""
    # express counts a turn from the last sample before 0, standard from the first after it
    first = next(k for k in range(10**6) if device_deg(k, mode) >= 360 * (turn + 1))
    first -= 1 if mode == "express" else 0
    numbers: FloatArray = np.arange(first, first + len(scan.angles), dtype=np.float64)
    return T0_NS + numbers * SAMPLE_NS[mode]


# geometry


@pytest.mark.parametrize("mode", ["standard", "express"])
def test_scans_show_the_room_counter_clockwise_in_metres(mode: str) -> None:
    rplidar = Rplidar(Rplidar.Config())
    scans = scans_of(rplidar, packets(mode, 1.0))
    assert len(scans) == 9  # from 200 deg on 9.7 turns: the last begins 90 deg before the end
    assert rplidar.dropped_scans == 0
    for scan in scans:
        expected = 1e9 / REVOLUTIONS_PER_S / SAMPLE_NS[mode]
        assert abs(len(scan.angles) - expected) <= 2
        assert scan.angles.min() >= -np.pi
        assert scan.angles.max() < np.pi
        # 1/64 deg of angle is at most 5 mm on a wall seen at a slant
        np.testing.assert_allclose(scan.ranges, room_range(scan.angles), atol=0.006)
        left = np.argmin(np.abs(scan.angles - np.pi / 2))
        assert scan.ranges[left] == pytest.approx(LEFT, abs=0.01)
        right = np.argmin(np.abs(scan.angles + np.pi / 2))
        assert scan.ranges[right] == pytest.approx(-RIGHT, abs=0.01)
        # the head turns clockwise
        turned = -np.diff(np.unwrap(scan.angles)).sum()
        assert turned == pytest.approx(2 * np.pi, abs=0.3)


def test_quality_is_the_device_s_own_and_zero_where_it_gives_none() -> None:
    standard = scans_of(Rplidar(Rplidar.Config()), packets("standard", 0.4))
    assert set(standard[0].quality) == {120.0}
    express = scans_of(Rplidar(Rplidar.Config()), packets("express", 0.4))
    assert set(express[0].quality) == {0.0}


def test_returns_outside_the_limits_become_no_return() -> None:
    config = Rplidar.Config(min_range=2.0, max_range=3.5)
    (scan, *_) = scans_of(Rplidar(config), packets("express", 0.4))
    truth = room_range(scan.angles)
    inside = (truth > 2.01) & (truth < 3.49)
    outside = (truth < 1.99) | (truth > 3.51)
    assert (scan.ranges[inside] > 0).all()
    assert (scan.ranges[outside] == 0).all()
    assert inside.sum() > 50
    assert outside.sum() > 50


# time


@pytest.mark.parametrize("mode", ["standard", "express"])
def test_beam_times_are_exact_when_packets_arrive_on_their_own(mode: str) -> None:
    scans = scans_of(Rplidar(Rplidar.Config()), packets(mode, 1.0))
    for turn, scan in enumerate(scans):
        times_ns = scan.stamp_ns + scan.beam_times * 1e9
        np.testing.assert_allclose(times_ns, true_times_ns(scan, mode, turn), atol=1, rtol=0)


@pytest.mark.parametrize("longest", [3, 60, 700])
@pytest.mark.parametrize("mode", ["standard", "express"])
def test_beam_times_are_within_one_packet_in_any_chunks(mode: str, longest: int) -> None:
    whole = scans_of(Rplidar(Rplidar.Config()), packets(mode, 1.0))
    cut = chunks(mode, 1.0, sizes(longest, longest))
    scans = scans_of(Rplidar(Rplidar.Config()), cut)
    assert len(scans) == len(whole)
    last_ns = 0.0
    for turn, (scan, reference) in enumerate(zip(scans, whole, strict=True)):
        np.testing.assert_array_equal(scan.angles, reference.angles)
        np.testing.assert_array_equal(scan.ranges, reference.ranges)
        assert scan.beam_times[0] == 0
        assert (np.diff(scan.beam_times) > 0).all()
        assert scan.stamp_ns > last_ns
        last_ns = scan.end_stamp_ns
        times_ns = scan.stamp_ns + scan.beam_times * 1e9
        assert np.abs(times_ns - true_times_ns(scan, mode, turn)).max() <= PACKET_NS[mode]


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32), st.sampled_from(["standard", "express"]), st.integers(0, 30))
def test_late_chunks_never_put_beams_out_of_order_or_ahead_of_arrival(
    seed: int, mode: str, delay_ms: int
) -> None:
    rng = random.Random(seed)
    rplidar = Rplidar(Rplidar.Config())
    arrival_ns = 0
    last_ns = 0
    emitted = 0
    for data, stamp_ns in chunks(mode, 0.6, sizes(seed, 120)):
        arrival_ns = max(arrival_ns + 100_000, stamp_ns + rng.randint(0, delay_ms) * MS)
        for scan in scans_of(rplidar, [(data, arrival_ns)]):
            emitted += 1
            assert scan.stamp_ns > last_ns
            assert (np.diff(scan.beam_times) > 0).all()
            last_ns = scan.end_stamp_ns
            assert last_ns <= arrival_ns
    assert emitted == 5


def test_the_sample_duration_is_what_the_device_says() -> None:
    rplidar = Rplidar(Rplidar.Config())
    data = b"".join(packet for packet, _ in packets("express", 0.4))
    answer = encode_answer(SampleRate(508, 254))
    scans = scans_of(rplidar, [(answer + data, T0_NS)])
    np.testing.assert_allclose(np.diff(scans[0].beam_times), 254e-6, atol=1e-9)


# gaps


@pytest.mark.parametrize("mode", ["standard", "express"])
def test_a_revolution_with_a_gap_is_dropped_and_counted(mode: str) -> None:
    made = list(packets(mode, 1.0))
    complete = scans_of(Rplidar(Rplidar.Config()), made)
    third = complete[2]
    middle_ns = (third.stamp_ns + third.end_stamp_ns) // 2
    hurt = next(i for i, (_, stamp_ns) in enumerate(made) if stamp_ns >= middle_ns)
    made[hurt] = (made[hurt][0][:3], made[hurt][1])
    rplidar = Rplidar(Rplidar.Config())
    scans = scans_of(rplidar, made)
    assert [scan.stamp_ns for scan in scans] == [s.stamp_ns for s in complete if s is not third]
    assert rplidar.dropped_scans == 1


def test_revolutions_with_too_few_samples_are_dropped() -> None:
    rplidar = Rplidar(Rplidar.Config())
    turn = b"".join(encode_standard_node(k * 18 * 64, 4000, 15, k == 0) for k in range(20))
    assert scans_of(rplidar, [(encode_descriptor(AnswerType.STANDARD_SCAN) + 3 * turn, T0_NS)]) == []
    assert rplidar.dropped_scans == 2


def test_revolutions_that_take_more_than_a_second_are_dropped_and_use_no_memory() -> None:
    rplidar = Rplidar(Rplidar.Config())
    turn = b"".join(encode_standard_node(k * 10, 4000, 15, k == 0) for k in range(2304))
    assert scans_of(rplidar, [(encode_descriptor(AnswerType.STANDARD_SCAN) + 3 * turn, T0_NS)]) == []
    assert rplidar.dropped_scans == 2


def test_a_new_scan_begins_with_no_part_of_the_old_one() -> None:
    rplidar = Rplidar(Rplidar.Config())
    first = packets("express", 0.25)
    again = [(data, stamp_ns + 400 * MS) for data, stamp_ns in first]
    scans = scans_of(rplidar, [*first, *again])
    assert len(scans) == 2
    assert all(scan.beam_times[-1] < 0.11 for scan in scans)
    assert rplidar.dropped_scans == 0


def test_the_sdk_s_clean_streams_give_a_scan_between_every_two_starts() -> None:
    for name in ("standard_clean", "express_clean", "sitl_a2_stream"):
        rplidar = Rplidar(Rplidar.Config(max_range=40))
        data = (DATA / f"rplidar_{name}.bin").read_bytes()
        vector = json.loads((DATA / f"rplidar_{name}.json").read_text())
        scans = scans_of(rplidar, [(data, T0_NS)])
        starts = vector["start_flag_indexes"]
        assert [len(scan.angles) for scan in scans] == [end - first for first, end in pairwise(starts)]
        expected = np.array([row[1] / 4000 for row in vector["nodes"][starts[0] : starts[-1]]])
        expected[expected < 0.15] = 0
        np.testing.assert_array_equal(np.concatenate([scan.ranges for scan in scans]), expected)


@given(st.lists(st.tuples(st.binary(max_size=60), st.integers(0, 10 * MS)), max_size=30))
def test_no_bytes_raise(pieces: list[tuple[bytes, int]]) -> None:
    rplidar = Rplidar(Rplidar.Config(max_range=20))
    now_ns = T0_NS
    opening = [encode_descriptor(AnswerType.STANDARD_SCAN), encode_descriptor(AnswerType.EXPRESS_SCAN)]
    for number, (data, later_ns) in enumerate(pieces):
        now_ns += later_ns
        rplidar.feed(opening[number % 2] + data if number % 7 == 0 else data, now_ns)
    assert rplidar.stats.skipped_bytes <= sum(len(data) + 7 for data, _ in pieces)


# config


def test_the_config_refuses_what_the_device_cannot_do() -> None:
    for bad in ({"motor_pwm": 1024}, {"motor_rpm": 1501}, {"mode": "boost"}, {"speed": 3}):
        with pytest.raises(ValidationError, match=next(iter(bad))):
            Rplidar.Config.model_validate(bad)
    with pytest.raises(ValidationError, match=r"min_range 5\.0 is not below max_range 4\.0"):
        Rplidar.Config(min_range=5.0, max_range=4.0)


def test_the_driver_is_registered() -> None:
    assert isinstance(make_sensor("rplidar", Rplidar.Config()), Rplidar)


# dialogue


class FakeDevice:
    """A lidar that answers requests and, while it scans, sends the packets of the room."""

    def __init__(
        self,
        model: int,
        firmware: tuple[int, int] = (1, 29),
        health: HealthStatus = HealthStatus.GOOD,
        has_motor_pwm: bool = True,
        deaf_to: frozenset[Command] = frozenset(),
    ) -> None:
        self.log: list[tuple[int, Command, bytes]] = []
        self.health = health
        self.deaf_to = deaf_to
        self._info = DeviceInfo(model, firmware, 7, "00" * 16)
        self._has_motor_pwm = has_motor_pwm
        self._requests = RequestDecoder()
        self._scan: Iterator[tuple[bytes, int]] = iter(())
        self._next: tuple[bytes, int] | None = None
        self._offset_ns = 0

    def start_scan(self, mode: str, now_ns: int) -> None:
        self._scan = iter(packets(mode, 10.0))
        self._next = next(self._scan)
        self._offset_ns = now_ns - T0_NS

    def exchange(self, data: bytes, now_ns: int) -> bytes:
        """What the device sends until now, after it was sent `data`."""
        answer = b""
        for code, payload in self._requests.feed(data):
            command = Command(code)
            self.log.append((now_ns, command, payload))
            self._next = None  # any request ends a scan
            if command not in self.deaf_to:
                answer += self._answer(command, now_ns)
        while self._next is not None and self._next[1] + self._offset_ns <= now_ns:
            answer += self._next[0]
            self._next = next(self._scan, None)
        return answer

    def stall(self) -> None:
        self._next = None

    def _answer(self, command: Command, now_ns: int) -> bytes:
        match command:
            case Command.GET_INFO:
                return encode_answer(self._info)
            case Command.GET_HEALTH:
                return encode_answer(Health(self.health, 0))
            case Command.GET_SAMPLERATE:
                return encode_answer(SampleRate(500, 250))
            case Command.GET_ACC_BOARD_FLAG:
                return encode_answer(AccBoardFlag(self._has_motor_pwm))
            case Command.RESET:
                self.health = HealthStatus.GOOD
                return b"RP LIDAR System.\r\nFirmware Ver 1.29, HW Ver 7\r\nModel: 18\r\n"
            case Command.SCAN:
                self.start_scan("standard", now_ns)
            case Command.EXPRESS_SCAN:
                self.start_scan("express", now_ns)
        return b""

    @property
    def commands(self) -> list[Command]:
        return [command for _, command, _ in self.log]

    def when(self, command: Command, number: int = 0) -> int:
        return [now_ns for now_ns, logged, _ in self.log if logged is command][number]


def talk(rplidar: Rplidar, device: FakeDevice, from_ms: int, to_ms: int) -> list[Scan]:
    """Run both for a while, in steps of 1 ms; an answer takes one step."""
    scans: list[Scan] = []
    for now_ns in range(from_ms * MS, to_ms * MS, MS):
        scans += scans_of(rplidar, [(device.exchange(rplidar.poll(now_ns), now_ns), now_ns)])
    return scans


def connect(device: FakeDevice, mode: str = "express") -> Rplidar:
    rplidar = Rplidar(Rplidar.Config.model_validate({"mode": mode}))
    rplidar.connected(0)
    return rplidar


ASK = [Command.STOP, Command.GET_INFO, Command.GET_HEALTH, Command.GET_SAMPLERATE]


@pytest.mark.parametrize(
    ("model", "motor", "off"),
    [
        (0x18, [], b""),
        (
            0x28,
            [(Command.GET_ACC_BOARD_FLAG, bytes(4)), (Command.SET_MOTOR_PWM, b"\x94\x02")],
            encode_request(Command.SET_MOTOR_PWM, bytes(2)),
        ),
        (0x41, [], b""),
        (
            0x61,
            [(Command.HQ_MOTOR_SPEED_CTRL, b"\x58\x02")],
            encode_request(Command.HQ_MOTOR_SPEED_CTRL, bytes(2)),
        ),
    ],
    ids=["A1", "A2", "C1", "S1"],
)
def test_each_model_is_asked_made_to_turn_and_to_scan(
    model: int, motor: list[tuple[Command, bytes]], off: bytes
) -> None:
    device = FakeDevice(model)
    rplidar = connect(device)
    scans = talk(rplidar, device, 0, 1000)
    expected = [*((command, b"") for command in ASK), *motor, (Command.EXPRESS_SCAN, bytes(5))]
    assert [(command, payload) for _, command, payload in device.log] == expected
    assert len(scans) == 8
    assert rplidar.info == DeviceInfo(model, (1, 29), 7, "00" * 16)
    assert rplidar.health == Health(HealthStatus.GOOD, 0)
    assert rplidar.closing() == encode_request(Command.STOP) + off
    assert device.when(Command.GET_INFO) - device.when(Command.STOP) >= 100 * MS
    last_before_scan_ns = device.log[-2][0]
    assert device.when(Command.EXPRESS_SCAN) - last_before_scan_ns >= 10 * MS


def test_standard_mode_asks_for_the_standard_scan() -> None:
    device = FakeDevice(0x18)
    scans = talk(connect(device, "standard"), device, 0, 500)
    assert device.commands == [*ASK, Command.SCAN]
    assert len(scans[0].angles) == pytest.approx(206, abs=1)


def test_the_motor_is_left_alone_without_an_accessory_board() -> None:
    device = FakeDevice(0x28, has_motor_pwm=False)
    talk(connect(device), device, 0, 500)
    assert device.commands == [*ASK, Command.GET_ACC_BOARD_FLAG, Command.EXPRESS_SCAN]


def test_old_firmware_is_not_asked_for_its_sample_rate() -> None:
    device = FakeDevice(0x18, firmware=(1, 16))
    talk(connect(device), device, 0, 500)
    assert device.commands == [Command.STOP, Command.GET_INFO, Command.GET_HEALTH, Command.EXPRESS_SCAN]


def test_a_device_without_the_optional_answers_still_scans() -> None:
    device = FakeDevice(0x28, deaf_to=frozenset({Command.GET_SAMPLERATE, Command.GET_ACC_BOARD_FLAG}))
    scans = talk(connect(device), device, 0, 3000)
    assert device.commands == [*ASK, Command.GET_ACC_BOARD_FLAG, Command.EXPRESS_SCAN]
    assert len(scans) > 5


def test_a_warning_does_not_stop_the_dialogue() -> None:
    device = FakeDevice(0x18, health=HealthStatus.WARNING)
    rplidar = connect(device)
    talk(rplidar, device, 0, 500)
    assert device.commands == [*ASK, Command.EXPRESS_SCAN]
    assert rplidar.health == Health(HealthStatus.WARNING, 0)


def test_a_device_in_error_is_reset_and_asked_again() -> None:
    device = FakeDevice(0x18, health=HealthStatus.ERROR)
    rplidar = connect(device)
    scans = talk(rplidar, device, 0, 3000)
    assert device.commands == [*ASK[:3], Command.RESET, *ASK, Command.EXPRESS_SCAN]
    assert device.when(Command.STOP, 1) - device.when(Command.RESET) >= 2000 * MS
    assert len(scans) > 3


def test_a_silent_device_is_tried_again_and_again() -> None:
    device = FakeDevice(0x18, deaf_to=frozenset(Command))
    talk(connect(device), device, 0, 4000)
    assert device.commands == [Command.STOP, Command.GET_INFO] * 4
    assert device.when(Command.STOP, 1) - device.when(Command.GET_INFO) == 1000 * MS


def test_a_scan_that_does_not_come_starts_the_dialogue_over() -> None:
    device = FakeDevice(0x18, deaf_to=frozenset({Command.EXPRESS_SCAN}))
    talk(connect(device), device, 0, 3500)
    assert device.commands[:6] == [*ASK, Command.EXPRESS_SCAN, Command.STOP]
    assert device.when(Command.STOP, 1) - device.when(Command.EXPRESS_SCAN) == 3000 * MS


def test_scans_that_stop_are_started_again() -> None:
    device = FakeDevice(0x18)
    rplidar = connect(device)
    assert len(talk(rplidar, device, 0, 4000)) > 30
    assert device.commands == [*ASK, Command.EXPRESS_SCAN]
    device.stall()
    assert talk(rplidar, device, 4000, 6000 - 10) == []
    assert device.commands == [*ASK, Command.EXPRESS_SCAN]
    assert len(talk(rplidar, device, 6000 - 10, 7000)) > 5
    assert device.commands == 2 * [*ASK, Command.EXPRESS_SCAN]


@pytest.mark.parametrize(("mode", "missing"), [("standard", 2), ("express", 50)])
def test_a_scan_left_running_and_cut_inside_a_packet_does_not_delay_the_dialogue(
    mode: str, missing: int
) -> None:
    device = FakeDevice(0x18)
    rplidar = connect(device)
    left_over = b"".join(data for data, _ in packets(mode, 0.2))[:-missing]
    rplidar.feed(left_over, 0)
    assert len(talk(rplidar, device, 0, 500)) > 1
    assert device.commands == [*ASK, Command.EXPRESS_SCAN]


def test_nothing_is_said_without_a_port_and_all_again_on_a_new_one() -> None:
    device = FakeDevice(0x18)
    rplidar = Rplidar(Rplidar.Config())
    assert rplidar.poll(T0_NS) == b""
    rplidar.connected(0)
    talk(rplidar, device, 0, 500)
    rplidar.connected(500 * MS)
    assert rplidar.info is None
    talk(rplidar, device, 500, 1000)
    assert device.commands == 2 * [*ASK, Command.EXPRESS_SCAN]


def test_replay_of_what_came_in_gives_the_same_scans_without_a_dialogue() -> None:
    device = FakeDevice(0x28)
    rplidar = connect(device)
    log: list[tuple[bytes, int]] = []
    live: list[Scan] = []
    for now_ns in range(0, 1500 * MS, MS):
        data = device.exchange(rplidar.poll(now_ns), now_ns)
        log.append((data, now_ns))
        live += scans_of(rplidar, [(data, now_ns)])
    replayed = scans_of(Rplidar(Rplidar.Config()), log)
    assert len(replayed) == len(live) > 10
    for scan, reference in zip(replayed, live, strict=True):
        assert scan.stamp_ns == reference.stamp_ns
        for field in ("angles", "ranges", "beam_times", "quality"):
            np.testing.assert_array_equal(getattr(scan, field), getattr(reference, field))
