"""What is on each serial port, who uses it, and what to write about it into the site file."""

import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, zip_longest
from pathlib import Path

from serial.tools.list_ports_common import ListPortInfo

from companion.device_report import describe
from drivers import SENSORS
from drivers.discovery import Voice, listen
from drivers.port import OpenError, PortAddress
from drivers.port_advice import holders, serial_ports
from drivers.recognition import MAVLINK, new_sensor
from drivers.serial_line import SerialWire

TELEMETRY_BAUD = 57_600
"""Usual rate of an autopilot's telemetry port; its others are among those of the sensors."""
STABLE_NAMES = Path("/dev/serial")
"""Links of udev: `by-id` after the adapter, `by-path` after the socket."""
TABLE_NAMES = {"linktrack": "uwb", "rplidar": "lidar"}
"""Driver -> usual name of its table in a site file."""


@dataclass(frozen=True, slots=True)
class Finding:
    """What there is to say of one port.

    Attributes:
        path: of the port.
        names: the device itself, if the path is a link, and udev's links to it.
        stable: the one for the site file: it leads there after unplugging too, as far as there is one.
        adapter: the USB adapter; empty when it is none.
        text: what speaks there, or why that is not known.
        speaker: a name in SENSORS, MAVLINK or NMEA; None when nobody was recognised.
        baud: rate at which it speaks.
    """

    path: str
    names: list[str]
    stable: str
    adapter: str
    text: str
    speaker: str | None
    baud: int


def check_ports(given: Sequence[str], seconds: float, say: Callable[[str], None]) -> list[Finding]:
    """Look at the given ports, or else at all serial ports of this machine.

    Ports that someone uses are left alone. Those that were not given and are no USB adapters are only
    listened to: there may be a console behind them.

    Args:
        given: paths of devices.
        seconds: how long to listen at each rate.
        say: takes what is being done.
    """
    ports = {os.path.realpath(port.device): port for port in serial_ports()}
    paths = list(dict.fromkeys(given)) or list(ports)
    users = holders(paths)
    texts = {path: "in use by " + ", ".join(map(str, users[path])) for path in paths if users[path]}
    wires: dict[str, SerialWire] = {}
    voices: dict[str, Voice] = {}
    try:
        for path in paths:
            if path not in texts:
                try:
                    wires[path] = SerialWire(PortAddress(path, TELEMETRY_BAUD))
                except OpenError as error:
                    texts[path] = f"{error}: {error.advise()}".removesuffix(": ")
        mute = {} if given else {path: wire for path, wire in wires.items() if ports[path].vid is None}
        bauds = {driver: new_sensor(driver).BAUDS for driver in SENSORS}
        voices |= _voices({path: wires[path] for path in wires if path not in mute}, bauds, seconds, say)
        voices |= _voices(mute, {}, seconds, say)
        for path, voice in voices.items():
            say(f"looking closer at {path}: {voice}")
            texts[path] = describe(wires[path], voice, seconds)
            if path in mute and not voice.data:
                texts[path] += "; not asked, since it is no USB adapter: name it, and it is asked too"
    finally:
        for wire in wires.values():
            wire.close()
    return [
        _finding(path, list(ports.values()), texts[path], voices.get(path, Voice(None, 0))) for path in paths
    ]


def _voices(
    wires: Mapping[str, SerialWire],
    ask: Mapping[str, Sequence[int]],
    seconds: float,
    say: Callable[[str], None],
) -> dict[str, Voice]:
    """Who speaks on each line, at the rates of all drivers, the most usual first."""
    rates = [new_sensor(driver).BAUDS for driver in SENSORS]
    columns = zip_longest(*rates, [TELEMETRY_BAUD])
    waiting, voices = dict(wires), dict[str, Voice]()
    for baud in dict.fromkeys(filter(None, chain.from_iterable(columns))):
        if waiting:
            say(f"listening at {baud} baud on {', '.join(waiting)}")
        for path, voice in listen(waiting, baud, ask, threading.Event(), seconds):
            if path not in voices or voice.speaker or voice.fault:
                voices[path] = voice
            if voice.is_final:
                del waiting[path]
    return voices


def _finding(path: str, ports: Sequence[ListPortInfo], text: str, voice: Voice) -> Finding:
    device = os.path.realpath(path)
    links = [str(link) for link in sorted(STABLE_NAMES.glob("by-*/*")) if os.path.realpath(link) == device]
    port = next((port for port in ports if os.path.realpath(port.device) == device), None)
    names = [name for name in [device, *links] if name != path]
    stable = path
    if path == device:
        stable = next((link for link in links if _is_lasting(link, port, ports)), path)
    return Finding(path, names, stable, _adapter(port), text, voice.speaker, voice.baud)


def _is_lasting(link: str, port: ListPortInfo | None, ports: Sequence[ListPortInfo]) -> bool:
    """Whether a link of udev can only ever lead to this port.

    One by serial number does not, when adapters come with the same number or with none.
    """
    if Path(link).parent.name != "by-id":
        return True
    return (
        port is not None
        and bool(port.serial_number)
        and [_identity(other) for other in ports].count(_identity(port)) == 1
    )


def _identity(port: ListPortInfo) -> tuple[int | None, int | None, str | None]:
    return port.vid, port.pid, port.serial_number


def _adapter(port: ListPortInfo | None) -> str:
    if port is None or port.vid is None:
        return ""
    words = [port.manufacturer, port.product, f"{port.vid:04x}:{port.pid:04x}"]
    if port.serial_number:
        words.append(f"serial {port.serial_number}")
    return " ".join(filter(None, words))


def site_tables(findings: Sequence[Finding]) -> str:
    """Lines to paste into the site file, for everything of it that was found; empty for nothing."""
    tables: dict[str, str] = {}
    for finding in findings:
        if finding.speaker in SENSORS:
            usual = TABLE_NAMES.get(finding.speaker, finding.speaker)
            number = sum(name.startswith(f"sensor.{usual}") for name in tables)
            name = f"sensor.{usual}{number + 1 if number else ''}"
            tables[name] = f'driver = "{finding.speaker}"\nport = "{finding.stable}?baud={finding.baud}"'
        elif finding.speaker == MAVLINK:
            tables.setdefault("mavlink", f'url = "{finding.stable}"\nbaud = {finding.baud}')
    return "\n\n".join(f"[{name}]\n{lines}" for name, lines in tables.items())
