"""`companion doctor ports` as a user types it, before ports where anything may be."""

import os
import subprocess
import sys
import threading
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from serial.tools.list_ports_linux import SysFS
from typer.testing import CliRunner, Result

import companion.port_check
import drivers.discovery
from companion.config import config_from_toml
from companion.device_report import describe
from companion.doctor import app
from companion.errors import UserError
from companion.port_check import Finding, check_ports, site_tables
from drivers.discovery import Voice
from drivers.linktrack_frames import encode
from drivers.linktrack_types import NodeFrame3
from drivers.port import PortAddress
from drivers.recognition import MAVLINK, NMEA
from drivers.rplidar_protocol import HealthStatus
from drivers.serial_line import SerialWire
from tests.conftest import SITE, write_scenario
from tests.drivers.far_side import (
    GARBAGE,
    NMEA_TEXT,
    SERIAL,
    Behaviour,
    Device,
    autopilot,
    lidar,
    sends,
    silent,
    tag,
)

LISTEN = 0.3
Plug = Callable[..., Device]


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """The devices of these tests answer at once."""
    monkeypatch.setattr(drivers.discovery, "_ASK", 0.35)


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


def run(*arguments: str | Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "companion", *map(str, arguments)],
        env={**os.environ, "COLUMNS": "400", "PYTHONUNBUFFERED": "1"},
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def doctor(*arguments: str | Path) -> Result:
    """The command, in this process."""
    return CliRunner().invoke(app, ["ports", *map(str, arguments)], env={"COLUMNS": "400"})


def check(*paths: Path) -> dict[str, Finding]:
    """Findings by the names of the ports."""
    said: list[str] = []
    found = check_ports([str(path) for path in paths], LISTEN, said.append)
    assert said
    return {Path(finding.path).name: finding for finding in found}


def test_emulated_devices_are_found_and_the_printed_lines_make_a_site_file(tmp_path: Path) -> None:
    with run("emulate", write_scenario(tmp_path)) as emulate:
        assert emulate.stdout is not None
        ports = dict(emulate.stdout.readline().split() for _ in range(2))
        with run("doctor", "ports", "--listen", "0.5", *ports.values()) as process:
            stdout, stderr = process.communicate(timeout=60)
        emulate.terminate()
    assert process.returncode == 0
    assert "LinkTrack tag 1, Node_Frame2, " in stdout
    assert "RPLIDAR A2" in stdout
    assert "health good, at 115200 baud" in stdout
    assert f"listening at 921600 baud on {ports['uwb']}, {ports['lidar']}" in stderr
    lines = stdout.partition("For the site file:")[2]
    without_sensors = SITE.read_text(encoding="utf-8").partition("[sensor.uwb]")[0]
    config = config_from_toml(without_sensors + lines, "printed")
    assert {name: table.driver for name, table in config.sensor.items()} == {
        "uwb": "linktrack",
        "lidar": "rplidar",
    }
    assert {name: table.port.partition("?")[0] for name, table in config.sensor.items()} == ports


def test_everything_that_may_be_on_a_port_is_told_apart(plug: Plug) -> None:
    kinds = {
        "tag": tag(),
        "lidar": lidar(),
        "autopilot": autopilot(7),
        "text": sends(NMEA_TEXT),
        "noise": sends(GARBAGE),
        "off": silent,
    }
    devices = {name: plug(name, behaviour) for name, behaviour in kinds.items()}
    found = check(*(device.link for device in devices.values()))
    texts = {name: finding.text for name, finding in found.items()}
    assert texts["tag"].startswith("LinkTrack tag 3, Node_Frame2, ")
    assert texts["tag"].endswith(" Hz, at 921600 baud")
    assert texts["lidar"] == f"RPLIDAR A2M12, firmware 1.32, serial {SERIAL}, health good, at 115200 baud"
    assert texts["autopilot"] == "MAVLink autopilot, system 7, at 921600 baud"
    assert NMEA_TEXT.decode().strip() in texts["text"]
    assert "set its protocol to Node_Frame2" in texts["text"]
    assert "none understood at any rate" in texts["noise"]
    assert texts["off"].startswith("silent")
    speakers = [finding.speaker for finding in found.values()]
    assert speakers == ["linktrack", "rplidar", MAVLINK, NMEA, None, None]
    assert all(devices[name].received == b"" for name in ("tag", "autopilot", "text", "noise"))
    assert found["tag"].names == [devices["tag"].path]


def test_a_rate_that_is_not_the_usual_one_is_found(plug: Plug) -> None:
    found = check(plug("tag", tag(), 460_800).link, plug("lidar", lidar(), 1_000_000).link)
    assert found["tag"].text.endswith("at 460800 baud")
    assert found["lidar"].text.endswith("at 1000000 baud")
    assert (found["tag"].baud, found["lidar"].baud) == (460_800, 1_000_000)


def test_the_rate_of_a_tag_is_told_however_its_frames_are_bundled(plug: Plug) -> None:
    device = plug("tty", silent)
    line = SerialWire(PortAddress(device.path, 921_600))
    writer = threading.Timer(0.1, lambda: os.write(device.master, tag()(b"") * 10))
    writer.start()
    text = describe(line, Voice("linktrack", 921_600), 1.0)
    writer.join()
    line.close()
    assert text == "LinkTrack tag 3, Node_Frame2, 10 Hz, at 921600 baud"


def test_a_tag_without_ranges_and_a_sick_lidar_say_so(plug: Plug) -> None:
    lonely = encode(NodeFrame3(id=5, role=2, local_time_ms=0, system_time_ms=0, voltage=5.0, nodes=()))
    found = check(plug("tag", sends(lonely)).link, plug("lidar", lidar(HealthStatus.ERROR)).link)
    assert "LinkTrack tag 5, Node_Frame3" in found["tag"].text
    assert "NO RANGES (is its output Node_Frame2, are anchors on?)" in found["tag"].text
    assert "HEALTH ERROR 0x0000 (does it turn freely?)" in found["lidar"].text


def test_a_port_in_use_is_left_alone_and_its_user_named(plug: Plug) -> None:
    device = plug("tty", tag())
    hold = (
        "import os, sys; os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); print(flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        ["mavproxy.py", "-c", hold, device.path],
        executable=sys.executable,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as program:
        assert program.stdout is not None
        program.stdout.readline()
        result = doctor(device.link)
        program.kill()
    assert result.exit_code == 1
    assert "in use by mavproxy.py " in result.stdout
    assert f"(pid {program.pid})" in result.stdout
    assert "For the site file" not in result.stdout
    assert len(device.speeds) == 1


def test_a_port_that_cannot_be_opened_says_why_and_what_to_do(plug: Plug) -> None:
    device = plug("tty", tag())
    line = SerialWire(PortAddress(device.path, 9600))
    result = doctor(device.link)
    line.close()
    assert result.exit_code == 1
    assert f"cannot open {device.link}: in use by another program: sudo fuser -v " in result.stdout


def test_a_device_that_vanishes_while_it_is_looked_at_is_said_to_be_lost(plug: Plug) -> None:
    device = plug("tty", tag())
    line = SerialWire(PortAddress(device.path, 921_600))
    device.unplug()
    assert describe(line, Voice("linktrack", 921_600, b"x"), LISTEN).startswith("linktrack, then lost: ")
    device.plug()
    line.close()


def test_a_device_that_vanishes_after_some_noise_is_said_to_be_lost(plug: Plug) -> None:
    device = plug("tty", sends(GARBAGE))

    def unplug(progress: str) -> None:
        if "at 115200 baud" in progress:
            device.unplug()

    found = check_ports([device.path], LISTEN, unplug)
    device.plug()
    assert found[0].text.startswith("lost: ")


def test_only_what_comes_now_is_reported(plug: Plug) -> None:
    device = plug("tty", silent)
    line = SerialWire(PortAddress(device.path, 921_600))
    os.write(device.master, tag()(b"") * 10)
    text = describe(line, Voice("linktrack", 921_600, b""), LISTEN)
    line.close()
    assert text == "LinkTrack module, then silent, at 921600 baud"


def adapter(device: Device, serial_number: str | None, vid: int | None = 0x10C4) -> SysFS:
    """A port as pyserial finds it."""
    port = SysFS(device.path)
    port.vid, port.pid, port.serial_number = vid, 0xEA60, serial_number
    port.manufacturer, port.product = "Silicon Labs", "CP2102"
    return port


def link_to(device: Device, link: Path) -> str:
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(device.path)
    return str(link)


def test_all_ports_come_with_adapter_and_the_name_that_lasts(
    tmp_path: Path, plug: Plug, monkeypatch: pytest.MonkeyPatch
) -> None:
    unique, twin, other_twin, numberless, onboard = (plug(f"tty{i}", silent) for i in range(5))
    ports = [
        adapter(unique, "A1"),
        adapter(twin, "0001"),
        adapter(other_twin, "0001"),
        adapter(numberless, None),
        adapter(onboard, None, vid=None),
    ]
    udev = tmp_path / "serial"
    by_id = link_to(unique, udev / "by-id" / "usb-A1")
    link_to(twin, udev / "by-id" / "usb-0001")
    link_to(numberless, udev / "by-id" / "usb-CH340")
    by_path = {d: link_to(d, udev / "by-path" / f"1.{i}") for i, d in enumerate((unique, twin, numberless))}
    monkeypatch.setattr(drivers.discovery, "_ASK", 0.02)
    monkeypatch.setattr(companion.port_check, "STABLE_NAMES", udev)
    monkeypatch.setattr(companion.port_check, "serial_ports", lambda: ports)
    said: list[str] = []
    found = check_ports([], 0.1, said.append)
    assert [finding.path for finding in found] == [port.device for port in ports]
    stable = [by_id, by_path[twin], other_twin.path, by_path[numberless], onboard.path]
    assert [finding.stable for finding in found] == stable
    assert found[0].names == [by_id, by_path[unique]]
    assert [finding.adapter for finding in found] == [
        "Silicon Labs CP2102 10c4:ea60 serial A1",
        *["Silicon Labs CP2102 10c4:ea60 serial 0001"] * 2,
        "Silicon Labs CP2102 10c4:ea60",
        "",
    ]
    assert "not asked, since it is no USB adapter" in found[4].text
    assert onboard.received == b""
    assert all(device.received for device in (unique, twin, other_twin, numberless))


def test_lines_for_the_site_file_name_each_table_once() -> None:
    found = [
        Finding(f"/dev/ttyUSB{i}", [], f"/dev/serial/by-path/{i}", "", "", speaker, 115_200)
        for i, speaker in enumerate(["rplidar", "rplidar", None, "linktrack", MAVLINK, MAVLINK, NMEA])
    ]
    assert tomllib.loads(site_tables(found)) == {
        "sensor": {
            "lidar": {"driver": "rplidar", "port": "/dev/serial/by-path/0?baud=115200"},
            "lidar2": {"driver": "rplidar", "port": "/dev/serial/by-path/1?baud=115200"},
            "uwb": {"driver": "linktrack", "port": "/dev/serial/by-path/3?baud=115200"},
        },
        "mavlink": {"url": "/dev/serial/by-path/4", "baud": 115_200},
    }
    assert site_tables(found[2:3]) == ""


def test_no_port_at_all_comes_with_what_to_check(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(companion.port_check, "serial_ports", list)
    result = doctor()
    assert result.exit_code == 1
    for hint in ("no serial port found", "lsusb", "only charge", "dmesg"):
        assert hint in result.output


@pytest.mark.parametrize("path", ["/dev/ttyGONE", "/etc/passwd"])
def test_what_is_no_port_is_a_wrong_call(path: str) -> None:
    result = doctor(path)
    assert isinstance(result.exception, UserError)
    assert str(result.exception).startswith(f"{path} is no serial port, there are: ")


def test_no_time_to_listen_is_a_wrong_call() -> None:
    assert doctor("--listen", "0").exit_code == 2


def test_something_found_is_success(plug: Plug) -> None:
    device = plug("tty", tag())
    result = doctor("--listen", f"{LISTEN}", device.link, device.link)
    assert result.exit_code == 0
    assert result.stdout.count("LinkTrack tag 3") == 1
    assert f'port = "{device.link}?baud=921600"' in result.stdout
