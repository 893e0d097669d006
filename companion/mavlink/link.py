"""The wire to the autopilot: any pymavlink device string, opened again when it is lost."""

import threading
import time
from pathlib import Path

import serial
from pymavlink import mavutil

from companion.config import MavlinkTable
from companion.errors import UserError
from drivers.port import Arrival, PortStatus, Sink

NAME = "mavlink"
RETRY_PERIOD = 1.0
"""Time between attempts to open the link [s]."""
_FAULTS = (OSError, serial.SerialException)


class MavlinkLink:
    """A reader thread round one pymavlink connection; bytes only, no parsing.

    Args:
        table: device string and baud.
        sink: takes arrivals and status changes, from the reader's thread; must not block.

    Raises:
        UserError: the device string makes no sense.
    """

    def __init__(self, table: MavlinkTable, sink: Sink) -> None:
        if Path(table.url).is_file():
            raise UserError(f"mavlink.url: {table.url} is a file; give a device such as udpout:host:14550")
        self._table = table
        self._sink = sink
        self._connection: mavutil.mavfile | None = None
        try:
            self._connection = self._connect()
        except ValueError as error:
            raise UserError(f"mavlink.url: {table.url!r} is no pymavlink device string: {error}") from error
        except _FAULTS as error:
            self._status(False, f"cannot open {table.url}: {error}; trying again")
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="mavlink", daemon=True)

    def start(self) -> None:
        """Begin reading."""
        self._thread.start()

    def send(self, data: bytes) -> bool:
        """Send bytes; False when the link is down."""
        connection = self._connection
        if connection is None:
            return False
        try:
            connection.write(data)
        except _FAULTS:
            return False
        return not connection.portdead

    def close(self) -> None:
        """Stop reading and close the link."""
        self._closing.set()
        self._thread.join(timeout=2.0)

    def _connect(self) -> mavutil.mavfile:
        # One attempt a call: pymavlink's own retries print and sleep.
        return mavutil.mavlink_connection(self._table.url, baud=self._table.baud, retries=1)

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                if self._connection is None:
                    self._connection = self._connect()
                self._status(True, f"{self._table.url} open")
                self._read(self._connection)
            except _FAULTS as error:
                if self._connection is not None:
                    self._status(False, f"{self._table.url} lost: {error}; trying again")
                self._closing.wait(RETRY_PERIOD)
            finally:
                connection, self._connection = self._connection, None
                if connection is not None:
                    connection.close()

    def _read(self, connection: mavutil.mavfile) -> None:
        is_stream = not isinstance(connection, mavutil.mavudp | mavutil.mavmcast | mavutil.mavserial)
        while not self._closing.is_set():
            if not connection.select(0.1):
                continue
            data = connection.recv(4096)
            if data:
                self._sink(Arrival(NAME, time.monotonic_ns(), bytes(data)))
            elif is_stream:
                raise ConnectionError("closed by the other side")
            if connection.portdead:
                raise ConnectionError("write failed")

    def _status(self, is_open: bool, message: str) -> None:
        self._sink(PortStatus(NAME, time.monotonic_ns(), is_open, message))
