"""A device on a serial line or any pyserial URL: read in a thread, stamped on arrival, reopened when lost.

This and the wires it reads are the only input and output on the sensors' side. Bytes go to a sink (an
`Inbox`) as `Arrival`, changes of the port as `PortStatus`; nothing here knows what the bytes mean.
"""

import errno
import os
import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeAlias
from urllib.parse import parse_qsl

from drivers.errors import PortError

RETRY_PERIOD = 0.2
"""Time between attempts to open a port [s]."""
CLOSE_TIMEOUT = 2.0
"""How long closing waits for an attempt to open that is under way [s]."""
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

    def __str__(self) -> str:
        return self.url


@dataclass(frozen=True, slots=True)
class AutoAddress:
    """A device that is to be looked for.

    Attributes:
        pattern: of the paths that may be looked at; empty = every USB serial adapter.
        baud: of the line; None = the rates that the driver names.
    """

    pattern: str
    baud: int | None

    def __str__(self) -> str:
        return f"auto:{self.pattern}" if self.pattern else "auto"


def parse_address(text: str) -> PortAddress | AutoAddress:
    """Read `/dev/ttyUSB0?baud=921600`, `COM3`, `socket://host:port`, `auto`, `auto:/dev/ttyUSB*?baud=115200`.

    Raises:
        PortError: an option that is not known, or a baud rate that is none.
    """
    if "://" in text:
        # The options of a URL are pyserial's own.
        return PortAddress(text, DEFAULT_BAUD)
    if auto := re.fullmatch(r"auto(?::(?P<pattern>(?!\?baud=).+?))?(?:\?baud=(?P<baud>.*))?", text):
        given = auto["baud"]
        return AutoAddress(auto["pattern"] or "", None if given is None else _baud(given, text))
    url, question, query = text.partition("?")
    options = dict(parse_qsl(query, keep_blank_values=True))
    baud = options.pop("baud", str(DEFAULT_BAUD))
    if not url or url.startswith("auto:") or (question and (options or not query)):
        raise PortError(f"port {text!r}: write DEVICE, DEVICE?baud=RATE, auto or auto:PATTERN")
    return PortAddress(url, _baud(baud, text))


def _baud(digits: str, text: str) -> int:
    if not digits.isdigit() or not 1200 <= int(digits) <= 4_000_000:
        raise PortError(f"port {text!r}: baud must be a number from 1200 to 4000000, got {digits!r}")
    return int(digits)


class OpenError(PortError):
    """A port cannot be opened now.

    Args:
        message: one line that says why.
        advise: says what to do about it; called only when someone is told, since it looks about the machine.
    """

    def __init__(self, message: str, advise: Callable[[], str]) -> None:
        super().__init__(message)
        self.advise = advise


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
        label: its str() says in messages where the device is.
        open_wire: opens the line; raises PortError when that fails.
        sink: takes arrivals and status changes, from the reader's thread; must not block.
        closing: set when the port is closed; for an `open_wire` that takes long and should give up then.
    """

    def __init__(
        self,
        name: str,
        label: object,
        open_wire: Callable[[], Wire],
        sink: Sink,
        closing: threading.Event | None = None,
    ) -> None:
        self._name = name
        self._label = label
        self._open_wire = open_wire
        self._sink = sink
        self._wire: Wire | None = None
        self._wire_lock = threading.Lock()
        self._closing = closing or threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"port-{name}", daemon=True)

    def start(self) -> None:
        """Begin opening and reading."""
        self._thread.start()

    def write(self, data: bytes) -> bool:
        """Send bytes as one write; False when the port is not open or refuses them."""
        # Without the lock a line could be closed, and its number given to another file, before the write.
        with self._wire_lock:
            if self._wire is None:
                return False
            try:
                self._wire.write(data)
            except OSError:
                # The reader meets the same fault and opens the port again.
                return False
        return True

    def close(self) -> None:
        """Stop reading and close the device; an attempt to open it that hangs is left to end by itself."""
        self._closing.set()
        self._thread.join(timeout=CLOSE_TIMEOUT)

    def _run(self) -> None:
        reported = met = ""
        tries = 0
        while not self._closing.is_set():
            try:
                wire = self._open_wire()
            except PortError as error:
                tries += 1
                # Told when it lasts: a device that is just being plugged in belongs to root for a moment.
                lasts = str(error) == met or (not reported and tries > 2)
                if lasts and str(error) != reported:
                    reported = str(error)
                    self._status(False, _waiting_message(error))
                met = str(error)
            else:
                reported, tries = "", 0
                self._serve(wire)
            self._closing.wait(RETRY_PERIOD)

    def _serve(self, wire: Wire) -> None:
        """Read until the line is lost or the port is closed."""
        try:
            if self._closing.is_set():
                return
            self._wire = wire
            self._status(True, f"{self._label} open")
            while not self._closing.is_set():
                data = wire.read()
                if data:
                    self._sink(Arrival(self._name, time.monotonic_ns(), data))
        except OSError as error:
            self._status(False, f"{self._label} lost: {error}; waiting for it")
        finally:
            with self._wire_lock:
                self._wire = None
                wire.close()

    def _status(self, is_open: bool, message: str) -> None:
        self._sink(PortStatus(self._name, time.monotonic_ns(), is_open, message))


def _waiting_message(error: PortError) -> str:
    advice = error.advise() if isinstance(error, OpenError) else ""
    return f"{error}; waiting for it" + (f" ({advice})" if advice else "")


def reason(error: Exception) -> str:
    """The operating system's own words: pyserial wraps them, or gives only a number."""
    number = error.errno if isinstance(error, OSError) else None
    if number is None:
        return str(error)
    if number in (errno.EAGAIN, errno.EBUSY):
        return "in use by another program"
    return os.strerror(number)
