"""The wires that MAVLink runs on: serial line, UDP, TCP. Bytes only; a `Port` opens them again when lost.

pymavlink's own connections are not used: they print to stdout when a line dies, reopen by themselves, and
open a serial line that another program may be reading.
"""

import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from companion.errors import UserError
from drivers.errors import PortError
from drivers.port import AutoAddress, OpenError, PortAddress, Wire, parse_address
from drivers.serial_line import SerialWire

NAME = "mavlink"
"""Name of the autopilot's link where sensors have theirs: in the log and in messages."""
GROUND = "mavlink_ground"
"""The same of the ground station's link."""
READ_TIMEOUT = 0.1
"""Longest wait for bytes [s]."""
CONNECT_TIMEOUT = 2.0
"""Longest wait for the other side of a TCP connection [s]."""
PEER_TIMEOUT = 3.0
"""A UDP peer that was silent for so long [s] may be followed by another."""
_LONGEST_DATAGRAM = 65_536
_NETWORK = ("udp", "udpin", "udpout", "tcp", "tcpin")


@dataclass(frozen=True, slots=True)
class NetworkAddress:
    """A socket as pymavlink's device strings write it.

    Attributes:
        kind: udpin (udp is the same), udpout, tcp or tcpin.
        host: name or number.
        port: number.
    """

    kind: str
    host: str
    port: int

    def __str__(self) -> str:
        return f"{self.kind}:{self.host}:{self.port}"


def link_address(url: str, baud: int) -> NetworkAddress | PortAddress:
    """Read `udpout:host:port`, `udpin:...`, `tcp:...`, `tcpin:...`, `/dev/ttyAMA0`, `/dev/ttyAMA0,57600`.

    Args:
        url: device string.
        baud: of a serial line whose string names none.

    Raises:
        ValueError: it makes no sense; says why.
    """
    kind, colon, rest = url.partition(":")
    if kind in _NETWORK and colon:
        host, colon, port = rest.rpartition(":")
        if not colon or not host or ":" in host or not port.isdigit() or not 0 < int(port) < 65_536:
            raise ValueError(f"write {kind}:HOST:PORT with a port from 1 to 65535")
        return NetworkAddress("udpin" if kind == "udp" else kind, host, int(port))
    if Path(url).is_file():
        raise ValueError("it is a file; give a device such as udpout:host:14550")
    device, comma, digits = url.rpartition(",")
    try:
        if comma:
            url = f"{device}?baud={digits}"
        address = parse_address(url if "?" in url else f"{url}?baud={baud}")
    except PortError as error:
        raise ValueError(str(error)) from error
    if isinstance(address, AutoAddress):
        raise ValueError("an autopilot is not looked for, name its port")
    return address


def capacity(url: str, baud: int) -> float | None:
    """Bytes a second that a serial line carries, at ten bits a byte; None for a socket and for none at all.

    Args:
        url: device string that makes sense.
        baud: of a serial line whose string names none.
    """
    address = link_address(url, baud) if url else None
    return address.baud / 10.0 if isinstance(address, PortAddress) else None


def wire_opener(url: str, baud: int, key: str) -> Callable[[], Wire]:
    """What opens the link, now and whenever it is lost.

    Args:
        url: device string, see `link_address`.
        baud: of a serial line.
        key: name of the setting that holds the string, for the message.

    Raises:
        UserError: the device string makes no sense. A device that is only missing is waited for.
    """
    try:
        address = link_address(url, baud)
    except ValueError as error:
        raise UserError(f"{key}: {url!r} is no device string: {error}") from error
    if isinstance(address, PortAddress):
        return partial(SerialWire, address)
    kinds: dict[str, Callable[[NetworkAddress], Wire]] = {
        "udpin": UdpWire,
        "udpout": UdpWire,
        "tcp": TcpWire,
        "tcpin": TcpServerWire,
    }
    return partial(kinds[address.kind], address)


class UdpWire:
    """Datagrams to one peer: the named one, or the one that speaks to our port.

    A peer that is gone is no fault of the wire: it goes on, and the peer is there again when it speaks.

    Args:
        address: udpout or udpin.

    Raises:
        PortError: the host is unknown, or the port is in use.
    """

    def __init__(self, address: NetworkAddress) -> None:
        self._listens = address.kind == "udpin"
        self._peer: tuple[str, int] | None = None
        self._heard_at = 0.0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(READ_TIMEOUT)
        try:
            if self._listens:
                self._socket.bind((address.host, address.port))
            else:
                self._socket.connect((address.host, address.port))
        except OSError as error:
            self._socket.close()
            raise _cannot_open(address, error) from error

    def read(self) -> bytes:
        """Bytes that came within a tenth of a second, of the peer alone."""
        try:
            data, sender = self._socket.recvfrom(_LONGEST_DATAGRAM)
        except (TimeoutError, ConnectionRefusedError):
            return b""
        if self._listens:
            now = time.monotonic()
            if sender != self._peer and self._peer is not None and now - self._heard_at < PEER_TIMEOUT:
                return b""
            self._peer, self._heard_at = sender, now
        return data

    def write(self, data: bytes) -> None:
        """Send a datagram, if there is anyone to send it to."""
        if not self._listens:
            try:
                self._socket.send(data)
            except ConnectionRefusedError:
                # What an earlier datagram met; this one has not been sent.
                self._socket.send(data)
        elif self._peer is None:
            raise ConnectionError("nobody has spoken yet")
        else:
            self._socket.sendto(data, self._peer)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class TcpWire:
    """A TCP connection to a server.

    Args:
        address: of the server.

    Raises:
        PortError: nobody answers there.
    """

    def __init__(self, address: NetworkAddress) -> None:
        try:
            self._socket = socket.create_connection((address.host, address.port), CONNECT_TIMEOUT)
        except OSError as error:
            raise _cannot_open(address, error) from error
        _prepare(self._socket)

    def read(self) -> bytes:
        """Bytes that came within a tenth of a second."""
        return _receive(self._socket)

    def write(self, data: bytes) -> None:
        """Send bytes."""
        _send(self._socket, data)

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


class TcpServerWire:
    """One client at a time on a port of ours.

    Args:
        address: to listen on.

    Raises:
        PortError: the port is in use, or the host is none of ours.
    """

    def __init__(self, address: NetworkAddress) -> None:
        self._client: socket.socket | None = None
        try:
            self._server = socket.create_server((address.host, address.port))
        except OSError as error:
            raise _cannot_open(address, error) from error
        self._server.settimeout(READ_TIMEOUT)

    def read(self) -> bytes:
        """Bytes that came within a tenth of a second; a client that leaves may be followed by another."""
        if self._client is None:
            try:
                client, _ = self._server.accept()
            except TimeoutError:
                return b""
            _prepare(client)
            self._client = client
        try:
            return _receive(self._client)
        except OSError:
            client, self._client = self._client, None
            client.close()
            return b""

    def write(self, data: bytes) -> None:
        """Send bytes to the client."""
        if self._client is None:
            raise ConnectionError("nobody has connected yet")
        _send(self._client, data)

    def close(self) -> None:
        """Close the port and the connection."""
        if self._client is not None:
            self._client.close()
        self._server.close()


def _prepare(connection: socket.socket) -> None:
    connection.settimeout(READ_TIMEOUT)
    # Poses must not wait for one another.
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def _receive(connection: socket.socket) -> bytes:
    try:
        data = connection.recv(_LONGEST_DATAGRAM)
    except TimeoutError:
        return b""
    if not data:
        raise ConnectionError("closed by the other side")
    return data


def _send(connection: socket.socket, data: bytes) -> None:
    try:
        connection.sendall(data)
    except TimeoutError:
        # Half a frame may be out: nothing that follows would make sense.
        connection.shutdown(socket.SHUT_RDWR)
        raise


def _cannot_open(address: NetworkAddress, error: OSError) -> OpenError:
    # Not `reason`: an unknown host has a number of its own, which is no errno.
    return OpenError(f"cannot open {address}: {error.strerror or error}", lambda: "")
