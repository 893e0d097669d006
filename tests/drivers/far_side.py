"""Devices at the far side of pseudo-terminals: they stream, answer, and can be unplugged."""

import os
import select
import termios
import threading
import tty
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeAlias

from pymavlink.dialects.v20 import common as mavlink2

from drivers.linktrack_frames import encode
from drivers.linktrack_types import NodeFrame2, NodeRange
from drivers.rplidar_protocol import (
    Command,
    DeviceInfo,
    Health,
    HealthStatus,
    RequestDecoder,
    encode_answer,
)

Behaviour: TypeAlias = Callable[[bytes], bytes]
"""Called every 20 ms with what the host sent meanwhile; returns what the device sends."""

NMEA_TEXT = b"$GNGGA,092725.00,4717.11,N,00833.91,E,1,08,1.01,499.6,M,48.0,M,,*5B\r\n"
GARBAGE = bytes(range(7, 256, 3))
SERIAL = "0123456789ABCDEF0123456789ABCDEF"


class Pty:
    """A pseudo-terminal under a name as udev gives it; nobody serves its far side."""

    def __init__(self, link: Path) -> None:
        self.link = link
        self.plug()

    def plug(self) -> None:
        """Make it, and the link to it."""
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)
        self.link.symlink_to(self.path)

    def unplug(self) -> None:
        """Let both vanish."""
        self.link.unlink()
        os.close(self.slave)
        os.close(self.master)


class Device(Pty):
    """A pseudo-terminal with a device at its far side.

    Args:
        link: name of the port.
        behaviour: what the device does.
        baud: at other rates it is not understood and understands nothing; None = it does not care.

    Attributes:
        received: everything that the host sent.
        speeds: rates that the host has set, as constants of termios.
    """

    def __init__(self, link: Path, behaviour: Behaviour, baud: int | None = None) -> None:
        self.received = b""
        self.speeds: set[int] = set()
        self._behaviour = behaviour
        self._speed = None if baud is None else getattr(termios, f"B{baud}")
        super().__init__(link)

    def plug(self) -> None:
        super().plug()
        os.set_blocking(self.master, False)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def unplug(self) -> None:
        self._stop.set()
        self._thread.join()
        super().unplug()

    def _serve(self) -> None:
        while not self._stop.wait(0.02):
            data = b""
            if select.select([self.master], [], [], 0)[0]:
                data = os.read(self.master, 4096)
            self.received += data
            self.speeds.add(termios.tcgetattr(self.slave)[5])
            is_understood = self._speed in (None, termios.tcgetattr(self.slave)[5])
            sent = self._behaviour(data if is_understood else b"")
            with suppress(BlockingIOError):
                os.write(self.master, sent if is_understood else GARBAGE[: len(sent)])


def silent(received: bytes) -> bytes:
    """Behaviour of what is not there, or switched off."""
    return b""


def sends(data: bytes) -> Behaviour:
    """Behaviour of a device that sends the same over and over."""

    def behaviour(received: bytes) -> bytes:
        return data

    return behaviour


def tag(node_id: int = 3) -> Behaviour:
    """Behaviour of a LinkTrack tag at 50 Hz."""
    zeros = (0.0, 0.0, 0.0)
    nodes = (NodeRange(1, 0, 2.5, -80.0, -78.0), NodeRange(1, 1, 3.5, -80.0, -78.0))
    frame = NodeFrame2(
        id=node_id,
        role=2,
        local_time_ms=0,
        system_time_ms=0,
        voltage=4.9,
        pos=zeros,
        vel=zeros,
        eop=zeros,
        gyro=zeros,
        acc=zeros,
        angle_deg=zeros,
        quat_wxyz=(1.0, 0.0, 0.0, 0.0),
        nodes=nodes,
    )
    return sends(encode(frame))


def lidar(status: HealthStatus = HealthStatus.GOOD, running_scan: bytes = b"") -> Behaviour:
    """Behaviour of an RPLIDAR A2M12 that answers.

    Args:
        status: of its health.
        running_scan: what it streams until it is asked anything.
    """
    requests = RequestDecoder()
    streaming = bool(running_scan)

    def behaviour(received: bytes) -> bytes:
        nonlocal streaming
        answers = b""
        for command, _ in requests.feed(received):
            streaming = False
            if command == Command.GET_INFO:
                answers += encode_answer(DeviceInfo(0x2C, (1, 32), 6, SERIAL))
            elif command == Command.GET_HEALTH:
                answers += encode_answer(Health(status, 0))
        return answers + running_scan * streaming

    return behaviour


def autopilot(system: int) -> Behaviour:
    """Behaviour of an autopilot that sends ten HEARTBEATs a second, to save the tests' time."""
    packer = mavlink2.MAVLink(None, srcSystem=system, srcComponent=1)
    calls = 0

    def behaviour(received: bytes) -> bytes:
        nonlocal calls
        calls += 1
        if calls % 5 != 2:
            return b""
        beat = mavlink2.MAVLink_heartbeat_message(
            mavlink2.MAV_TYPE_QUADROTOR, mavlink2.MAV_AUTOPILOT_PX4, 0, 0, mavlink2.MAV_STATE_STANDBY, 3
        )
        packer.seq = (packer.seq + 1) % 256
        return bytes(beat.pack(packer))

    return behaviour
