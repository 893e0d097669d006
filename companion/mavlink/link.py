"""The wire to the autopilot: any pymavlink device string. Bytes only, no parsing."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from pymavlink import mavutil

from companion.config import MavlinkTable
from companion.errors import UserError
from drivers.errors import PortError
from drivers.port import OpenError, Wire, reason
from drivers.port_advice import advice

NAME = "mavlink"
"""Name of the link where sensors have theirs: in the log and in messages."""
READ_TIMEOUT = 0.1
"""Longest wait for bytes [s]."""


class MavlinkWire:
    """One pymavlink connection.

    Args:
        table: device string and baud.

    Raises:
        PortError: it cannot be opened now.
        ValueError: the device string makes no sense.
    """

    def __init__(self, table: MavlinkTable) -> None:
        try:
            # One attempt: pymavlink's own retries print and sleep.
            self._connection = mavutil.mavlink_connection(table.url, baud=table.baud, retries=1)
        except OSError as error:
            advise = partial(advice, table.url, error)
            raise OpenError(f"cannot open {table.url}: {reason(error)}", advise) from error
        # These have no other side that could close them; an empty read means nothing there.
        self._is_stream = not isinstance(
            self._connection, mavutil.mavudp | mavutil.mavmcast | mavutil.mavserial
        )

    def read(self) -> bytes:
        """Bytes that came within a tenth of a second."""
        if self._connection.portdead:
            raise ConnectionError("write failed")
        if not self._connection.select(READ_TIMEOUT):
            return b""
        data = self._connection.recv(4096)
        if not data and self._is_stream:
            raise ConnectionError("closed by the other side")
        # pymavlink's UDP gives an empty str when nothing is there.
        return bytes(data or b"")

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._connection.write(data)
        if self._connection.portdead:
            raise ConnectionError("write failed")

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()


def wire_opener(table: MavlinkTable) -> Callable[[], Wire]:
    """What opens the link, now and whenever it is lost; the first connection is made at once.

    Raises:
        UserError: the device string makes no sense. A device that is only missing is waited for.
    """
    if Path(table.url).is_file():
        raise UserError(f"mavlink.url: {table.url} is a file; give a device such as udpout:host:14550")
    ready: list[Wire] = []
    try:
        ready.append(MavlinkWire(table))
    except ValueError as error:
        raise UserError(f"mavlink.url: {table.url!r} is no pymavlink device string: {error}") from error
    except PortError:
        pass
    return lambda: ready.pop() if ready else MavlinkWire(table)
