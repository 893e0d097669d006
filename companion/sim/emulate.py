"""Emulated devices on pseudo-terminals, in real time: what `companion run` can open instead of hardware."""

import os
import tempfile
import threading
import time
import tty
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from companion.sim.devices import make_lines
from companion.sim.line import Line
from companion.sim.robot import Robot
from companion.sim.scenario import Scenario

POLL_PERIOD = 0.002
"""Time between looks at the devices [s]."""


class PtyPort:
    """A pseudo-terminal with a device on its far side, under a path that outlives unplugging.

    Args:
        path: what the host opens; a link to the pseudo-terminal that is there while the plug is in.
        line: to the device.
    """

    def __init__(self, path: Path, line: Line) -> None:
        self.path = path
        self.line = line
        self._master: int | None = None
        self._slave = -1

    def serve(self, now_ns: int) -> None:
        """Carry over what host and device have sent."""
        if not self.line.attached(now_ns):
            self.close()
            return
        if self._master is None:
            self._open()
        master = self._master
        assert master is not None
        with suppress(BlockingIOError):
            self.line.feed(os.read(master, 4096), now_ns)
        data = self.line.poll(now_ns)
        # When nobody reads: like a serial line, the pseudo-terminal loses what is not taken.
        with suppress(BlockingIOError):
            while data:
                data = data[os.write(master, data) :]

    def close(self) -> None:
        """Let the pseudo-terminal vanish."""
        if self._master is not None:
            self.path.unlink()
            os.close(self._slave)
            os.close(self._master)
            self._master = None

    def _open(self) -> None:
        # The device's side holds both ends open, so that it outlives a host that closes its own.
        self._master, self._slave = os.openpty()
        # Raw: a terminal would echo the scans back and turn some bytes into others.
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path.symlink_to(os.ttyname(self._slave))


class Emulator:
    """All devices of a scenario on pseudo-terminals; the walk begins when the host asks for scans.

    Args:
        scenario: to emulate.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.robot = Robot(scenario)
        self._folder = tempfile.TemporaryDirectory(prefix="companion-")
        now_ns = time.monotonic_ns()
        self.ports = {
            name: PtyPort(Path(self._folder.name) / name, line)
            for name, line in make_lines(self.robot, now_ns).items()
        }
        for port in self.ports.values():
            port.serve(now_ns)

    def run(self, stop: threading.Event, say: Callable[[str], None]) -> None:
        """Serve until `stop` is set.

        Args:
            stop: ends the emulation.
            say: takes one line for the user when something happens.
        """
        walking = over = False
        while not stop.wait(POLL_PERIOD):
            now_ns = time.monotonic_ns()
            for port in self.ports.values():
                port.serve(now_ns)
            if not walking and self.robot.seconds(now_ns) > 0.0:
                walking = True
                say("the host asked for scans: the walk begins")
            if not over and self.robot.arrived(now_ns):
                over = True
                say("the walk is over: the robot stands still, the sensors go on")

    def close(self) -> None:
        """Close the pseudo-terminals."""
        for port in self.ports.values():
            port.close()
        self._folder.cleanup()
