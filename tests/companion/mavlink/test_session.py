"""The session beside a scripted autopilot, in simulated time: ids, time, origin, requests, reboot."""

from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink2

from companion.mavlink.link import NAME
from companion.mavlink.session import MavlinkSession
from companion.mavlink.signing import SigningClock
from tests.companion.mavlink.flight import OK, START_NS, TICK_NS, Flight, messages, planar, site
from tests.companion.mavlink.scripted_autopilot import SYSTEM, UPTIME_NS, ScriptedAutopilot

KEY = bytes(range(32))


def heartbeat(system: int, component: int = 1, kind: int = 3) -> bytes:
    message = mavlink2.MAVLink_heartbeat_message(2, kind, 0, 0, 3, 3)
    return bytes(message.pack(mavlink2.MAVLink(None, srcSystem=system, srcComponent=component)))


def poses(flight: Flight) -> list[mavlink2.MAVLink_message]:
    return flight.autopilot.of("VISION_POSITION_ESTIMATE")


def test_poses_at_30_hz_and_heartbeats_at_1_hz() -> None:
    flight = Flight(site())
    flight.fly(12.0)
    # The first second shows whether the pose stays good.
    assert len(poses(flight)) == pytest.approx(11.0 * 30.0, abs=2)
    usecs = np.array([message.usec for message in poses(flight)])
    assert np.all(np.diff(usecs) >= 20_000)
    beats = flight.autopilot.of("HEARTBEAT")
    assert len(beats) == 12
    assert {(m.get_srcSystem(), m.get_srcComponent(), m.type, m.autopilot) for m in beats[1:]} == {
        (SYSTEM, 197, 18, 8)
    }
    numbers = [m.get_seq() for _, m in flight.autopilot.heard]
    assert numbers == [i % 256 for i in range(len(numbers))]
    assert all(m.get_msgbuf()[0] == 0xFD for _, m in flight.autopilot.heard)


def test_nothing_but_heartbeats_before_an_autopilot_is_heard() -> None:
    session = MavlinkSession(site())
    for i in range(300):
        session.tick(planar(0, 0, 0, i * TICK_NS), OK, i * TICK_NS)
    sent = messages(session.take()[NAME])
    assert {m.get_type() for m in sent} == {"HEARTBEAT", "STATUSTEXT"}
    assert {m.get_srcSystem() for m in sent} == {1}


def test_a_named_profile_does_not_wait_for_an_autopilot() -> None:
    session = MavlinkSession(site(profile="px4"))
    for i in range(60):
        session.tick(planar(0, 0, 0, i * TICK_NS), OK, i * TICK_NS)
    assert "VISION_POSITION_ESTIMATE" in {m.get_type() for m in messages(session.take()[NAME])}


@pytest.mark.parametrize(("kind", "name"), [(3, "ardupilot"), (12, "px4"), (0, "ardupilot")])
def test_the_heartbeat_chooses_the_profile(kind: int, name: str) -> None:
    flight = Flight(site(), ScriptedAutopilot(START_NS, kind=kind))
    flight.fly(0.1)
    assert flight.session.profile is not None
    assert flight.session.profile.name == name


def test_ticks_that_come_too_soon_carry_no_pose_to_ardupilot() -> None:
    flight = Flight(site())
    flight.fly(2.0)
    before = flight.session.poses_packed
    now_ns = flight.now_ns + 1_000_000_000
    for offset_ns in (0, 10_000_000, 19_999_999, 20_000_000, 39_000_000, 40_000_000):
        flight.session.tick(planar(0, 0, 0, now_ns + offset_ns), OK, now_ns + offset_ns)
    assert flight.session.poses_packed - before == 3


def test_the_pose_says_when_it_was_true_not_when_it_was_sent() -> None:
    flight = Flight(site())
    flight.pose = lambda now_ns: planar(1, 2, 0, now_ns - 70_000_000)
    flight.fly(2.0)
    at_ns, message = next(
        (at, m) for at, m in flight.autopilot.heard if m.get_type() == "VISION_POSITION_ESTIMATE"
    )
    assert message.usec == pytest.approx((at_ns - 70_000_000) / 1000, abs=1)


def test_strangers_are_not_listened_to() -> None:
    flight = Flight(site())
    flight.fly(4.0)
    session = flight.session
    stranger = mavlink2.MAVLink(None, srcSystem=99, srcComponent=1)
    origin = mavlink2.MAVLink_param_set_message(0, 197, b"HLT_SIGMA_XY", 2.0, 9).pack(stranger)
    session.receive(NAME, bytes(origin) + heartbeat(99), flight.now_ns, flight.now_ns)
    sync = mavlink2.MAVLink_timesync_message(0, 5).pack(stranger)
    session.receive(NAME, bytes(sync), flight.now_ns, flight.now_ns)
    assert session.autopilot == SYSTEM
    assert session.config.health.max_sigma_xy == 0.5
    assert session.refused[99] == 3
    assert session.take() == {}


def test_of_two_autopilots_at_once_none_is_ours() -> None:
    session = MavlinkSession(site())
    session.receive(NAME, heartbeat(3) + heartbeat(4), START_NS, START_NS)
    assert session.autopilot is None
    for i in range(90):
        session.tick(planar(0, 0, 0, i * TICK_NS), OK, START_NS + i * TICK_NS)
    sent = messages(session.take()[NAME])
    assert "VISION_POSITION_ESTIMATE" not in {m.get_type() for m in sent}
    assert any("autopilot_id" in m.text for m in sent if m.get_type() == "STATUSTEXT")
    named = MavlinkSession(site(autopilot_id=4))
    named.receive(NAME, heartbeat(3) + heartbeat(4), START_NS, START_NS)
    assert named.autopilot == 4


def test_a_second_autopilot_much_later_changes_nothing() -> None:
    flight = Flight(site())
    flight.fly(3.5)
    flight.session.receive(NAME, heartbeat(99), flight.now_ns, flight.now_ns)
    assert flight.session.autopilot == SYSTEM


def test_requests_for_the_time_are_answered_with_the_clock_of_the_poses() -> None:
    flight = Flight(site())
    flight.fly(0.1)
    request = mavlink2.MAVLink_timesync_message(0, 123).pack(flight.autopilot.ends)
    flight.session.take()
    # 8 ms passed before the loop got to it.
    flight.session.receive(NAME, bytes(request), flight.now_ns, flight.now_ns + 8_000_000)
    answer = messages(flight.session.take()[NAME])[0]
    assert (answer.get_type(), answer.ts1, answer.tc1) == ("TIMESYNC", 123, flight.now_ns + 4_000_000)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_clocks_agree_within_a_millisecond_over_a_link_with_50_ms_of_jitter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    flight = Flight(site(), delay=lambda: float(rng.uniform(0.0, 0.05)))
    flight.fly(15.0)
    errors = []
    for _ in range(50):
        flight.fly(0.1)
        offset_ns = flight.session.clock.offset_ns
        assert offset_ns is not None
        errors.append(offset_ns - (flight.autopilot.boot_clock_ns(0)))
    assert flight.autopilot.boot_clock_ns(START_NS) == UPTIME_NS
    assert np.quantile(np.abs(errors), 0.95) < 1_000_000


def test_the_origin_is_sent_until_it_is_confirmed_and_again_after_a_reboot() -> None:
    flight = Flight(site(site__origin={"lat": 48.1374, "lon": 11.5755, "alt": 12.5}))
    flight.autopilot.refuses_origin = 2
    flight.fly(10.0)
    sent = flight.autopilot.of("SET_GPS_GLOBAL_ORIGIN")
    assert len(sent) == 3
    assert {(m.target_system, m.latitude, m.longitude, m.altitude) for m in sent} == {
        (SYSTEM, 481_374_000, 115_755_000, 12_500)
    }
    flight.autopilot.reboot(flight.now_ns)
    flight.fly(8.0)
    assert len(flight.autopilot.of("SET_GPS_GLOBAL_ORIGIN")) == 4
    assert flight.autopilot.origin == (481_374_000, 115_755_000)


def test_no_origin_is_sent_for_a_site_without_one() -> None:
    flight = Flight(site())
    flight.fly(5.0)
    assert flight.autopilot.of("SET_GPS_GLOBAL_ORIGIN") == []


def test_another_origin_is_reported_and_left_alone() -> None:
    flight = Flight(site(site__origin={"lat": 48.0, "lon": 11.0}))
    flight.autopilot.origin = (480_000_000, 110_010_000)
    flight.autopilot.refuses_origin = 1000
    flight.fly(12.0)
    assert len(flight.autopilot.of("SET_GPS_GLOBAL_ORIGIN")) == 1
    texts = [m.text for m in flight.autopilot.of("STATUSTEXT")]
    # 0.001 deg of longitude at 48 deg north: 111.3 m cos 48.
    assert any("another origin, 74 m" in text for text in texts)


def test_streams_are_asked_for_until_they_come_and_again_after_a_reboot() -> None:
    flight = Flight(site(mavlink__inputs={"attitude": 50.0, "imu": 100.0, "height": 10.0}))
    flight.fly(7.0)
    wanted = {
        mavlink2.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
        mavlink2.MAVLINK_MSG_ID_ATTITUDE: 0.02,
        mavlink2.MAVLINK_MSG_ID_RAW_IMU: 0.01,
        mavlink2.MAVLINK_MSG_ID_DISTANCE_SENSOR: 0.1,
    }
    assert flight.autopilot.intervals == pytest.approx(wanted)
    asked = len([m for m in flight.autopilot.of("COMMAND_LONG") if m.command == 511])
    assert asked == 4
    flight.autopilot.reboot(flight.now_ns)
    flight.fly(7.0)
    assert flight.autopilot.intervals == pytest.approx(wanted)


def test_after_a_reboot_the_clock_is_right_again() -> None:
    flight = Flight(site())
    flight.fly(5.0)
    flight.autopilot.reboot(flight.now_ns)
    flight.fly(3.0)
    offset_ns = flight.session.clock.offset_ns
    assert offset_ns == pytest.approx(flight.autopilot.boot_clock_ns(0), abs=1_000_000)


def test_a_lost_link_stops_requests_and_is_taken_up_again() -> None:
    flight = Flight(site(site__origin={"lat": 48.0, "lon": 11.0}))
    flight.fly(5.0)
    flight.link_is_up = False
    flight.fly(8.0)
    sent = [m.get_type() for m in messages(flight.session.take().get(NAME, b""))]
    assert "TIMESYNC" not in sent
    flight.autopilot.heard.clear()
    flight.link_is_up = True
    flight.fly(3.0)
    assert len(poses(flight)) == pytest.approx(90, abs=2)
    assert len(flight.autopilot.of("SET_GPS_GLOBAL_ORIGIN")) == 1
    assert flight.autopilot.of("TIMESYNC")


def test_with_a_key_everything_is_signed_and_what_is_unsigned_is_refused(tmp_path: Path) -> None:
    key_file = tmp_path / "key"
    key_file.write_bytes(KEY)
    session = MavlinkSession(site(), KEY, SigningClock(key_file))
    flight = Flight(site(), ScriptedAutopilot(START_NS, key=KEY), session=session)
    flight.autopilot.ends.signing.timestamp = SigningClock(key_file).now()
    flight.fly(3.0)
    assert session.autopilot == SYSTEM
    # The autopilot's parser throws away what is not signed rightly.
    assert len(poses(flight)) > 50
    set_unsigned = mavlink2.MAVLink_param_set_message(SYSTEM, 197, b"HLT_SIGMA_XY", 2.0, 9)
    data = bytes(set_unsigned.pack(mavlink2.MAVLink(None, srcSystem=255, srcComponent=190)))
    session.receive(NAME, data, flight.now_ns, flight.now_ns)
    assert session.config.health.max_sigma_xy == 0.5
    flight.autopilot.ends.srcSystem = 255
    signed = set_unsigned.pack(flight.autopilot.ends)
    session.receive(NAME, bytes(signed), flight.now_ns, flight.now_ns)
    assert session.config.health.max_sigma_xy == 2.0
    # The same bytes once more are an attack.
    set_back = mavlink2.MAVLink_param_set_message(SYSTEM, 197, b"HLT_SIGMA_XY", 0.5, 9)
    session.receive(NAME, bytes(set_back.pack(flight.autopilot.ends)), flight.now_ns, flight.now_ns)
    session.receive(NAME, bytes(signed), flight.now_ns, flight.now_ns)
    assert session.config.health.max_sigma_xy == 0.5


def test_another_key_is_no_key(tmp_path: Path) -> None:
    key_file = tmp_path / "key"
    key_file.write_bytes(KEY)
    session = MavlinkSession(site(), KEY, SigningClock(key_file))
    other = ScriptedAutopilot(START_NS, key=bytes(32))
    other.ends.signing.timestamp = SigningClock(key_file).now()
    flight = Flight(site(), other, session=session)
    flight.fly(3.0)
    assert session.autopilot is None
    assert flight.autopilot.heard == [] or {m.get_type() for _, m in flight.autopilot.heard} == {"BAD_DATA"}


def test_messages_are_passed_on_only_when_that_is_asked_for() -> None:
    ground = mavlink2.MAVLink(None, srcSystem=255, srcComponent=190)
    request = bytes(mavlink2.MAVLink_param_request_list_message(SYSTEM, 1).pack(ground))
    for forward in (False, True):
        session = MavlinkSession(site(ground_url="udpin:0.0.0.0:14560", forward=forward))
        session.receive(NAME, heartbeat(SYSTEM), START_NS, START_NS)
        session.receive("mavlink_ground", request, START_NS, START_NS)
        status = mavlink2.MAVLink_sys_status_message(*[0] * 13)
        autopilot = mavlink2.MAVLink(None, srcSystem=SYSTEM, srcComponent=1)
        session.receive(NAME, bytes(status.pack(autopilot)), START_NS, START_NS)
        out = session.take()
        assert (out.get(NAME) == request) is forward
        kinds = {m.get_type() for m in messages(out.get("mavlink_ground", b""))}
        assert ("SYS_STATUS" in kinds) is forward


def test_what_is_for_everybody_is_answered_and_passed_on() -> None:
    session = MavlinkSession(site(ground_url="udpin:0.0.0.0:14560", forward=True))
    session.receive(NAME, heartbeat(SYSTEM), START_NS, START_NS)
    ground = mavlink2.MAVLink(None, srcSystem=255, srcComponent=190)
    for target, is_passed in ((0, True), (197, False)):
        request = bytes(mavlink2.MAVLink_param_request_list_message(SYSTEM, target).pack(ground))
        session.receive("mavlink_ground", request, START_NS, START_NS)
        session.tick(None, OK, START_NS + 100_000_000)
        out = session.take()
        assert (request in out.get(NAME, b"")) is is_passed
        assert "PARAM_VALUE" in {m.get_type() for m in messages(out["mavlink_ground"])}


def test_a_ground_station_on_its_own_link_gets_state_but_no_poses() -> None:
    session = MavlinkSession(site(ground_url="udpin:0.0.0.0:14560", profile="ardupilot"))
    for i in range(90):
        session.tick(planar(0, 0, 0, i * TICK_NS), OK, i * TICK_NS)
    kinds = {m.get_type() for m in messages(session.take()["mavlink_ground"])}
    assert kinds == {"HEARTBEAT", "STATUSTEXT"}


def test_garbage_between_messages_is_counted_and_does_no_harm() -> None:
    rng = np.random.default_rng(1)
    flight = Flight(site())
    for _ in range(20):
        flight.fly(0.1)
        flight.session.receive(NAME, rng.bytes(200), flight.now_ns, flight.now_ns)
    flight.fly(2.0)
    assert flight.session.endpoints[NAME].parser.stats.bad > 0
    assert flight.session.autopilot == SYSTEM
    assert len(poses(flight)) > 50
