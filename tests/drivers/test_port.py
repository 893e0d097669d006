"""Ports: real pseudo-terminals and sockets; read whole, stamped, lost and found again."""

import os
import queue
import socket
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.errors import PortError
from drivers.port import Arrival, Port, PortAddress, PortEvent, PortStatus, SerialWire, parse_address

WAIT = 5.0


class Pty:
    """The device's side of a pseudo-terminal, reachable under a fixed name."""

    def __init__(self, link: Path) -> None:
        self._link = link
        self.plug()

    def plug(self) -> None:
        self.master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self._link.symlink_to(os.ttyname(self._slave))

    def unplug(self) -> None:
        self._link.unlink()
        os.close(self._slave)
        os.close(self.master)


@pytest.fixture
def pty(tmp_path: Path) -> Iterator[Pty]:
    device = Pty(tmp_path / "tty")
    yield device
    device.unplug()


@pytest.fixture
def events() -> queue.Queue[PortEvent]:
    return queue.Queue()


def open_port(address: PortAddress, events: queue.Queue[PortEvent]) -> Port:
    port = Port("uwb", address.url, lambda: SerialWire(address), events.put)
    port.start()
    return port


def status(events: queue.Queue[PortEvent]) -> PortStatus:
    event = events.get(timeout=WAIT)
    assert isinstance(event, PortStatus)
    return event


def received(events: queue.Queue[PortEvent], count: int) -> bytes:
    data = b""
    while len(data) < count:
        event = events.get(timeout=WAIT)
        assert isinstance(event, Arrival)
        assert 0 <= time.monotonic_ns() - event.stamp_ns < WAIT * 1e9
        data += event.data
    return data


def test_bytes_of_all_values_arrive_in_order_both_ways(
    tmp_path: Path, pty: Pty, events: queue.Queue[PortEvent]
) -> None:
    port = open_port(parse_address(f"{tmp_path}/tty?baud=115200"), events)
    assert status(events).is_open
    sent = bytes(range(256)) * 20
    for i in range(0, len(sent), 512):
        os.write(pty.master, sent[i : i + 512])
    assert received(events, len(sent)) == sent
    assert port.write(bytes(range(256)))
    assert os.read(pty.master, 1000) == bytes(range(256))
    port.close()
    assert not port.write(b"x")


def test_what_was_sent_before_opening_is_not_taken_for_new(
    tmp_path: Path, pty: Pty, events: queue.Queue[PortEvent]
) -> None:
    os.write(pty.master, b"stale")
    port = open_port(parse_address(f"{tmp_path}/tty"), events)
    assert status(events).is_open
    os.write(pty.master, b"fresh")
    assert received(events, 5) == b"fresh"
    port.close()


def test_unplugged_and_plugged_in_again(tmp_path: Path, pty: Pty, events: queue.Queue[PortEvent]) -> None:
    port = open_port(parse_address(f"{tmp_path}/tty"), events)
    assert status(events).is_open
    os.write(pty.master, b"before")
    assert received(events, 6) == b"before"
    pty.unplug()
    lost = status(events)
    assert not lost.is_open
    assert "lost" in lost.message
    missing = status(events)
    assert not missing.is_open
    assert "No such file" in missing.message
    pty.plug()
    assert status(events).is_open
    os.write(pty.master, b"after")
    assert received(events, 5) == b"after"
    port.close()


def test_a_missing_port_is_reported_once_and_waited_for(
    tmp_path: Path, events: queue.Queue[PortEvent]
) -> None:
    port = open_port(parse_address(f"{tmp_path}/tty"), events)
    message = status(events).message
    assert message == f"cannot open {tmp_path}/tty: No such file or directory; waiting for it"
    time.sleep(1.2)
    assert events.empty()
    device = Pty(tmp_path / "tty")
    assert status(events).is_open
    port.close()
    device.unplug()


def test_one_port_is_not_opened_twice(tmp_path: Path, pty: Pty, events: queue.Queue[PortEvent]) -> None:
    first = open_port(parse_address(f"{tmp_path}/tty"), events)
    assert status(events).is_open
    second = open_port(parse_address(f"{tmp_path}/tty"), events)
    assert "in use by another program" in status(events).message
    first.close()
    assert status(events).is_open
    second.close()


def test_a_socket_url(events: queue.Queue[PortEvent]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = open_port(parse_address(f"socket://127.0.0.1:{server.getsockname()[1]}"), events)
        peer, _ = server.accept()
        assert status(events).is_open
        peer.sendall(b"\x00\xff" * 3000)
        assert received(events, 6000) == b"\x00\xff" * 3000
        assert port.write(b"request")
        assert peer.recv(100) == b"request"
        peer.close()
        assert not status(events).is_open
        port.close()


def test_a_loop_url_gives_back_what_is_written(events: queue.Queue[PortEvent]) -> None:
    port = open_port(parse_address("loop://"), events)
    assert status(events).is_open
    assert port.write(b"echo")
    assert received(events, 4) == b"echo"
    port.close()


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("/dev/ttyUSB0", PortAddress("/dev/ttyUSB0", 921_600)),
        ("/dev/ttyUSB0?baud=256000", PortAddress("/dev/ttyUSB0", 256_000)),
        ("COM3?baud=115200", PortAddress("COM3", 115_200)),
        ("socket://host:7000", PortAddress("socket://host:7000", 921_600)),
        ("loop://?logging=debug", PortAddress("loop://?logging=debug", 921_600)),
    ],
)
def test_addresses(text: str, address: PortAddress) -> None:
    assert parse_address(text) == address


@pytest.mark.parametrize(
    "text", ["", "?baud=9600", "/dev/x?baud=", "/dev/x?baud=12", "/dev/x?speed=9600", "/dev/x?"]
)
def test_addresses_that_make_no_sense(text: str) -> None:
    with pytest.raises(PortError, match="port "):
        parse_address(text)
