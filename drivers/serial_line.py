"""A serial line that is had alone, or what a pyserial URL stands for.

Source: Linux man pages ioctl_tty(2), flock(2).
"""

import errno
import fcntl
import os
import sys
import termios
from contextlib import suppress
from functools import partial

import serial

from drivers.port import OpenError, PortAddress, reason
from drivers.port_advice import advice

READ_TIMEOUT = 0.1
"""Longest wait for a byte [s]; bounds how long closing takes."""
NETWORK_BATCH = 0.005
"""How long bytes of a network URL are gathered [s]: it cannot say how many are waiting."""
_TIOCGEXCL = 0x80045440  # Linux: whether TIOCEXCL is set; not in Python 3.11's termios
_PSEUDO_TERMINALS = range(136, 144)  # major numbers (Linux Documentation/admin-guide/devices.txt)


class SerialWire:
    """A serial line, or what a pyserial URL stands for.

    Args:
        address: where the device is.
        dtr_stops: whether the device is to be left with its DTR line on, see `Sensor.DTR_STOPS`.

    Raises:
        PortError: it cannot be opened; the message says why.
    """

    def __init__(self, address: PortAddress, dtr_stops: bool = False) -> None:
        self._dtr_stops = dtr_stops
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
            if isinstance(self._device, serial.Serial):
                self._claim(self._device.fileno())
        except (OSError, ValueError, termios.error) as error:
            raise OpenError(
                f"cannot open {address.url}: {reason(error)}", partial(advice, address.url, error)
            ) from error

    def read(self) -> bytes:
        """What is there, or the next byte when there is nothing yet."""
        try:
            if self._is_network:
                return bytes(self._device.read(4096))
            data = self._device.read(1)
            return bytes(data + self._device.read(self._device.in_waiting))
        except (termios.error, TypeError, ValueError) as error:
            # What pyserial makes of a device that vanishes, or is closed, under its hands.
            raise ConnectionError(str(error)) from error

    def write(self, data: bytes) -> None:
        """Send bytes."""
        try:
            self._device.write(data)
        except (termios.error, TypeError, ValueError) as error:
            raise ConnectionError(str(error)) from error

    def fileno(self) -> int:
        """File descriptor, to wait for several lines at once."""
        return self._device.fileno()

    def set_baud(self, baud: int) -> None:
        """Change the rate, and forget what came at the other one.

        Raises:
            OSError: the line is lost, or cannot do it.
        """
        try:
            self._device.baudrate = baud
            self._device.reset_input_buffer()
        except (termios.error, ValueError) as error:
            raise ConnectionError(str(error)) from error

    def close(self) -> None:
        """Close the line."""
        if isinstance(self._device, serial.Serial) and self._device.is_open:
            with suppress(OSError):
                fcntl.ioctl(self._device.fileno(), termios.TIOCNXCL)
            if self._dtr_stops:
                self._leave_dtr_on()
        with suppress(OSError):
            self._device.close()

    def _leave_dtr_on(self) -> None:
        """The system turns DTR off when a line is closed, unless it is told not to hang up."""
        with suppress(OSError, termios.error):
            fd = self._device.fileno()
            settings = termios.tcgetattr(fd)
            settings[2] &= ~termios.HUPCL
            termios.tcsetattr(fd, termios.TCSANOW, settings)
            self._device.dtr = True

    def _claim(self, fd: int) -> None:
        """Keep out those who do not lock, and stay out where one of them did the same.

        pyserial's lock only binds those who ask for it. TIOCEXCL binds all but root.
        """
        try:
            if sys.platform == "linux" and fcntl.ioctl(fd, _TIOCGEXCL, bytes(4)) != bytes(4):
                raise OSError(errno.EBUSY, os.strerror(errno.EBUSY))
            # On a pseudo-terminal it would outlive a killed process, as long as the other side is there.
            if os.major(os.fstat(fd).st_rdev) not in _PSEUDO_TERMINALS:
                fcntl.ioctl(fd, termios.TIOCEXCL)
        except OSError:
            self._device.close()
            raise
