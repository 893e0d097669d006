"""Emulated devices on pseudo-terminals, in real time: what `companion run` can open instead of hardware."""

import os
import threading
import time
import tty
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from companion.sim.devices import Device, Robot, make_devices
from companion.sim.scenario import Scenario

POLL_PERIOD = 0.002
"""Time between looks at the devices [s]."""


@dataclass(frozen=True, slots=True)
class PtyPort:
    """A pseudo-terminal with a device on its far side.

    Attributes:
        name: sensor name in the site file.
        path: what the host opens.
        master: file descriptor of the device's side.
        slave: held open, so that the device outlives a host that closes its side.
        device: the emulated device.
    """

    name: str
    path: str
    master: int
    slave: int
    device: Device


class Emulator:
    """All devices of a scenario on pseudo-terminals; the walk begins when the host asks for scans.

    Args:
        scenario: to emulate.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.robot = Robot(scenario)
        self.ports = [
            _open_pty(name, device) for name, device in make_devices(self.robot, time.monotonic_ns()).items()
        ]

    def run(self, stop: threading.Event, say: Callable[[str], None]) -> None:
        """Serve until `stop` is set.

        Args:
            stop: ends the emulation.
            say: takes one line for the user when something happens.
        """
        walking = over = False
        while not stop.wait(POLL_PERIOD):
            now_ns = time.monotonic_ns()
            for port in self.ports:
                _serve(port, now_ns)
            if not walking and self.robot.seconds(now_ns) > 0.0:
                walking = True
                say("the host asked for scans: the walk begins")
            if not over and self.robot.arrived(now_ns):
                over = True
                say("the walk is over: the robot stands still, the sensors go on")

    def close(self) -> None:
        """Close the pseudo-terminals."""
        for port in self.ports:
            os.close(port.master)
            os.close(port.slave)


def _open_pty(name: str, device: Device) -> PtyPort:
    master, slave = os.openpty()
    # Raw: a terminal would echo the scans back and turn some bytes into others.
    tty.setraw(slave)
    os.set_blocking(master, False)
    return PtyPort(name, os.ttyname(slave), master, slave, device)


def _serve(port: PtyPort, now_ns: int) -> None:
    with suppress(BlockingIOError):
        port.device.feed(os.read(port.master, 4096), now_ns)
    data = port.device.poll(now_ns)
    # When nobody reads: like a serial line, the pseudo-terminal loses what is not taken.
    with suppress(BlockingIOError):
        while data:
            data = data[os.write(port.master, data) :]
