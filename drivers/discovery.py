"""Finds the port of a sensor by what speaks there: `port = "auto"`.

Nothing is sent to a port before it was listened to: what a LinkTrack tag is sent goes out over the air, and
an autopilot is to get no rubbish. Requests go only to a port that is silent, or in the middle of an
RPLIDAR's scan.
"""

import os
import select
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from glob import glob

from drivers.errors import PortError
from drivers.port import AutoAddress, OpenError, PortAddress, Wire
from drivers.port_advice import holders, serial_ports
from drivers.recognition import MAVLINK, NMEA, Ear, is_running_scan, new_sensor
from drivers.serial_line import READ_TIMEOUT, SerialWire

LISTEN = 1.2
"""How long a line is listened to at one rate [s]: heartbeats and the slowest tags come once a second."""
_ASK = 0.6
"""How long an answer is waited for [s]; an RPLIDAR is stopped first, which takes 0.1 s."""
_NOISE = 16
"""Bytes that may come while a device is asked and are no answer; after more it is left alone."""
_IDLE = 0.5
"""Pause when no port is free [s]: to find that out takes a look at every process."""
_LOOKING = threading.Lock()
"""Held by whoever looks for a port: two at a time would find each other's ports in use."""


@dataclass(frozen=True, slots=True)
class Voice:
    """What was heard on a line.

    Attributes:
        speaker: a name in SENSORS, MAVLINK or NMEA; None when nobody was recognised.
        baud: rate at which it speaks.
        data: what was heard at that rate before anything was asked.
        fault: why the line could not be listened to; empty when it could.
    """

    speaker: str | None
    baud: int
    data: bytes = b""
    fault: str = ""

    @property
    def is_final(self) -> bool:
        """Whether other rates have nothing to add: who is silent at one rate is so at all."""
        return self.speaker is not None or not self.data or bool(self.fault)

    def __str__(self) -> str:
        if self.fault:
            return f"lost: {self.fault}"
        if self.speaker is None:
            return "bytes that make no sense" if self.data else "silent"
        return {MAVLINK: "MAVLink", NMEA: "NMEA text"}.get(self.speaker, self.speaker)


def listen(
    wires: Mapping[str, SerialWire],
    baud: int,
    ask: Mapping[str, Sequence[int]],
    closing: threading.Event,
    seconds: float,
) -> Iterator[tuple[str, Voice]]:
    """Listen to lines at once, then ask on those that are silent; gives each as soon as it is known.

    Args:
        wires: lines by any name; each that speaks is left at the rate of its voice.
        baud: rate to listen at.
        ask: drivers whose dialogue may be tried, with the rates of their devices.
        closing: ends it early.
        seconds: how long to listen.
    """
    lines = {name: _Line(wire, baud) for name, wire in wires.items()}
    for name in list(lines):
        if voice := lines[name].tune():
            del lines[name]
            yield name, voice
    is_over = False
    end = time.monotonic() + seconds
    while lines and not is_over and not closing.is_set():
        is_over = time.monotonic() >= end
        ready, _, _ = select.select(list(lines.values()), [], [], 0.0 if is_over else READ_TIMEOUT)
        for name in [name for name, line in lines.items() if line in ready]:
            if voice := lines[name].hear():
                del lines[name]
                yield name, voice
    for name, line in lines.items():
        if not closing.is_set():
            yield name, line.judge(ask, closing)


class _Line:
    """A line that is listened to at one rate."""

    def __init__(self, wire: SerialWire, baud: int) -> None:
        self._wire = wire
        self._baud = baud
        self._ear = Ear()

    def fileno(self) -> int:
        """For select."""
        return self._wire.fileno()

    def tune(self) -> Voice | None:
        """Set the rate; a voice when the line is lost."""
        try:
            self._wire.set_baud(self._baud)
        except OSError as error:
            return self._voice(None, str(error))
        return None

    def hear(self) -> Voice | None:
        """Take what came; a voice when there is no doubt about it, or the line is lost."""
        try:
            speaker = self._ear.feed(self._wire.read(), time.monotonic_ns())
        except OSError as error:
            return self._voice(None, str(error))
        return None if speaker is None else self._voice(speaker)

    def judge(self, ask: Mapping[str, Sequence[int]], closing: threading.Event) -> Voice:
        """The voice, after asking where that does no harm."""
        # It may have begun to speak while others were asked.
        if voice := self.hear():
            return voice
        speaker = self._ear.verdict()
        is_scan = speaker is None and is_running_scan(self._ear.data)
        if self._ear.data and not is_scan:
            return self._voice(speaker)
        try:
            for driver, bauds in ask.items():
                answered = _ask(self._wire, driver, [self._baud] if is_scan else bauds, closing)
                if answered is not None:
                    self._baud = answered
                    return self._voice(driver)
        except OSError as error:
            return self._voice(None, str(error))
        return self._voice(None)

    def _voice(self, speaker: str | None, fault: str = "") -> Voice:
        return Voice(speaker, self._baud, bytes(self._ear.data), fault)


def _ask(wire: SerialWire, driver: str, bauds: Sequence[int], closing: threading.Event) -> int | None:
    """Rate at which a device answers the driver's dialogue; None when there is no answer or no dialogue."""
    for baud in bauds:
        sensor = new_sensor(driver)
        sensor.connected(time.monotonic_ns())
        request = sensor.poll(time.monotonic_ns())
        if not request:
            return None
        wire.set_baud(baud)
        noise = 0
        end = time.monotonic() + _ASK
        while time.monotonic() < end and not closing.is_set():
            if request:
                wire.write(request)
            data = wire.read()
            sensor.feed(data, time.monotonic_ns())
            if sensor.stats.good:
                return baud
            noise += len(data)
            request = sensor.poll(time.monotonic_ns())
        if noise > _NOISE:
            return None
    return None


class Finder:
    """Opens the line on which a sensor speaks, for a `Port`; its str() says where that was last.

    When the sensor speaks on several ports any of them is taken: such ports need their names.

    Args:
        address: which ports may be looked at.
        driver: name of the sensor in SENSORS.
        closing: gives up when it is set.
    """

    def __init__(self, address: AutoAddress, driver: str, closing: threading.Event) -> None:
        self._address = address
        self._driver = driver
        self._closing = closing
        sensor = new_sensor(driver)
        self._bauds = list(sensor.BAUDS) if address.baud is None else [address.baud]
        self._dtr_stops = sensor.DTR_STOPS
        self._found = ""

    def __str__(self) -> str:
        return self._found or str(self._address)

    def __call__(self) -> Wire:
        """Look at every free port that may be looked at.

        Raises:
            PortError: the sensor speaks on none of them; says what they are instead.
        """
        while not _LOOKING.acquire(timeout=0.1):
            if self._closing.is_set():
                raise PortError(f"{self._address}: closed")
        try:
            return self._find()
        finally:
            _LOOKING.release()

    def _find(self) -> Wire:
        paths = candidates(self._address.pattern)
        users = holders(paths)
        verdicts = {path: f"{path} in use by {users[path][0]}" for path in paths if users[path]}
        refusals: list[OpenError] = []
        wires: dict[str, SerialWire] = {}
        ask = {self._driver: self._bauds}
        try:
            for path in paths:
                if path not in verdicts:
                    try:
                        wires[path] = SerialWire(PortAddress(path, self._bauds[0]), self._dtr_stops)
                    except OpenError as error:
                        refusals.append(error)
                        verdicts[path] = str(error)
            if not wires:
                self._closing.wait(_IDLE)
            for baud in self._bauds:
                if not wires or candidates(self._address.pattern) != paths:
                    break
                for path, voice in listen(wires, baud, ask, self._closing, LISTEN):
                    if voice.speaker == self._driver:
                        # After an unplug the device most likely speaks at the same rate.
                        self._bauds.sort(key=lambda baud: baud != voice.baud)
                        self._found = f"{path} at {voice.baud} baud"
                        return wires.pop(path)
                    verdicts[path] = f"{path} {voice}"
                    if voice.is_final:
                        wires.pop(path).close()
        finally:
            for wire in wires.values():
                wire.close()
        found = ", ".join(verdicts[path] for path in paths if path in verdicts) or "no such port"
        advise = refusals[0].advise if refusals else lambda: "see companion doctor ports"
        raise OpenError(f"{self._address}: no {self._driver} found: {found}", advise)


def candidates(pattern: str) -> list[str]:
    """Ports that may be looked at, one path a device.

    Args:
        pattern: of their paths; empty = every USB serial adapter, so that no console is ever written to.
    """
    paths = (
        sorted(glob(pattern)) if pattern else [port.device for port in serial_ports() if port.vid is not None]
    )
    return list({os.path.realpath(path): path for path in reversed(paths)}.values())[::-1]
