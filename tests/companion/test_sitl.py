"""Flying on our pose alone: a simulated vehicle that tells the truth in SIMSTATE, and a log played to it."""

import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink2
from typer.testing import CliRunner

from companion.cli import app
from companion.follow import FollowScore
from companion.mavlink.pose_out import ned_from_map
from companion.sim.followed import FollowedTrajectory
from companion.sitl import place
from tests.companion.mavlink.scripted_autopilot import ScriptedAutopilot
from tests.conftest import SCENARIO

METRES_PER_DEGREE = 111_319.5
SPEED = 0.6


class Sitl(ScriptedAutopilot):
    """A vehicle that drives ahead as soon as it has poses, and believes them."""

    LAT, LON, YAW = -35.363, 149.165, np.deg2rad(118.0)

    def __init__(self) -> None:
        super().__init__(time.monotonic_ns())
        self._moves_since_ns: int | None = None
        self._now_ns = 0

    def poll(self, now_ns: int) -> bytes:
        self._now_ns = now_ns
        if self._moves_since_ns is None and len(self.of("VISION_POSITION_ESTIMATE")) > 10:
            self._moves_since_ns = now_ns
        return super().poll(now_ns)

    @property
    def driven(self) -> float:
        return 0.0 if self._moves_since_ns is None else SPEED * (self._now_ns - self._moves_since_ns) * 1e-9

    def _stream(self, number: int, boot_ms: int) -> None:
        if number == mavlink2.MAVLINK_MSG_ID_SIMSTATE:
            north, east = self.driven * np.cos(self.YAW), self.driven * np.sin(self.YAW)
            lat = self.LAT + north / METRES_PER_DEGREE
            lon = self.LON + east / (METRES_PER_DEGREE * np.cos(np.deg2rad(self.LAT)))
            place_ = (round(lat * 1e7), round(lon * 1e7))
            self.say(mavlink2.MAVLink_simstate_message(0, 0, self.YAW, 0, 0, -9.8, 0, 0, 0, *place_))
        elif number == mavlink2.MAVLINK_MSG_ID_LOCAL_POSITION_NED and self.of("VISION_POSITION_ESTIMATE"):
            pose = self.of("VISION_POSITION_ESTIMATE")[-1]
            self.say(mavlink2.MAVLink_local_position_ned_message(boot_ms, pose.x, pose.y, 0, 0, 0, 0))
        elif number == mavlink2.MAVLINK_MSG_ID_EKF_STATUS_REPORT:
            flags = 831 if self.of("VISION_POSITION_ESTIMATE") else 167
            self.say(mavlink2.MAVLink_ekf_status_report_message(flags, 0, 0, 0, 0, 0))
        else:
            super()._stream(number, boot_ms)


@contextmanager
def served(autopilot: ScriptedAutopilot) -> Iterator[str]:
    """The autopilot behind a TCP port, one client after another."""
    stop = threading.Event()
    server = socket.create_server(("127.0.0.1", 0))
    server.settimeout(0.05)

    def serve() -> None:
        while not stop.is_set():
            try:
                client, _ = server.accept()
            except TimeoutError:
                continue
            client.settimeout(0.002)
            with client:
                while not stop.is_set():
                    try:
                        data = client.recv(65536)
                        if not data:
                            break
                        autopilot.feed(data, time.monotonic_ns())
                    except TimeoutError:
                        pass
                    except OSError:
                        break
                    client.sendall(autopilot.poll(time.monotonic_ns()))

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield f"tcp:127.0.0.1:{server.getsockname()[1]}"
    finally:
        stop.set()
        thread.join()
        server.close()


@pytest.mark.realtime
def test_a_vehicle_is_followed_wherever_it_stands(tmp_path: Path) -> None:
    sitl = Sitl()
    with served(sitl) as url:
        arguments = ["sitl", "--connect", url, "--world", str(SCENARIO), "--seconds", "6"]
        result = CliRunner().invoke(app, [*arguments, "--out", str(tmp_path / "run")])
    assert result.exit_code == 0, result.output
    assert sitl.driven > 0.5
    ours = re.search(r"companion: \d+ poses, RMSE ([\d.]+) m", result.output)
    theirs = re.search(r"autopilot: \d+ positions, RMSE [\d.]+ m, median ([\d.]+) m", result.output)
    assert ours is not None
    assert theirs is not None
    assert float(ours[1]) < 0.25
    assert float(theirs[1]) < 0.25
    assert "flags 831" in result.output
    # Where the vehicle stands is known to it too: its origin is the map's.
    assert sitl.origin is not None
    poses = sitl.of("VISION_POSITION_ESTIMATE")
    assert np.rad2deg(poses[-1].yaw) == pytest.approx(118.0, abs=5.0)
    lat = sitl.origin[0] / 1e7 + poses[0].x / METRES_PER_DEGREE
    assert (lat - Sitl.LAT) * METRES_PER_DEGREE == pytest.approx(0.0, abs=0.4)


@pytest.mark.realtime
def test_a_log_is_played_to_an_autopilot(short_log: Path) -> None:
    autopilot = Sitl()
    with served(autopilot) as url:
        result = CliRunner().invoke(app, ["replay", str(short_log), "--mavlink", url, "--speed", "5"])
    assert result.exit_code == 0, result.output
    poses = autopilot.of("VISION_POSITION_ESTIMATE")
    assert len(poses) > 20
    # Five times 30 Hz is more than ArduPilot takes: some are left out.
    assert np.all(np.diff([m.usec for m in poses]) >= 20_000)
    assert re.search(r"autopilot: \d+ positions, RMSE 0\.[0-4]", result.output)


@given(
    x=st.floats(-50, 50),
    y=st.floats(-50, 50),
    mark_yaw=st.floats(-3, 3),
    yaw=st.floats(-3, 3),
    lat=st.floats(-60, 60),
    ahead=st.floats(-20, 20),
)
def test_the_world_lies_round_the_vehicle(
    x: float, y: float, mark_yaw: float, yaw: float, lat: float, ahead: float
) -> None:
    def truth(north: float, east: float) -> mavlink2.MAVLink_message:
        lon = 10.0 + east / (METRES_PER_DEGREE * np.cos(np.deg2rad(lat)))
        degrees = round((lat + north / METRES_PER_DEGREE) * 1e7), round(lon * 1e7)
        return mavlink2.MAVLink_simstate_message(0, 0, yaw, 0, 0, 0, 0, 0, 0, *degrees)

    placement = place(truth(0, 0), np.array([x, y, mark_yaw]))
    begin = placement.map_pose(truth(0, 0))
    assert begin[:2] == pytest.approx([x, y], abs=0.02)
    assert np.cos(begin[2] - mark_yaw) == pytest.approx(1.0, abs=1e-6)
    there = placement.map_pose(truth(ahead * np.cos(yaw), ahead * np.sin(yaw)))
    # What is ahead of the vehicle is ahead of the mark.
    assert there[0] - begin[0] == pytest.approx(ahead * np.cos(mark_yaw), abs=0.05)
    assert there[1] - begin[1] == pytest.approx(ahead * np.sin(mark_yaw), abs=0.05)
    assert np.abs(ned_from_map(placement.heading)[:2, :2] @ (there - begin)[:2]) == pytest.approx(
        np.abs([ahead * np.cos(yaw), ahead * np.sin(yaw)]), abs=0.05
    )


def test_a_followed_walk_goes_on_for_a_moment_and_then_stands() -> None:
    walk = FollowedTrajectory(np.array([1.0, 0.0, 3.1]))
    for i in range(1, 51):
        walk.hear(i * 0.02, np.array([1.0 + 0.01 * i, 0.0, 3.1 + 0.002 * i]))
    walk.hear(0.5, np.array([99.0, 99.0, 0.0]))
    assert walk.at(np.array([0.1])).pose[0, 0] == pytest.approx(1.05)
    assert walk.at(np.array([1.1])).pose[0, 0] == pytest.approx(1.55, abs=1e-6)
    assert walk.at(np.array([1.1])).yaw_rate[0] == pytest.approx(0.1, abs=1e-6)
    assert walk.at(np.array([50.0])).pose[0, 0] == pytest.approx(1.75, abs=1e-6)
    assert abs(walk.at(np.array([1.0])).pose[0, 2]) <= np.pi


def test_an_autopilot_without_a_position_is_told() -> None:
    score = FollowScore(lambda _: np.zeros(2))
    assert "no position" in score.lines()[0]
    score.hear(mavlink2.MAVLink_ekf_status_report_message(167, 0, 0, 0, 0, 0), 0)
    score.hear(mavlink2.MAVLink_ekf_status_report_message(831, 0, 0, 0, 0, 0), 0)
    score.hear(mavlink2.MAVLink_local_position_ned_message(0, 0.3, 0.4, 0, 0, 0, 0), 0)
    lines = score.lines()
    assert "RMSE 0.500 m" in lines[0]
    assert "absolute position" in lines[1]
    assert "a position 50% of the time" in lines[1]
