"""`auto`: a sensor's port is found by what speaks there, and nobody else is disturbed."""

import os
import queue
import subprocess
import sys
import termios
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import serial.tools.list_ports_linux

import drivers.discovery
import drivers.port
from drivers import SENSORS
from drivers.discovery import Finder, Voice, candidates, listen
from drivers.port import AutoAddress, OpenError, Port, PortAddress, PortEvent, PortStatus
from drivers.recognition import MAVLINK, NMEA, new_sensor
from drivers.rplidar_nodes import encode_standard_node
from drivers.serial_line import SerialWire
from tests.drivers.far_side import GARBAGE, NMEA_TEXT, Behaviour, Device, autopilot, lidar, sends, silent, tag

WAIT = 10.0
Plug = Callable[..., Device]
SCAN = b"".join(encode_standard_node(3 * 64 * i, 4000, 15, i == 0) for i in range(120))


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """The devices of these tests speak five times a second at least, and answer at once."""
    monkeypatch.setattr(drivers.discovery, "LISTEN", 0.35)
    monkeypatch.setattr(drivers.discovery, "_ASK", 0.35)
    monkeypatch.setattr(drivers.discovery, "_IDLE", 0.01)


@pytest.fixture
def plug(tmp_path: Path) -> Iterator[Plug]:
    """Plugs in a device under a name."""
    devices: list[Device] = []

    def plug_in(name: str, behaviour: Behaviour, baud: int | None = None) -> Device:
        devices.append(Device(tmp_path / name, behaviour, baud))
        return devices[-1]

    yield plug_in
    for device in devices:
        device.unplug()


@pytest.fixture
def events() -> queue.Queue[PortEvent]:
    return queue.Queue()


def finder(folder: Path, driver: str, baud: int | None = None) -> Finder:
    return Finder(AutoAddress(f"{folder}/tty*", baud), driver, threading.Event())


def found(finder: Finder) -> str:
    finder().close()
    return str(finder)


def refusal(finder: Finder) -> str:
    with pytest.raises(OpenError) as caught:
        finder()
    return str(caught.value)


@pytest.mark.parametrize(("tag_at", "lidar_at"), [("tty0", "tty1"), ("tty1", "tty0")])
def test_each_sensor_is_found_behind_whatever_name(
    tag_at: str, lidar_at: str, tmp_path: Path, plug: Plug
) -> None:
    uwb, _ = plug(tag_at, tag()), plug(lidar_at, lidar())
    assert found(finder(tmp_path, "linktrack")) == f"{tmp_path}/{tag_at} at 921600 baud"
    assert found(finder(tmp_path, "rplidar")) == f"{tmp_path}/{lidar_at} at 115200 baud"
    assert uwb.received == b""


def test_two_that_look_at_once_find_each_its_own(tmp_path: Path, plug: Plug) -> None:
    plug("tty0", tag()), plug("tty1", lidar())
    finders = [finder(tmp_path, "rplidar"), finder(tmp_path, "linktrack")]
    wires: list[object] = []
    threads = [threading.Thread(target=lambda f=f: wires.append(f())) for f in finders]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(WAIT)
    assert list(map(str, finders)) == [f"{tmp_path}/tty1 at 115200 baud", f"{tmp_path}/tty0 at 921600 baud"]
    assert len(wires) == 2
    assert "tty0: in use by another program" in refusal(finder(tmp_path, "linktrack"))
    for wire in wires:
        assert isinstance(wire, SerialWire)
        wire.close()


def test_devices_that_change_places_are_followed(
    tmp_path: Path, events: queue.Queue[PortEvent], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drivers.port, "RETRY_PERIOD", 0.02)
    ports = []
    for driver in SENSORS:
        look = finder(tmp_path, driver)
        ports.append(Port(driver, look, look, events.put))
    for places in (("tty0", "tty1"), ("tty1", "tty0")):
        devices = [
            Device(tmp_path / place, behaviour)
            for place, behaviour in zip(places, (tag(), lidar()), strict=True)
        ]
        if places[0] == "tty0":
            for port in ports:
                port.start()
        opened: dict[str, str] = {}
        while len(opened) < 2:
            event = events.get(timeout=WAIT)
            if isinstance(event, PortStatus) and event.is_open:
                opened[event.name] = event.message
        assert opened == {
            "linktrack": f"{tmp_path}/{places[0]} at 921600 baud open",
            "rplidar": f"{tmp_path}/{places[1]} at 115200 baud open",
        }
        for device in devices:
            device.unplug()
    for port in ports:
        port.close()


def test_another_rate_is_found_and_tried_first_the_next_time(tmp_path: Path, plug: Plug) -> None:
    device = plug("tty0", tag(), 460_800)
    look = finder(tmp_path, "linktrack")
    assert found(look) == f"{tmp_path}/tty0 at 460800 baud"
    device.unplug()
    device.plug()
    device.speeds.clear()
    assert found(look) == f"{tmp_path}/tty0 at 460800 baud"
    assert device.speeds <= {termios.B38400, termios.B460800}  # a new pseudo-terminal has 38400


def test_a_silent_device_answers_at_its_rate_only(tmp_path: Path, plug: Plug) -> None:
    plug("tty0", lidar(), 1_000_000)
    assert found(finder(tmp_path, "rplidar")) == f"{tmp_path}/tty0 at 1000000 baud"


def test_a_given_rate_is_the_only_one(tmp_path: Path, plug: Plug) -> None:
    device = plug("tty0", tag(), 460_800)
    assert "bytes that make no sense" in refusal(finder(tmp_path, "linktrack", 230_400))
    assert device.speeds <= {termios.B38400, termios.B230400}
    assert found(finder(tmp_path, "linktrack", 460_800)) == f"{tmp_path}/tty0 at 460800 baud"


def test_a_scan_that_someone_left_running_is_ended_at_its_rate(tmp_path: Path, plug: Plug) -> None:
    plug("tty0", lidar(running_scan=SCAN), 460_800)
    assert found(finder(tmp_path, "rplidar")) == f"{tmp_path}/tty0 at 460800 baud"


def test_nothing_is_sent_to_who_speaks(tmp_path: Path, plug: Plug) -> None:
    devices = [
        plug("tty0", autopilot(1)),
        plug("tty1", sends(NMEA_TEXT)),
        plug("tty2", sends(GARBAGE)),
        plug("tty3", tag()),
    ]
    assert refusal(finder(tmp_path, "rplidar")) == (
        f"auto:{tmp_path}/tty*: no rplidar found: {tmp_path}/tty0 MAVLink, {tmp_path}/tty1 NMEA text, "
        f"{tmp_path}/tty2 bytes that make no sense, {tmp_path}/tty3 linktrack"
    )
    assert [device.received for device in devices] == [b""] * 4


def test_nothing_is_asked_for_a_sensor_that_speaks_by_itself(tmp_path: Path, plug: Plug) -> None:
    device = plug("tty0", silent)
    assert refusal(finder(tmp_path, "linktrack")).endswith("tty0 silent")
    assert device.received == b""


def test_who_begins_to_speak_while_asked_is_left_alone(tmp_path: Path, plug: Plug) -> None:
    begun = False

    def behaviour(received: bytes) -> bytes:
        nonlocal begun
        begun = begun or bool(received)
        return GARBAGE if begun else b""

    device = plug("tty0", behaviour)
    refusal(finder(tmp_path, "rplidar"))
    assert 0 < len(device.received) < 20
    assert termios.B460800 not in device.speeds


def test_who_begins_to_speak_while_another_is_asked_is_not_asked(tmp_path: Path, plug: Plug) -> None:
    first = plug("tty0", silent)
    second = plug("tty1", lambda received: GARBAGE if first.received or received else b"")
    refusal(finder(tmp_path, "rplidar"))
    assert first.received
    assert second.received == b""


def test_a_port_that_a_program_uses_is_not_even_opened(tmp_path: Path, plug: Plug) -> None:
    device = plug("tty0", tag())
    hold = (
        "import os, sys; os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); print(flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", hold, device.path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as program:
        assert program.stdout is not None
        program.stdout.readline()
        assert "tty0 in use by " in refusal(finder(tmp_path, "linktrack"))
        assert f"(pid {program.pid})" in refusal(finder(tmp_path, "linktrack"))
        assert device.speeds <= {termios.B38400}
        program.kill()


def test_a_device_that_comes_while_another_puzzles_does_not_wait_for_all_rates(
    tmp_path: Path, plug: Plug
) -> None:
    other = plug("tty0", sends(GARBAGE))
    look = finder(tmp_path, "linktrack")
    looker = threading.Thread(target=lambda: refusal(look))
    looker.start()
    while termios.B921600 not in other.speeds:
        assert looker.is_alive()
    plug("tty1", tag())
    looker.join(WAIT)
    assert not looker.is_alive()
    assert len(other.speeds) < len(new_sensor("linktrack").BAUDS)
    assert found(look) == f"{tmp_path}/tty1 at 921600 baud"


def test_looking_ends_when_the_port_is_closed(
    tmp_path: Path, plug: Plug, events: queue.Queue[PortEvent], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drivers.discovery, "LISTEN", 600.0)
    device = plug("tty0", silent)
    before = len(os.listdir("/proc/self/fd")), threading.active_count()
    ports = []
    for driver in SENSORS:
        closing = threading.Event()
        look = Finder(AutoAddress(f"{tmp_path}/tty*", None), driver, closing)
        ports.append(Port(driver, look, look, events.put, closing))
    for port in ports:
        port.start()
    while device.speeds <= {termios.B38400}:
        pass
    for port in reversed(ports):
        port.close()
    assert (len(os.listdir("/proc/self/fd")), threading.active_count()) == before
    assert events.empty()


def test_without_a_pattern_only_usb_adapters_are_looked_at(
    tmp_path: Path, plug: Plug, monkeypatch: pytest.MonkeyPatch
) -> None:
    ports = []
    for name, vendor in (("tty0", None), ("tty1", 0x10C4)):
        port = serial.tools.list_ports_linux.SysFS(str(plug(name, tag()).link))
        port.vid = vendor
        ports.append(port)
    monkeypatch.setattr(drivers.discovery, "serial_ports", lambda: ports)
    assert candidates("") == [f"{tmp_path}/tty1"]
    assert str(tmp_path / "tty1") in found(Finder(AutoAddress("", None), "linktrack", threading.Event()))


def test_a_device_with_several_names_is_looked_at_once(tmp_path: Path, plug: Plug) -> None:
    device = plug("tty0", silent)
    (tmp_path / "tty1").symlink_to(device.path)
    assert candidates(f"{tmp_path}/*") == [f"{tmp_path}/tty0"]


def test_no_port_at_all_is_said(tmp_path: Path) -> None:
    look = finder(tmp_path, "linktrack")
    with pytest.raises(OpenError) as caught:
        look()
    assert str(caught.value) == f"auto:{tmp_path}/tty*: no linktrack found: no such port"
    assert caught.value.advise() == "see companion doctor ports"


def test_a_port_that_may_not_be_opened_comes_with_what_to_do(tmp_path: Path, plug: Plug) -> None:
    device = plug("tty0", tag())
    line = SerialWire(PortAddress(device.path, 9600))
    with pytest.raises(OpenError) as caught:
        finder(tmp_path, "linktrack")()
    line.close()
    assert str(caught.value).endswith(f"cannot open {tmp_path}/tty0: in use by another program")
    assert caught.value.advise().startswith(f"sudo fuser -v {tmp_path}/tty0 tells which")


def voices(wires: dict[str, SerialWire], ask: dict[str, tuple[int, ...]]) -> dict[str, Voice]:
    return dict(listen(wires, 115_200, ask, threading.Event(), 0.35))


def test_all_lines_are_listened_to_at_once(tmp_path: Path, plug: Plug) -> None:
    behaviours = [tag(), autopilot(4), sends(NMEA_TEXT), silent, sends(GARBAGE), lidar()]
    devices = [plug(f"tty{i}", behaviour) for i, behaviour in enumerate(behaviours)]
    wires = {str(i): SerialWire(PortAddress(device.path, 9600)) for i, device in enumerate(devices)}
    heard = voices(wires, {"rplidar": (115_200,)})
    for wire in wires.values():
        wire.close()
    speakers = {name: voice.speaker for name, voice in heard.items()}
    assert speakers == {"0": "linktrack", "1": MAVLINK, "2": NMEA, "3": None, "4": None, "5": "rplidar"}
    assert heard["3"] == Voice(None, 115_200)
    assert [name for name, voice in heard.items() if not voice.is_final] == ["4"]


def test_a_line_that_is_lost_is_said_to_be(tmp_path: Path, plug: Plug) -> None:
    device, other = plug("tty0", silent), plug("tty1", tag())
    wires = {
        "lost": SerialWire(PortAddress(device.path, 9600)),
        "kept": SerialWire(PortAddress(other.path, 9600)),
    }
    device.unplug()
    heard = voices(wires, {})
    device.plug()
    assert str(heard["lost"]).startswith("lost: ")
    assert heard["lost"].is_final
    assert heard["kept"].speaker == "linktrack"
    for wire in wires.values():
        wire.close()


@pytest.mark.parametrize("driver", SENSORS)
def test_every_sensor_names_its_rates(driver: str) -> None:
    bauds = new_sensor(driver).BAUDS
    assert bauds
    assert len(set(bauds)) == len(bauds)
    assert all(1200 <= baud <= 4_000_000 for baud in bauds)
