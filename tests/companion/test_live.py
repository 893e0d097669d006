"""The process as a user runs it: emulated devices in one terminal, `companion run` in another."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink2

from companion.log import Direction, Log, RawChunk
from companion.replay import config_of, replay, tum_line
from companion.sim.autopilot import ned_pose
from tests.conftest import SITE, write_scenario

AUTOPILOT = 42
WATCHED = 8.0
"""Seconds of poses that are looked at."""

pytestmark = pytest.mark.realtime


def companion(*arguments: str, stdout: int | None = None, stderr: int | None = None) -> subprocess.Popen[str]:
    # Unbuffered: the ports are printed to a pipe and the emulator goes on.
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    command = [sys.executable, "-m", "companion", *arguments]
    return subprocess.Popen(command, text=True, env=environment, stdout=stdout, stderr=stderr)


@contextmanager
def stopped(process: subprocess.Popen[str]) -> Iterator[subprocess.Popen[str]]:
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.wait(timeout=10)
        for stream in (process.stdout, process.stderr):
            if stream is not None:
                stream.close()


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Receiver:
    """A pymavlink application that is an autopilot."""

    def __init__(self, port: int) -> None:
        self._connection = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}")
        self._parser = mavlink2.MAVLink(None)
        self._packer = mavlink2.MAVLink(None, srcSystem=AUTOPILOT, srcComponent=1)

    def take(self, seconds: float) -> list[tuple[float, mavlink2.MAVLink_message]]:
        """Messages of some time with their arrival; heartbeats go back meanwhile."""
        heard = []
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if not self._connection.select(0.2):
                continue
            data = self._connection.recv()
            now = time.monotonic()
            heard += [(now, message) for message in self._parser.parse_buffer(data or b"") or []]
            beat = mavlink2.MAVLink_heartbeat_message(
                mavlink2.MAV_TYPE_QUADROTOR, mavlink2.MAV_AUTOPILOT_PX4, 0, 0, 0, 3
            )
            self._connection.write(bytes(beat.pack(self._packer)))
        return heard

    def close(self) -> None:
        self._connection.close()


def of(
    heard: list[tuple[float, mavlink2.MAVLink_message]], kind: str
) -> list[tuple[float, mavlink2.MAVLink_message]]:
    return [(at, message) for at, message in heard if message.get_type() == kind]


def test_emulate_and_run(tmp_path: Path) -> None:
    udp = free_udp_port()
    receiver = Receiver(udp)
    ports = {name: tmp_path / name for name in ("uwb", "lidar")}
    folder = tmp_path / "run"
    run = companion(
        *("run", "--site", str(SITE), "--mavlink", f"udpout:127.0.0.1:{udp}", "--out", str(folder)),
        *(f"--set=sensor.{name}.port={path}" for name, path in ports.items()),
        stderr=subprocess.PIPE,
    )
    emulate = companion("emulate", str(write_scenario(tmp_path)), "--seed", "4", stdout=subprocess.PIPE)
    with stopped(emulate), stopped(run):
        # Nothing is plugged in yet: no pose.
        while not receiver.take(0.5):
            assert run.poll() is None
        kinds = {message.get_type() for _, message in receiver.take(2.5)}
        assert kinds - {"TIMESYNC", "COMMAND_LONG", "STATUSTEXT"} == {"HEARTBEAT"}
        assert emulate.stdout is not None
        for _ in ports:
            name, tty = emulate.stdout.readline().split()
            ports[name].symlink_to(tty)
        while not of(receiver.take(0.5), "VISION_POSITION_ESTIMATE"):
            assert run.poll() is None
        heard = receiver.take(WATCHED)
        run.send_signal(signal.SIGINT)
        assert run.stderr is not None
        said = run.stderr.read()
        assert run.wait(timeout=10) == 0
    receiver.close()

    assert {(m.get_srcSystem(), m.get_srcComponent()) for _, m in heard} == {(AUTOPILOT, 197)}
    beats = of(heard, "HEARTBEAT")
    assert len(beats) == pytest.approx(WATCHED, abs=1.1)
    assert all((m.type, m.autopilot) == (18, 8) for _, m in beats)
    poses = of(heard, "VISION_POSITION_ESTIMATE")
    rate = (len(poses) - 1) / (poses[-1][0] - poses[0][0])
    # A busy machine misses ticks of the 30 Hz; it never sends more of them.
    assert 5.0 < rate < 33.0

    received = [ned_pose(message) for _, message in poses]
    assert all(np.linalg.eigvalsh(pose.cov)[0] > 0.0 for pose in received)
    # The map's x axis points 30 deg east of north, and the first leg goes along it.
    first = next(p for p in received if np.hypot(*(p.position - received[0].position)[:2]) > 1.0)
    north, east, down = first.position - received[0].position
    assert np.rad2deg(np.arctan2(east, north)) == pytest.approx(30.0, abs=5.0)
    assert np.rad2deg(first.roll_pitch_yaw[2]) == pytest.approx(30.0, abs=5.0)
    assert (first.position[2], down) == pytest.approx((-0.30, 0.0))
    # At its end the robot has turned left, that is against the compass.
    assert np.rad2deg(received[-1].roll_pitch_yaw[2]) < 0.0

    assert f"cannot open {ports['uwb']}: No such file or directory; waiting for it" in said
    assert "health: ok" in said
    check_log(folder)


def check_log(folder: Path) -> None:
    """The log holds both directions and gives the poses of the run again, byte for byte."""
    log = Log(folder / "raw.mcap")
    ways = {(r.source, r.direction) for r in log if isinstance(r, RawChunk)}
    assert ways == {
        ("uwb", Direction.IN),
        *((name, way) for name in ("lidar", "mavlink") for way in Direction),
    }
    config = config_of(log, [])
    assert (folder / "config.toml").read_text() == log.config_toml == config.to_toml()
    again = "".join(tum_line(pose) for pose in replay(log, config, ["ekf"]).poses["ekf"])
    assert log.complete
    assert (folder / "poses.tum").read_text() == again


def test_a_killed_run_leaves_a_log_that_replays(tmp_path: Path) -> None:
    ports = {name: tmp_path / name for name in ("uwb", "lidar")}
    emulate = companion("emulate", str(write_scenario(tmp_path)), stdout=subprocess.PIPE)
    with stopped(emulate):
        assert emulate.stdout is not None
        for _ in ports:
            name, tty = emulate.stdout.readline().split()
            ports[name] = Path(tty)
        run = companion(
            *("run", "--site", str(SITE), "--mavlink", "", "--out", str(tmp_path / "run")),
            *(f"--set=sensor.{name}.port={path}" for name, path in ports.items()),
            stderr=subprocess.DEVNULL,
        )
        poses = tmp_path / "run" / "poses.tum"
        while not (poses.exists() and poses.read_text().count("\n") > 60):
            assert run.poll() is None
            time.sleep(0.1)
        run.kill()
        run.wait(timeout=10)
    log = Log(tmp_path / "run" / "raw.mcap")
    result = replay(log, config_of(log, []), ["ekf"])
    assert not log.complete
    # Ticks are due at records: what was to come after the last one may have been given out, too.
    written = poses.read_text().splitlines(keepends=True)
    again = [tum_line(pose) for pose in result.poses["ekf"]]
    both = min(len(again), len(written) - 1)
    assert both > 50
    assert again[:both] == written[:both]
