"""The session over real wires to an autopilot in another process: UDP, TCP and a pseudo-terminal."""

import json
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from companion.mavlink.link import NAME, wire_opener
from companion.mavlink.session import MavlinkSession
from drivers.port import Arrival, Port, PortEvent
from tests.companion.mavlink.flight import OK, planar, site
from tests.companion.mavlink.scripted_autopilot import SYSTEM

TICK = 1 / 30

pytestmark = pytest.mark.realtime


class Far:
    """The autopilot's process, and what it says that it has heard."""

    def __init__(self, kind: str) -> None:
        command = [sys.executable, "-m", "tests.companion.mavlink.scripted_autopilot", kind]
        self._process = subprocess.Popen(
            command, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=1
        )
        assert self._process.stdout is not None
        self.address = self._process.stdout.readline().strip()
        self.heard: list[dict[str, Any]] = []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.heard.append(json.loads(line))

    def tell(self, command: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(command + "\n")

    def of(self, kind: str) -> list[dict[str, Any]]:
        return [message for message in self.heard if message["mavpackettype"] == kind]

    def close(self) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait(timeout=5)
        self._reader.join()
        self._process.stdout.close()


@contextmanager
def far(kind: str) -> Iterator[Far]:
    process = Far(kind)
    try:
        yield process
    finally:
        process.close()


class Near:
    """Session and port, as the live loop drives them."""

    def __init__(self, url: str, **settings: Any) -> None:
        self.session = MavlinkSession(site(mavlink__gate={"resume_after": 0.2}, **settings))
        self._events: queue.Queue[PortEvent] = queue.Queue()
        self._port = Port(NAME, url, wire_opener(url, 921_600, "mavlink.url"), self._events.put)
        self._port.start()
        self._due = time.monotonic()

    def run(self, until: Callable[[], bool]) -> None:
        """Go on until something is so, at most for 20 s."""
        end = time.monotonic() + 20.0
        while not until():
            now = time.monotonic()
            assert now < end
            if now >= self._due:
                self._due = max(self._due + TICK, now)
                now_ns = time.monotonic_ns()
                self.session.tick(planar(1.25, -2.5, 10.0, now_ns, resets=0), OK, now_ns)
            try:
                event = self._events.get(timeout=max(self._due - time.monotonic(), 0.0005))
            except queue.Empty:
                event = None
            if isinstance(event, Arrival):
                self.session.receive(NAME, event.data, event.stamp_ns, time.monotonic_ns())
            if data := self.session.take().get(NAME):
                self._port.write(data)

    def close(self) -> None:
        self._port.close()


@pytest.mark.parametrize("kind", ["udp", "tcp", "pty"])
def test_every_field_over_a_real_wire_and_what_happens_when_it_breaks(
    kind: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with far(kind) as autopilot:
        near = Near(autopilot.address, site__origin={"lat": 48.0, "lon": 11.0})
        near.run(lambda: len(autopilot.of("VISION_POSITION_ESTIMATE")) >= 30)
        assert len(autopilot.of("SET_GPS_GLOBAL_ORIGIN")) == 1
        if kind == "tcp":
            autopilot.tell("drop")
            dropped_ns = time.monotonic_ns()
            near.run(lambda: autopilot.heard[-1]["at_ns"] > dropped_ns + 500_000_000)
        if kind == "udp":
            autopilot.tell("reboot")
            near.run(lambda: len(autopilot.of("SET_GPS_GLOBAL_ORIGIN")) == 2)
        near.close()
    assert all(message["v2"] for message in autopilot.heard)
    poses = autopilot.of("VISION_POSITION_ESTIMATE")
    assert {tuple(message["from"]) for message in poses} == {(SYSTEM, 197)}
    c, s = np.cos(np.deg2rad(30)), np.sin(np.deg2rad(30))
    expected = [1.25 * c - 2.5 * s, 1.25 * s + 2.5 * c, -0.3, 0.0, 0.0, np.deg2rad(20)]
    variances = [0.01 * c * c + 0.02 * s * s, 0.01 * s * s + 0.02 * c * c, 0.0025, 0.003, 0.003, 0.004]
    for message in poses:
        fields = [message[key] for key in ("x", "y", "z", "roll", "pitch", "yaw")]
        assert fields == pytest.approx(expected, abs=1e-6)
        assert [message["covariance"][i] for i in (0, 6, 11, 15, 18, 20)] == pytest.approx(
            variances, rel=1e-5
        )
        assert message["reset_counter"] == 0
        # One machine, one monotonic clock: the stamp is before the arrival, and not by much.
        assert 0 <= message["at_ns"] - message["usec"] * 1000 < 500_000_000
    at = np.array([message["at_ns"] for message in poses[:25]])
    assert np.median(np.diff(at)) == pytest.approx(TICK * 1e9, rel=0.2)
    offset_ns = near.session.clock.offset_ns
    assert offset_ns is not None
    assert near.session.clock.round_trip_ns is not None
    assert 0 < near.session.clock.round_trip_ns < 50_000_000
    assert capfd.readouterr().out == ""
