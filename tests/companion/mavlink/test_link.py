"""The wires to the autopilot: UDP, TCP, serial; lost and found again, had alone, and silent on stdout."""

import os
import queue
import socket
import tty
from pathlib import Path

import pytest

from companion.errors import UserError
from companion.mavlink.link import NAME, wire_opener
from drivers.port import Arrival, Port, PortEvent, PortStatus

WAIT = 5.0


@pytest.fixture
def events() -> queue.Queue[PortEvent]:
    return queue.Queue()


def link_to(url: str, events: queue.Queue[PortEvent]) -> Port:
    link = Port(NAME, url, wire_opener(url, 115_200, "mavlink.url"), events.put)
    link.start()
    return link


def wait_open(events: queue.Queue[PortEvent], is_open: bool = True) -> None:
    while True:
        event = events.get(timeout=WAIT)
        if isinstance(event, PortStatus) and event.is_open is is_open:
            return


def received(events: queue.Queue[PortEvent]) -> bytes:
    while True:
        event = events.get(timeout=WAIT)
        if isinstance(event, Arrival):
            assert event.name == "mavlink"
            return event.data


def test_udp_both_ways(events: queue.Queue[PortEvent]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.bind(("127.0.0.1", 0))
        autopilot.settimeout(WAIT)
        link = link_to(f"udpout:127.0.0.1:{autopilot.getsockname()[1]}", events)
        wait_open(events)
        assert link.write(b"pose")
        data, address = autopilot.recvfrom(100)
        assert data == b"pose"
        autopilot.sendto(b"heartbeat", address)
        assert received(events) == b"heartbeat"
        link.close()
        assert not link.write(b"pose")


def test_tcp_is_opened_again_when_the_other_side_restarts(events: queue.Queue[PortEvent]) -> None:
    server = socket.create_server(("127.0.0.1", 0))
    address = server.getsockname()
    link = link_to(f"tcp:127.0.0.1:{address[1]}", events)
    peer, _ = server.accept()
    wait_open(events)
    peer.sendall(b"first")
    assert received(events) == b"first"
    peer.close()
    server.close()
    wait_open(events, False)
    with socket.create_server(address) as server:
        peer, _ = server.accept()
        wait_open(events)
        assert link.write(b"again")
        assert peer.recv(100) == b"again"
        link.close()
        peer.close()


def test_a_serial_line_that_comes_later(tmp_path: Path, events: queue.Queue[PortEvent]) -> None:
    path = tmp_path / "autopilot"
    link = link_to(str(path), events)
    status = events.get(timeout=WAIT)
    assert isinstance(status, PortStatus)
    assert status.message.startswith(f"cannot open {path}: No such file or directory; waiting for it")
    assert not link.write(b"pose")
    master, slave = os.openpty()
    tty.setraw(slave)
    path.symlink_to(os.ttyname(slave))
    wait_open(events)
    os.write(master, b"heartbeat")
    assert received(events) == b"heartbeat"
    assert link.write(b"pose")
    assert os.read(master, 100) == b"pose"
    link.close()
    os.close(master)
    os.close(slave)


def test_a_serial_line_that_another_program_reads_is_not_opened(events: queue.Queue[PortEvent]) -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    first = link_to(os.ttyname(slave), events)
    wait_open(events)
    link_to(f"{os.ttyname(slave)},57600", events).close()
    second = link_to(os.ttyname(slave), events)
    status = events.get(timeout=WAIT)
    assert isinstance(status, PortStatus)
    assert "in use by another program" in status.message
    second.close()
    first.close()
    os.close(master)
    os.close(slave)


def test_a_udp_peer_that_is_not_there_yet_or_no_longer(events: queue.Queue[PortEvent]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        address = probe.getsockname()
    link = link_to(f"udpout:127.0.0.1:{address[1]}", events)
    wait_open(events)
    for _ in range(5):
        link.write(b"nobody")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.bind(address)
        autopilot.settimeout(WAIT)
        while not link.write(b"pose"):
            pass
        assert autopilot.recv(100) == b"pose"
    assert events.empty()
    link.close()


def test_a_port_of_ours_follows_one_udp_peer_at_a_time(events: queue.Queue[PortEvent]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        address = probe.getsockname()
    link = link_to(f"udpin:127.0.0.1:{address[1]}", events)
    wait_open(events)
    assert not link.write(b"nobody has spoken")
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
    ):
        autopilot.sendto(b"heartbeat", address)
        assert received(events) == b"heartbeat"
        stranger.sendto(b"me too", address)
        autopilot.sendto(b"again", address)
        assert received(events) == b"again"
        autopilot.settimeout(WAIT)
        assert link.write(b"pose")
        assert autopilot.recv(100) == b"pose"
    link.close()


def test_a_tcp_port_of_ours_takes_one_client_after_another(events: queue.Queue[PortEvent]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        address = probe.getsockname()
    link = link_to(f"tcpin:127.0.0.1:{address[1]}", events)
    wait_open(events)
    for word in (b"first", b"second"):
        with socket.create_connection(address) as client:
            client.sendall(word)
            assert received(events) == word
            assert link.write(b"pose")
            assert client.recv(100) == b"pose"
    link.close()


def test_a_host_that_does_not_exist_is_waited_for(events: queue.Queue[PortEvent]) -> None:
    link = link_to("udpout:no-such-host.invalid:14550", events)
    status = events.get(timeout=WAIT)
    assert isinstance(status, PortStatus)
    assert status.message.startswith("cannot open udpout:no-such-host.invalid:14550: ")
    assert "Unknown error" not in status.message
    link.close()


@pytest.mark.parametrize(
    "url", ["udpout:nowhere", "udpin:a:b:c", "tcp:host:port", "tcp:host:0", "auto", "/dev/ttyACM0,fast"]
)
def test_a_device_string_that_makes_no_sense(url: str) -> None:
    with pytest.raises(UserError, match="is no device string"):
        wire_opener(url, 115_200, "mavlink.url")


def test_a_file_is_no_device(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    path.write_bytes(b"")
    with pytest.raises(UserError, match="is a file"):
        wire_opener(str(path), 115_200, "mavlink.url")
