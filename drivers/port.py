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
from typing import TypeAlias
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


class Port:
    """A reader thread round one device.

    Args:
        name: goes with everything that is sent to the sink.
        address: where the device is.
        sink: takes arrivals and status changes, from the reader's thread; must not block.
    """

    def __init__(self, name: str, address: PortAddress, sink: Sink) -> None:
        self._name = name
        self._address = address
        self._sink = sink
        self._device: serial.SerialBase | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"port-{name}", daemon=True)

    def start(self) -> None:
        """Begin opening and reading."""
        self._thread.start()

    def write(self, data: bytes) -> bool:
        """Send bytes as one write; False when the port is not open or refuses them."""
        device = self._device
        if device is None:
            return False
        try:
            device.write(data)
        except (OSError, serial.SerialException):
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
                self._device = _open(self._address)
            except PortError as error:
                if str(error) != reported:
                    reported = str(error)
                    self._status(False, f"{reported}; waiting for it")
                self._closing.wait(RETRY_PERIOD)
                continue
            reported = ""
            self._status(True, f"{self._address.url} open")
            try:
                self._read(self._device)
            except (OSError, serial.SerialException) as error:
                self._status(False, f"{self._address.url} lost: {error}; waiting for it")
                self._closing.wait(RETRY_PERIOD)
            finally:
                device, self._device = self._device, None
                device.close()

    def _read(self, device: serial.SerialBase) -> None:
        is_network = "socket://" in self._address.url
        if is_network:
            device.timeout = NETWORK_BATCH
        while not self._closing.is_set():
            if is_network:
                data = device.read(4096)
            else:
                data = device.read(1)
                data += device.read(device.in_waiting)  # type: ignore[attr-defined]
            if data:
                self._sink(Arrival(self._name, time.monotonic_ns(), bytes(data)))

    def _status(self, is_open: bool, message: str) -> None:
        self._sink(PortStatus(self._name, time.monotonic_ns(), is_open, message))


def _open(address: PortAddress) -> serial.SerialBase:
    try:
        device = serial.serial_for_url(
            address.url,
            do_not_open=True,
            baudrate=address.baud,
            timeout=READ_TIMEOUT,
            write_timeout=0.5,
        )
        if isinstance(device, serial.Serial):
            # Two readers of one line each get half of the bytes.
            device.exclusive = True
            # An RPLIDAR A1 runs its motor while DTR is off; no other device here uses the line.
            device.dtr = False
        device.open()
    except (OSError, serial.SerialException, ValueError) as error:
        raise PortError(f"cannot open {address.url}: {_reason(error)}") from error
    return device


def _reason(error: Exception) -> str:
    """The operating system's own words: pyserial wraps them, or gives only a number."""
    number = error.errno if isinstance(error, OSError) else None
    if number is None:
        return str(error)
    if number == errno.EAGAIN:
        return "in use by another program"
    return os.strerror(number)
