"""An autopilot that does what a test tells it and keeps all that it hears; pymavlink packs and parses.

Free of I/O, so that it serves in memory with simulated time. As a program it is a process of its own:

    python -m tests.companion.mavlink.scripted_autopilot udp|tcp|pty [KEY_HEX]

Its first line says where it is; then every message comes out as a line of JSON, and lines on its input are
commands: `reboot`, `drop` (the TCP connection).
"""

import json
import os
import select
import socket
import sys
import time
import tty
from typing import Any

from pymavlink.dialects.v20 import all as mavlink2

SYSTEM = 7
"""Not 1, so that taking it over shows."""
UPTIME_NS = 3_600_000_000_000
"""How long it had been running when it is first asked."""


class ScriptedAutopilot:
    """The far side of the autopilot's link.

    Args:
        now_ns: time at which it is there.
        kind: MAV_AUTOPILOT.
        system: its system id.
        key: to sign with and ask signatures by.
    """

    def __init__(
        self,
        now_ns: int,
        kind: int = mavlink2.MAV_AUTOPILOT_ARDUPILOTMEGA,
        system: int = SYSTEM,
        key: bytes | None = None,
    ) -> None:
        self.kind = kind
        self.ends = mavlink2.MAVLink(None, srcSystem=system, srcComponent=1)
        self.ends.robust_parsing = True
        if key is not None:
            self.ends.signing.secret_key = key
            self.ends.signing.sign_outgoing = True
            self.ends.signing.timestamp = 10**12
        self.heard: list[tuple[int, Any]] = []
        self.boot_ns = now_ns - UPTIME_NS
        self.origin: tuple[int, int] | None = None
        self.refuses_origin = 0
        self.heading = 0.0
        self.intervals: dict[int, float] = {}
        self.parameters: dict[str, tuple[float, int]] = {}
        self.read_only: set[str] = set()
        self.deaf_to = 0
        self._due: dict[str, int] = {}
        self._out = bytearray()

    def say(self, message: Any) -> None:
        """Put a message into what goes out."""
        self._out += message.pack(self.ends)
        self.ends.seq = (self.ends.seq + 1) % 256

    def reboot(self, now_ns: int) -> None:
        """Forget everything and count from 0."""
        self.boot_ns = now_ns
        self.origin, self.intervals = None, {}

    def boot_clock_ns(self, now_ns: int) -> int:
        return now_ns - self.boot_ns

    def feed(self, data: bytes, now_ns: int) -> None:
        """Take bytes and answer them."""
        for message in self.ends.parse_buffer(data) or []:
            self.heard.append((now_ns, message))
            match message.get_type():
                case "TIMESYNC" if message.tc1 == 0:
                    self.say(mavlink2.MAVLink_timesync_message(self.boot_clock_ns(now_ns), message.ts1))
                case "PARAM_REQUEST_READ" | "PARAM_SET" if message.param_id in self.parameters:
                    self._answer_parameter(message)
                case "SET_GPS_GLOBAL_ORIGIN" if message.target_system == self.ends.srcSystem:
                    if self.refuses_origin:
                        self.refuses_origin -= 1
                    else:
                        self.origin = (message.latitude, message.longitude)
                case "COMMAND_LONG" if message.command == mavlink2.MAV_CMD_SET_MESSAGE_INTERVAL:
                    self.intervals[int(message.param1)] = message.param2 * 1e-6
                case "COMMAND_LONG" if message.command == mavlink2.MAV_CMD_REQUEST_MESSAGE and self.origin:
                    self.say(mavlink2.MAVLink_gps_global_origin_message(*self.origin, 0))

    def _answer_parameter(self, message: Any) -> None:
        name = message.param_id
        value, kind = self.parameters[name]
        if self.deaf_to:
            self.deaf_to -= 1
            return
        if message.get_type() == "PARAM_SET" and name not in self.read_only:
            value = message.param_value
            self.parameters[name] = (value, kind)
        self.say(mavlink2.MAVLink_param_value_message(name.encode(), value, kind, 999, 0))

    def poll(self, now_ns: int) -> bytes:
        """What is due: HEARTBEAT, and messages that were asked for."""
        boot_ms = self.boot_clock_ns(now_ns) // 1_000_000
        if self._is_due("heartbeat", 1.0, now_ns):
            self.say(mavlink2.MAVLink_heartbeat_message(2, self.kind, 0, 0, 3, 3))
        for number, interval in self.intervals.items():
            if self._is_due(str(number), interval, now_ns):
                self._stream(number, boot_ms)
        data = bytes(self._out)
        self._out.clear()
        return data

    def of(self, kind: str) -> list[Any]:
        """Messages of one kind that were heard."""
        return [message for _, message in self.heard if message.get_type() == kind]

    def _stream(self, number: int, boot_ms: int) -> None:
        match number:
            case mavlink2.MAVLINK_MSG_ID_SYSTEM_TIME:
                self.say(mavlink2.MAVLink_system_time_message(0, boot_ms))
            case mavlink2.MAVLINK_MSG_ID_ATTITUDE:
                self.say(mavlink2.MAVLink_attitude_message(boot_ms, 0.1, 0.2, self.heading, 0, 0, 0))
            case mavlink2.MAVLINK_MSG_ID_RAW_IMU:
                self.say(
                    mavlink2.MAVLink_raw_imu_message(boot_ms * 1000, 10, 20, -1000, 100, 200, 300, 0, 0, 0)
                )
            case mavlink2.MAVLINK_MSG_ID_HIGHRES_IMU:
                rates = (0.1, 0.2, -9.8, 0.01, 0.02, 0.03)
                rest = (0, 0, 0, 0, 0, 0, 0, 63)
                self.say(mavlink2.MAVLink_highres_imu_message(boot_ms * 1000, *rates, *rest))
            case mavlink2.MAVLINK_MSG_ID_DISTANCE_SENSOR:
                self.say(mavlink2.MAVLink_distance_sensor_message(boot_ms, 5, 700, 123, 0, 0, 25, 4))

    def _is_due(self, what: str, interval: float, now_ns: int) -> bool:
        due_ns = self._due.get(what, 0)
        if now_ns < due_ns:
            return False
        step_ns = round(interval * 1e9)
        self._due[what] = due_ns + step_ns if now_ns - due_ns < step_ns else now_ns + step_ns
        return True


class _Transport:
    """One end of a wire in this process; peers come and go."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.peer: Any = None
        if kind == "pty":
            self.master, slave = os.openpty()
            tty.setraw(slave)
            os.set_blocking(self.master, False)
            self.address = os.ttyname(slave)
            self._slave = slave
        elif kind == "udp":
            self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self.socket.bind(("127.0.0.1", 0))
            self.address = f"udpout:127.0.0.1:{self.socket.getsockname()[1]}"
        else:
            self.socket = socket.create_server(("127.0.0.1", 0))
            self.address = f"tcp:127.0.0.1:{self.socket.getsockname()[1]}"

    def fileno(self) -> int:
        if self.kind == "pty":
            return self.master
        return int((self.peer if self.kind == "tcp" and self.peer else self.socket).fileno())

    def read(self) -> bytes:
        if self.kind == "pty":
            return os.read(self.master, 65536)
        if self.kind == "udp":
            data, self.peer = self.socket.recvfrom(65536)
            return data
        if self.peer is None:
            self.peer, _ = self.socket.accept()
            return b""
        data = self.peer.recv(65536)
        if not data:
            self.drop()
        return bytes(data)

    def write(self, data: bytes) -> None:
        if self.kind == "pty":
            os.write(self.master, data)
        elif self.kind == "udp" and self.peer:
            self.socket.sendto(data, self.peer)
        elif self.kind == "tcp" and self.peer:
            self.peer.sendall(data)

    def drop(self) -> None:
        if self.kind == "tcp" and self.peer:
            self.peer.close()
        if self.kind != "pty":
            self.peer = None


def _tell(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    """Serve one link until the input ends."""
    transport = _Transport(sys.argv[1])
    key = bytes.fromhex(sys.argv[2]) if len(sys.argv) > 2 else None
    autopilot = ScriptedAutopilot(time.monotonic_ns(), key=key)
    _tell(transport.address)
    while True:
        ready, _, _ = select.select([transport, sys.stdin], [], [], 0.002)
        now_ns = time.monotonic_ns()
        if sys.stdin in ready:
            words = sys.stdin.readline().split()
            if not words:
                return
            if words[0] == "reboot":
                autopilot.reboot(now_ns)
            elif words[0] == "drop":
                transport.drop()
        if transport in ready:
            autopilot.feed(transport.read(), now_ns)
        if data := autopilot.poll(now_ns):
            transport.write(data)
        for at_ns, message in autopilot.heard:
            fields = {k: v for k, v in message.to_dict().items() if not isinstance(v, bytearray)}
            fields |= {"at_ns": at_ns, "from": [message.get_srcSystem(), message.get_srcComponent()]}
            fields["v2"] = message.get_msgbuf()[0] == 0xFD
            _tell(json.dumps(fields))
        autopilot.heard.clear()


if __name__ == "__main__":
    main()
