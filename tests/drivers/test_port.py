"""Ports: real pseudo-terminals and sockets; read whole, stamped, lost and found again."""

import errno
import os
import queue
import socket
import termios
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import serial

import drivers.port
from drivers.errors import PortError
from drivers.port import (
    Arrival,
    AutoAddress,
    OpenError,
    Port,
    PortAddress,
    PortEvent,
    PortStatus,
    Wire,
    parse_address,
)
from drivers.serial_line import SerialWire
from tests.drivers.far_side import Pty

WAIT = 5.0


@pytest.fixture
def pty(tmp_path: Path) -> Iterator[Pty]:
    device = Pty(tmp_path / "tty")
    yield device
    device.unplug()


@pytest.fixture
def events() -> queue.Queue[PortEvent]:
    return queue.Queue()


def open_port(text: str, events: queue.Queue[PortEvent]) -> Port:
    address = parse_address(text)
    assert isinstance(address, PortAddress)
    port = Port("uwb", address, lambda: SerialWire(address), events.put)
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
    port = open_port(f"{tmp_path}/tty?baud=115200", events)
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
    port = open_port(f"{tmp_path}/tty", events)
    assert status(events).is_open
    os.write(pty.master, b"fresh")
    assert received(events, 5) == b"fresh"
    port.close()


def test_unplugged_and_plugged_in_again(tmp_path: Path, pty: Pty, events: queue.Queue[PortEvent]) -> None:
    port = open_port(f"{tmp_path}/tty", events)
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


def test_a_link_that_moved_is_followed_when_the_port_is_lost(
    tmp_path: Path, pty: Pty, events: queue.Queue[PortEvent]
) -> None:
    port = open_port(f"{tmp_path}/tty", events)
    assert status(events).is_open
    other = Pty(tmp_path / "other")
    os.write(pty.master, b"one")
    assert received(events, 3) == b"one"
    pty.unplug()
    (tmp_path / "tty").symlink_to(other.path)
    assert "lost" in status(events).message
    assert status(events).is_open
    os.write(other.master, b"other")
    assert received(events, 5) == b"other"
    port.close()
    (tmp_path / "tty").unlink()
    pty.plug()
    other.unplug()


def test_a_missing_port_is_reported_once_and_waited_for(
    tmp_path: Path, events: queue.Queue[PortEvent], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drivers.port, "RETRY_PERIOD", 0.01)
    port = open_port(f"{tmp_path}/tty", events)
    message = status(events).message
    assert message.startswith(f"cannot open {tmp_path}/tty: No such file or directory; waiting for it (there")
    time.sleep(0.1)
    assert events.empty()
    device = Pty(tmp_path / "tty")
    assert status(events).is_open
    port.close()
    device.unplug()


def failures(events: queue.Queue[PortEvent], *texts: str) -> Callable[[], Wire]:
    """Opens nothing: fails with these texts, then with the last one for ever."""
    left = list(texts)

    def open_wire() -> Wire:
        text = left.pop(0) if len(left) > 1 else left[0]
        raise OpenError(text, lambda: f"mend {text}")

    return open_wire


@pytest.mark.parametrize(
    ("errors", "told"),
    [
        (("gone", "gone"), ["gone"]),
        (("denied", "gone"), ["gone"]),
        (("gone", "gone", "denied", "gone"), ["gone"]),
        (("gone", "gone", "denied", "denied"), ["gone", "denied"]),
        (("a", "b", "c", "d", "e", "d", "e", "f"), ["c", "f"]),
    ],
)
def test_an_error_is_told_when_it_lasts_and_a_first_one_soon(
    errors: tuple[str, ...],
    told: list[str],
    events: queue.Queue[PortEvent],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(drivers.port, "RETRY_PERIOD", 0.001)
    port = Port("uwb", "tty", failures(events, *errors), events.put)
    port.start()
    for text in told:
        assert status(events).message == f"{text}; waiting for it (mend {text})"
    time.sleep(0.05)
    port.close()
    assert events.empty()


def once(error: Exception) -> Callable[..., int]:
    """Raises the error at the first call and gives 0 afterwards."""
    errors = [error]

    def call(*_: object) -> int:
        if errors:
            raise errors.pop()
        return 0

    return call


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.EIO, "Input/output error"),
        OSError(errno.ENODEV, "No such device"),
        serial.SerialException("device reports readiness to read but returned no data"),
        termios.error(errno.EIO, "Input/output error"),
        TypeError("argument must be an int, or have a fileno() method."),
        ValueError("file descriptor cannot be a negative integer (-1)"),
    ],
    ids=repr,
)
def test_whatever_reading_a_vanished_device_raises_it_is_opened_again(
    error: Exception,
    tmp_path: Path,
    pty: Pty,
    events: queue.Queue[PortEvent],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(serial.Serial, "in_waiting", property(once(error)))
    port = open_port(f"{tmp_path}/tty", events)
    assert status(events).is_open
    os.write(pty.master, b"x")
    lost = status(events)
    assert not lost.is_open
    assert "lost: " in lost.message
    assert status(events).is_open
    os.write(pty.master, b"y")
    assert received(events, 1) == b"y"
    port.close()


def test_a_device_that_vanishes_while_it_is_opened_is_tried_again(
    tmp_path: Path, pty: Pty, events: queue.Queue[PortEvent], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(termios, "tcsetattr", once(termios.error(errno.EIO, "Input/output error")))
    port = open_port(f"{tmp_path}/tty", events)
    assert status(events).is_open
    port.close()


def test_nothing_leaks_over_many_unplugs(
    tmp_path: Path, pty: Pty, events: queue.Queue[PortEvent], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drivers.port, "RETRY_PERIOD", 0.01)
    before = len(os.listdir("/proc/self/fd")), threading.active_count()
    port = open_port(f"{tmp_path}/tty", events)
    for _ in range(20):
        while not status(events).is_open:
            pass
        pty.unplug()
        assert "lost" in status(events).message
        pty.plug()
    port.close()
    assert (len(os.listdir("/proc/self/fd")), threading.active_count()) == before


def test_a_port_is_closed_while_it_waits_for_its_device(
    tmp_path: Path, events: queue.Queue[PortEvent]
) -> None:
    before = len(os.listdir("/proc/self/fd")), threading.active_count()
    port = open_port(f"{tmp_path}/tty", events)
    assert not status(events).is_open
    port.close()
    assert (len(os.listdir("/proc/self/fd")), threading.active_count()) == before


class SlowWire:
    """A line that takes its time to open."""

    def __init__(self, opening: threading.Event, may_open: threading.Event) -> None:
        opening.set()
        may_open.wait(WAIT)
        self.closed = False

    def read(self) -> bytes:
        return b"late"

    def write(self, data: bytes) -> None: ...

    def close(self) -> None:
        self.closed = True


def test_a_line_that_opens_after_closing_is_closed_without_a_word(events: queue.Queue[PortEvent]) -> None:
    opening, may_open, closing = threading.Event(), threading.Event(), threading.Event()
    wires: list[SlowWire] = []

    def open_wire() -> Wire:
        wires.append(SlowWire(opening, may_open))
        return wires[-1]

    port = Port("uwb", "slow", open_wire, events.put, closing)
    port.start()
    assert opening.wait(WAIT)
    closer = threading.Thread(target=port.close)
    closer.start()
    assert closing.wait(WAIT)
    may_open.set()
    closer.join(WAIT)
    assert not closer.is_alive()
    assert [wire.closed for wire in wires] == [True]
    assert events.empty()


def test_a_socket_url(events: queue.Queue[PortEvent]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = open_port(f"socket://127.0.0.1:{server.getsockname()[1]}", events)
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
    port = open_port("loop://", events)
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
        ("/dev/automatic", PortAddress("/dev/automatic", 921_600)),
        ("auto", AutoAddress("", None)),
        ("auto?baud=115200", AutoAddress("", 115_200)),
        ("auto:/dev/ttyUSB?", AutoAddress("/dev/ttyUSB?", None)),
        ("auto:/dev/ttyUSB[0-3]?baud=115200", AutoAddress("/dev/ttyUSB[0-3]", 115_200)),
    ],
)
def test_addresses(text: str, address: PortAddress | AutoAddress) -> None:
    assert parse_address(text) == address


@pytest.mark.parametrize(
    "text",
    [
        *("", "?baud=9600", "/dev/x?baud=", "/dev/x?baud=12", "/dev/x?speed=9600", "/dev/x?"),
        *("auto:", "auto?baud=12", "auto?speed=9600", "auto:?baud=9600"),
    ],
)
def test_addresses_that_make_no_sense(text: str) -> None:
    with pytest.raises(PortError, match="port "):
        parse_address(text)
