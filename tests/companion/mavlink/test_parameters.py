"""Our settings as MAVLink parameters: listed, read, set and refused, by pymavlink's own client too."""

import socket
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from pymavlink import mavparm, mavutil
from pymavlink.dialects.v20 import all as mavlink2

from companion.config import Config, config_from_toml, load_config
from companion.errors import UserError
from companion.mavlink.link import NAME
from companion.mavlink.parameters import (
    Parameter,
    ParameterServer,
    save_setting,
    saved_settings,
    setting_line,
)
from companion.mavlink.session import MavlinkSession
from estimators import ESTIMATORS
from tests.companion.mavlink.flight import OK, START_NS, Flight, messages, planar, site
from tests.companion.mavlink.scripted_autopilot import SYSTEM
from tests.conftest import SITE

US = (SYSTEM, 197)


def no_change(*_: object) -> None:
    """Told of a parameter that was set."""


def no_alignment() -> None:
    """Told to align."""


class Pilot:
    """A ground station that talks through the autopilot's link."""

    def __init__(self, **settings: object) -> None:
        self.flight = Flight(site(**settings))
        self.flight.fly(0.1)
        self.flight.session.take()
        self._packer = mavlink2.MAVLink(None, srcSystem=255, srcComponent=190)

    def ask(self, message: mavlink2.MAVLink_message, seconds: float = 0.0) -> list[mavlink2.MAVLink_message]:
        """Answers at once, and those of some time."""
        session, now_ns = self.flight.session, self.flight.now_ns
        session.receive(NAME, bytes(message.pack(self._packer)), now_ns, now_ns)
        answers = messages(session.take().get(NAME, b""))
        heard = len(self.flight.autopilot.heard)
        self.flight.fly(seconds)
        return answers + [m for _, m in self.flight.autopilot.heard[heard:]]

    def set(self, name: str, value: float, kind: int = 9) -> float:
        """What is answered to a write."""
        (answer,) = self.ask(mavlink2.MAVLink_param_set_message(*US, name.encode(), value, kind))
        assert (answer.get_type(), answer.param_id) == ("PARAM_VALUE", name)
        return float(answer.param_value)

    @property
    def config(self) -> Config:
        return self.flight.session.config


def test_the_whole_list_comes_paced_and_every_time_in_the_same_order() -> None:
    pilot = Pilot(url="/dev/ttyAMA0", baud=57600)
    lists = []
    for target in (197, 0):
        answers = pilot.ask(mavlink2.MAVLink_param_request_list_message(SYSTEM, target), 3.0)
        values = [m for m in answers if m.get_type() == "PARAM_VALUE"]
        lists.append([(m.param_id, m.param_index, m.param_value) for m in values])
        assert [m.param_index for m in values] == list(range(len(values)))
        assert {m.param_count for m in values} == {len(values)}
        assert {m.param_type for m in values} == {mavlink2.MAV_PARAM_TYPE_REAL32}
        assert all(len(m.param_id) <= 16 for m in values)
    assert lists[0] == lists[1]
    assert len(lists[0]) > 30


def test_a_slow_link_is_not_flooded_by_the_list() -> None:
    pilot = Pilot(url="/dev/ttyAMA0", baud=9600)
    answers = pilot.ask(mavlink2.MAVLink_param_request_list_message(SYSTEM, 197), 1.0)
    sent = sum(len(m.get_msgbuf()) for m in answers if m.get_type() == "PARAM_VALUE")
    # One a tick is the least there is.
    assert sent <= max(0.5 * 960, 31 * 45)


def test_reading_by_name_and_by_index() -> None:
    pilot = Pilot()
    (by_name,) = pilot.ask(mavlink2.MAVLink_param_request_read_message(*US, b"HLT_SIGMA_XY", -1))
    assert by_name.param_value == 0.5
    (by_index,) = pilot.ask(mavlink2.MAVLink_param_request_read_message(*US, b"", by_name.param_index))
    assert by_index.param_id == "HLT_SIGMA_XY"
    assert pilot.ask(mavlink2.MAVLink_param_request_read_message(*US, b"NO_SUCH", -1)) == []
    assert pilot.ask(mavlink2.MAVLink_param_request_read_message(*US, b"", 999)) == []


def test_a_write_is_answered_with_the_new_value_and_used() -> None:
    pilot = Pilot()
    assert pilot.set("HLT_SIGMA_XY", 0.3) == pytest.approx(0.3)
    # What was typed, not its float32 neighbour.
    assert pilot.config.health.max_sigma_xy == 0.3
    assert pilot.set("GATE_RESUME", 2.5) == 2.5
    assert pilot.config.mavlink.gate.resume_after == 2.5
    assert pilot.config.health.max_sigma_xy == 0.3
    changes = pilot.flight.session.take_changes()
    assert [parameter.name for parameter, _ in changes] == ["HLT_SIGMA_XY", "GATE_RESUME"]
    assert pilot.flight.session.take_changes() == []


@pytest.mark.parametrize(
    ("name", "bad", "old"),
    [
        ("HLT_SIGMA_XY", -1.0, 0.5),
        ("HLT_SIGMA_XY", 101.0, 0.5),
        ("HLT_SIGMA_XY", np.nan, 0.5),
        ("HLT_SIGMA_XY", np.inf, 0.5),
        ("HLT_MIN_SHARE", 0.7, 0.3),
        ("EST_CHOICE", 0.5, None),
        ("EST_CHOICE", 99.0, None),
        ("OUT_HEIGHT", 0.5, 0.0),
        ("OUT_HEIGHT", 2.0, 0.0),
        ("TAG_X", 20_000.0, -0.1),
        ("NLOS_EXCESS", 0.0, 0.5),
        ("NLOS_MEMORY", 61.0, 2.0),
        ("NLOS_POWER", -1.0, 8.0),
        ("NLOS_OBST_HGT", 101.0, 2.0),
    ],
)
def test_a_bad_write_is_answered_with_the_old_value(name: str, bad: float, old: float | None) -> None:
    pilot = Pilot()
    expected = list(ESTIMATORS).index("ekf") if old is None else old
    assert pilot.set(name, bad) == pytest.approx(expected)
    assert pilot.flight.session.take_changes() == []


def test_a_packed_integer_is_refused_not_misread() -> None:
    assert Pilot().set("HLT_SIGMA_XY", 2.0, mavlink2.MAV_PARAM_TYPE_INT32) == 0.5


def test_a_write_to_somebody_else_is_none_of_ours() -> None:
    pilot = Pilot()
    for target in ((SYSTEM, 1), (SYSTEM, 0), (99, 197)):
        assert pilot.ask(mavlink2.MAVLink_param_set_message(*target, b"HLT_SIGMA_XY", 1.0, 9)) == []
    assert pilot.config.health.max_sigma_xy == 0.5


def test_what_would_change_poses_counts_from_the_next_start_on() -> None:
    pilot = Pilot()
    other = float(list(ESTIMATORS).index("least_squares"))
    assert pilot.set("EST_CHOICE", other) == other
    assert pilot.set("LIDAR_YAW", 12.5) == 12.5
    assert pilot.config.pipeline.estimator == "ekf"
    changes = pilot.flight.session.take_changes()
    assert [setting_line(*change) for change in changes] == [
        "pipeline.estimator='least_squares'",
        "body.lidar_yaw_deg=12.5",
    ]
    assert not any(parameter.applies_at_once for parameter, _ in changes)


def test_thresholds_of_blocked_ranges_are_those_of_the_estimator_that_runs() -> None:
    for chosen in ("pf", "graph"):
        pilot = Pilot(pipeline__estimator=chosen)
        for name, value in (("NLOS_EXCESS", 0.8), ("NLOS_POWER", 6.5), ("NLOS_OBST_HGT", 1.2)):
            assert pilot.set(name, value) == pytest.approx(value)
        assert [setting_line(*change) for change in pilot.flight.session.take_changes()] == [
            f"estimator.{chosen}.nlos_excess=0.8",
            f"estimator.{chosen}.nlos_power=6.5",
            f"estimator.{chosen}.obstacle_height=1.2",
        ]
    without = mavlink2.MAVLink_param_request_read_message(*US, b"NLOS_EXCESS", -1)
    assert Pilot(pipeline__estimator="lidar_odometry").ask(without) == []


def test_a_start_without_coordinates_has_no_parameters_for_them() -> None:
    text = SITE.read_text(encoding="utf-8")
    for line in ("x = 1.5", "y = 1.2", "yaw_deg = 0.0"):
        text = text.replace(f"{line}\n", "")
    server = ParameterServer(config_from_toml(text, "site", ["start.known=false"]), no_change, no_alignment)
    server.receive(mavlink2.MAVLink_param_request_list_message(*US))
    listed = [str(m.param_id) for m in server.poll(1e6, 1.0)]
    assert len(listed) == len(server) > 30
    assert not any("START" in name for name in listed)


def test_what_waits_for_the_next_start_does_not_slip_in_with_what_counts_at_once() -> None:
    pilot = Pilot()
    pilot.set("OUT_HEADING", 0.0)
    pilot.set("LIDAR_YAW", 12.5)
    pilot.set("HLT_SIGMA_XY", 0.3)
    assert pilot.config.health.max_sigma_xy == 0.3
    assert pilot.config.mavlink.heading is True
    assert pilot.config.body.lidar_yaw_deg == 0.0


def test_every_parameter_is_a_setting_that_set_takes() -> None:
    config = load_config(SITE)
    lines: list[str] = []
    server = ParameterServer(config, lambda p, c: lines.append(setting_line(p, c)), no_alignment)
    names = []
    for index in range(len(server)):
        (answer,) = server.receive(mavlink2.MAVLink_param_request_read_message(*US, b"", index))
        names.append(answer.param_id.decode() if isinstance(answer.param_id, bytes) else answer.param_id)
        nearby = server.value(names[-1]) * 1.01 + 0.001
        write = mavlink2.MAVLink_param_set_message(*US, names[-1].encode(), nearby, 9)
        server.receive(write)
    assert len(set(names)) == len(names)
    assert len(lines) > 25
    changed = load_config(SITE, lines)
    assert changed.body.tag[0] == pytest.approx(-0.1)


def test_changes_are_kept_from_run_to_run(tmp_path: Path) -> None:
    path = tmp_path / "tuned"
    assert saved_settings(path) == []
    config = load_config(SITE, ["health.max_sigma_xy=0.4", "body.tag=[1.0, 2.0, 3.0]"])
    save_setting(path, setting_line(Parameter("HLT_SIGMA_XY", "health.max_sigma_xy"), config))
    save_setting(path, setting_line(Parameter("TAG_Y", "body.tag", 1), config))
    config = load_config(SITE, ["health.max_sigma_xy=0.6"])
    save_setting(path, setting_line(Parameter("HLT_SIGMA_XY", "health.max_sigma_xy"), config))
    again = load_config(SITE, saved_settings(path))
    assert again.health.max_sigma_xy == 0.6
    assert again.body.tag == (1.0, 2.0, 3.0)
    with pytest.raises(UserError, match="cannot write"):
        save_setting(tmp_path / "none" / "tuned", "a=1")


def test_our_version_is_told_and_other_commands_are_refused() -> None:
    pilot = Pilot()
    ask = mavlink2.MAVLink_command_long_message(*US, 512, 0, 148.0, 0, 0, 0, 0, 0, 0)
    ack, version = pilot.ask(ask)
    assert (ack.command, ack.result) == (512, mavlink2.MAV_RESULT_ACCEPTED)
    assert version.capabilities & mavlink2.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
    (ack,) = pilot.ask(mavlink2.MAVLink_command_long_message(*US, 400, 0, 1.0, 0, 0, 0, 0, 0, 0))
    assert (ack.command, ack.result) == (400, mavlink2.MAV_RESULT_UNSUPPORTED)


class TestAlignment:
    """ALIGN_COMPASS: the map's heading from the autopilot's compass, once."""

    def test_no_pose_is_sent_before_and_the_right_one_after(self) -> None:
        pilot = Pilot(align="compass")
        flight = pilot.flight
        # The robot looks 10 deg left of the map's x axis, which points 75 deg from north.
        flight.autopilot.heading = np.deg2rad(65.0)
        flight.fly(3.0)
        assert flight.autopilot.of("VISION_POSITION_ESTIMATE") == []
        pilot.set("ALIGN_COMPASS", 1.0)
        flight.fly(4.0)
        pose = flight.autopilot.of("VISION_POSITION_ESTIMATE")[-1]
        assert np.rad2deg(pose.yaw) == pytest.approx(65.0, abs=0.01)
        c, s = np.cos(np.deg2rad(75.0)), np.sin(np.deg2rad(75.0))
        assert (pose.x, pose.y) == pytest.approx((c + 2 * s, s - 2 * c), abs=1e-4)
        texts = [m.text for m in flight.autopilot.of("STATUSTEXT")]
        assert "map heading 75.0 deg by compass" in texts

    def test_never_again_once_our_heading_may_be_the_autopilots(self) -> None:
        pilot = Pilot(align="compass")
        pilot.flight.autopilot.heading = np.deg2rad(65.0)
        pilot.flight.fly(1.0)
        pilot.set("ALIGN_COMPASS", 1.0)
        pilot.flight.fly(4.0)
        pilot.flight.autopilot.heading = np.deg2rad(90.0)
        pilot.set("ALIGN_COMPASS", 1.0)
        pilot.flight.fly(4.0)
        pose = pilot.flight.autopilot.of("VISION_POSITION_ESTIMATE")[-1]
        assert np.rad2deg(pose.yaw) == pytest.approx(65.0, abs=0.01)
        assert any("restart first" in m.text for m in pilot.flight.autopilot.of("STATUSTEXT"))

    def test_a_surveyed_heading_is_not_overruled(self) -> None:
        pilot = Pilot()
        pilot.flight.fly(2.0)
        pilot.set("ALIGN_COMPASS", 1.0)
        pilot.flight.fly(4.0)
        assert np.rad2deg(pilot.flight.autopilot.of("VISION_POSITION_ESTIMATE")[-1].yaw) == pytest.approx(
            20.0
        )

    def test_an_unsteady_compass_is_not_believed(self) -> None:
        pilot = Pilot(align="compass")
        pilot.flight.fly(1.0)
        pilot.set("ALIGN_COMPASS", 1.0)
        for i in range(30):
            pilot.flight.autopilot.heading = np.deg2rad(40.0 * (i % 2))
            pilot.flight.fly(0.1)
        assert pilot.flight.session.map_heading is None
        assert any("unsteady" in m.text for m in pilot.flight.autopilot.of("STATUSTEXT"))


@pytest.mark.realtime
def test_pymavlinks_own_client_lists_sets_and_is_refused(capfd: pytest.CaptureFixture[str]) -> None:
    client = mavutil.mavlink_connection("udpin:127.0.0.1:0", source_system=255, source_component=190)
    address = client.port.getsockname()
    session = MavlinkSession(site(profile="ardupilot"))
    stop = threading.Event()

    def serve() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
            wire.connect(address)
            wire.settimeout(0.01)
            while not stop.is_set():
                now_ns = time.monotonic_ns()
                session.tick(planar(0, 0, 0, now_ns), OK, now_ns)
                with suppress(TimeoutError):
                    session.receive(NAME, wire.recv(4096), now_ns, now_ns)
                if data := session.take().get(NAME, b""):
                    wire.send(data)

    server = threading.Thread(target=serve)
    server.start()
    try:
        assert client.recv_match(type="HEARTBEAT", blocking=True, timeout=5)
        client.target_system, client.target_component = 1, 197
        client.param_fetch_all()
        end = time.monotonic() + 5.0
        while time.monotonic() < end and len(client.params) < len(session._parameters):
            client.recv_match(type="PARAM_VALUE", blocking=True, timeout=0.1)
        assert len(client.params) == len(session._parameters)
        table = mavparm.MAVParmDict()
        assert table.mavset(client, "HLT_SIGMA_XY", 0.25)
        assert session.config.health.max_sigma_xy == 0.25
        # Refused: the answer is there, with the value as it was.
        assert table.mavset(client, "HLT_SIGMA_XY", -3.0)
        assert client.params["HLT_SIGMA_XY"] == 0.25
    finally:
        stop.set()
        server.join()
        client.close()


def test_the_start_of_the_list_does_not_wait_for_a_tick_long_after() -> None:
    session = MavlinkSession(site(profile="ardupilot"))
    packer = mavlink2.MAVLink(None, srcSystem=255, srcComponent=190)
    session.receive(
        NAME, bytes(mavlink2.MAVLink_param_request_list_message(1, 197).pack(packer)), START_NS, START_NS
    )
    session.tick(None, OK, START_NS + 33_000_000)
    kinds = [m.get_type() for m in messages(session.take()[NAME])]
    assert kinds.count("PARAM_VALUE") > 10
