"""A device on a serial line or any pyserial URL: read in a thread, stamped on arrival, reopened when lost.

This is the only input and output on the sensors' side. Bytes go to a sink (a queue) as `Arrival`, changes
of the port as `PortStatus`; nothing here knows what the bytes mean.
"""

import errno
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeAlias
from urllib.parse import parse_qsl

import serial

from drivers.errors import PortError

RETRY_PERIOD = 0.5
"""Time between attempts to open a port [s]."""
READ_TIMEOUT = 0.1
"""Longest wait for a byte [s]; bounds how long closing takes."""
NETWORK_BATCH = 0.005
"""How long bytes of a network URL are gathered [s]: it cannot say how many are waiting."""
DEFAULT_BAUD = 921_600


@dataclass(frozen=True, slots=True)
class Arrival:
    """Bytes of one read.

    Attributes:
        name: of the port.
        stamp_ns: host's monotonic time right after the read.
        data: the bytes.
    """

    name: str
    stamp_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class PortStatus:
    """A port was opened, was lost, or is still missing.

    Attributes:
        name: of the port.
        stamp_ns: host's monotonic time.
        is_open: whether bytes can flow.
        message: one line for the operator.
    """

    name: str
    stamp_ns: int
    is_open: bool
    message: str


PortEvent: TypeAlias = Arrival | PortStatus
Sink: TypeAlias = Callable[[PortEvent], None]


@dataclass(frozen=True, slots=True)
class PortAddress:
    """Where a device is.

    Attributes:
        url: device path or pyserial URL.
        baud: of a serial line.
    """

    url: str
    baud: int


def parse_address(text: str) -> PortAddress:
    """Read `/dev/ttyUSB0?baud=921600`, `COM3?baud=115200`, `socket://host:port`, `loop://`, ...

    Raises:
        PortError: an option that is not known, or a baud rate that is none.
    """
    url, question, query = text.partition("?")
    if "://" in text:
        # The options of a URL are pyserial's own.
        return PortAddress(text, DEFAULT_BAUD)
    options = dict(parse_qsl(query, keep_blank_values=True))
    baud = options.pop("baud", str(DEFAULT_BAUD))
    if not url or (question and (options or not query)):
        raise PortError(f"port {text!r}: write DEVICE or DEVICE?baud=RATE")
    if not baud.isdigit() or not 1200 <= int(baud) <= 4_000_000:
        raise PortError(f"port {text!r}: baud must be a number from 1200 to 4000000, got {baud!r}")
    return PortAddress(url, int(baud))


class Wire(Protocol):
    """An open line to a device."""

    def read(self) -> bytes:
        """Wait a fraction of a second for bytes; raises OSError when the line is lost."""
        ...

    def write(self, data: bytes) -> None:
        """Send bytes as one write; raises OSError when the line is lost."""
        ...

    def close(self) -> None:
        """Give the line up."""
        ...


class Port:
    """A reader thread round one device, which opens it again when it is lost.

    Args:
        name: goes with everything that is sent to the sink.
        label: where the device is, for messages.
        open_wire: opens the line; raises PortError when that fails.
        sink: takes arrivals and status changes, from the reader's thread; must not block.
    """

    def __init__(self, name: str, label: str, open_wire: Callable[[], Wire], sink: Sink) -> None:
        self._name = name
        self._label = label
        self._open_wire = open_wire
        self._sink = sink
        self._wire: Wire | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"port-{name}", daemon=True)

    def start(self) -> None:
        """Begin opening and reading."""
        self._thread.start()

    def write(self, data: bytes) -> bool:
        """Send bytes as one write; False when the port is not open or refuses them."""
        wire = self._wire
        if wire is None:
            return False
        try:
            wire.write(data)
        except OSError:
            # The reader meets the same fault and opens the port again.
            return False
        return True

    def close(self) -> None:
        """Stop reading and close the device."""
        self._closing.set()
        self._thread.join(timeout=2.0)

    def _run(self) -> None:
        reported = ""
        while not self._closing.is_set():
            try:
                self._wire = self._open_wire()
            except PortError as error:
                if str(error) != reported:
                    reported = str(error)
                    self._status(False, f"{reported}; waiting for it")
                self._closing.wait(RETRY_PERIOD)
                continue
            reported = ""
            self._status(True, f"{self._label} open")
            try:
                self._read(self._wire)
            except OSError as error:
                self._status(False, f"{self._label} lost: {error}; waiting for it")
                self._closing.wait(RETRY_PERIOD)
            finally:
                wire, self._wire = self._wire, None
                wire.close()

    def _read(self, wire: Wire) -> None:
        while not self._closing.is_set():
            data = wire.read()
            if data:
                self._sink(Arrival(self._name, time.monotonic_ns(), data))

    def _status(self, is_open: bool, message: str) -> None:
        self._sink(PortStatus(self._name, time.monotonic_ns(), is_open, message))


class SerialWire:
    """A serial line, or what a pyserial URL stands for.

    Args:
        address: where the device is.

    Raises:
        PortError: it cannot be opened; the message says why.
    """

    def __init__(self, address: PortAddress) -> None:
        self._is_network = "socket://" in address.url
        timeout = NETWORK_BATCH if self._is_network else READ_TIMEOUT
        try:
            self._device = serial.serial_for_url(
                address.url, do_not_open=True, baudrate=address.baud, timeout=timeout, write_timeout=0.5
            )
            if isinstance(self._device, serial.Serial):
                # Two readers of one line each get half of the bytes.
                self._device.exclusive = True
                # An RPLIDAR A1 runs its motor while DTR is off; no other device here uses the line.
                self._device.dtr = False
            self._device.open()
        except (OSError, ValueError) as error:
            raise PortError(f"cannot open {address.url}: {reason(error)}") from error

    def read(self) -> bytes:
        """What is there, or the next byte when there is nothing yet."""
        if self._is_network:
            return bytes(self._device.read(4096))
        data = self._device.read(1)
        return bytes(data + self._device.read(self._device.in_waiting))

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._device.write(data)

    def close(self) -> None:
        """Close the line."""
        self._device.close()


def reason(error: Exception) -> str:
    """The operating system's own words: pyserial wraps them, or gives only a number."""
    number = error.errno if isinstance(error, OSError) else None
    if number is None:
        return str(error)
    if number == errno.EAGAIN:
        return "in use by another program"
    return os.strerror(number)
