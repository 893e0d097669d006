"""Serial lines: had alone, and in plain words why one cannot be had."""

import errno
import fcntl
import grp
import os
import pwd
import signal
import subprocess
import sys
import termios
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import serial.tools.list_ports_linux

from drivers.port import OpenError, PortAddress
from drivers.port_advice import advice, holders, serial_ports
from drivers.serial_line import SerialWire
from tests.drivers.far_side import Pty

TIOCGEXCL = 0x80045440
NOBODY = pwd.getpwnam("nobody").pw_uid
HOLD = "import os, sys; os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); print(flush=True); sys.stdin.read()"
USE = (
    "import sys; from drivers.serial_line import *; wire = SerialWire(PortAddress(sys.argv[1], 9600));"
    "print(flush=True); sys.stdin.read()"
)


@pytest.fixture
def pty(tmp_path: Path) -> Iterator[Pty]:
    device = Pty(tmp_path / "tty")
    yield device
    device.unplug()


def wire(path: Path | str) -> SerialWire:
    return SerialWire(PortAddress(str(path), 115_200))


def refusal(path: Path | str) -> str:
    """Message and advice, as an operator sees them."""
    with pytest.raises(OpenError) as caught:
        wire(path)
    return f"{caught.value} ({caught.value.advise()})"


@contextmanager
def program(name: str, code: str, path: str) -> Iterator[subprocess.Popen[str]]:
    """A process of that name which has the port open."""
    process = subprocess.Popen(
        [name, "-c", code, path],
        executable=sys.executable,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": ":".join(filter(None, sys.path))},
    )
    with process:
        assert process.stdout is not None
        assert process.stdout.readline() == "\n"
        yield process
        process.kill()


def test_a_line_is_had_alone_by_whatever_name(tmp_path: Path, pty: Pty) -> None:
    first = wire(pty.link)
    assert "in use by another program" in refusal(pty.path)
    first.close()
    second = wire(pty.path)
    assert "in use by another program" in refusal(pty.link)
    second.close()
    wire(pty.link).close()


@pytest.mark.parametrize("dtr_stops", [True, False])
def test_the_dtr_line_outlives_the_port_where_it_stops_the_device(pty: Pty, dtr_stops: bool) -> None:
    settings = termios.tcgetattr(pty.slave)
    settings[2] |= termios.HUPCL  # as real lines have it
    termios.tcsetattr(pty.slave, termios.TCSANOW, settings)
    SerialWire(PortAddress(str(pty.path), 115_200), dtr_stops).close()
    # A pseudo-terminal has no DTR line; what keeps it on is the absence of a hang-up at the close.
    hangs_up = bool(termios.tcgetattr(pty.slave)[2] & termios.HUPCL)
    assert hangs_up is not dtr_stops


def test_another_program_is_named_with_its_pid(pty: Pty) -> None:
    with program("gpsd", USE, pty.path) as process:
        said = refusal(pty.link)
    assert said.startswith(f"cannot open {pty.link}: in use by another program (gpsd -c ")
    assert said.endswith(f"(pid {process.pid}))")


def test_a_program_that_takes_ports_unasked_comes_with_what_to_do(pty: Pty) -> None:
    with program("ModemManager", USE, pty.path):
        assert "sudo systemctl disable --now ModemManager" in refusal(pty.link)


def test_who_uses_a_port_is_found_behind_links_and_its_far_side_does_not_count(pty: Pty) -> None:
    assert holders([str(pty.link), pty.path]) == {str(pty.link): [], pty.path: []}
    with program("cat", HOLD, pty.path) as process:
        found = holders([str(pty.link), pty.path, "/dev/null"])
        assert [holder.pid for holder in found[str(pty.link)]] == [process.pid]
        assert found[pty.path] == found[str(pty.link)]
        assert str(found[pty.path][0]).startswith("cat -c ")


def test_a_port_that_is_given_twice_is_said_to_be(pty: Pty) -> None:
    serve = "import os, sys; m, s = os.openpty(); print(os.ttyname(s), flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", serve], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as far_side:
        assert far_side.stdout is not None
        path = far_side.stdout.readline().strip()
        line = wire(path)
        assert refusal(path).endswith(f"(pid {os.getpid()}), this one: is the port given twice?)")
        line.close()
        far_side.kill()


def test_a_console_of_the_kernel_is_in_use(pty: Pty, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "active").write_text(f"tty0 {Path(pty.path).name}\n")
    monkeypatch.setattr("drivers.port_advice._CONSOLES", tmp_path / "active")
    assert list(map(str, holders([pty.path])[pty.path])) == ["the kernel, as its console"]


def test_the_claim_of_another_program_counts_even_for_root(pty: Pty) -> None:
    fcntl.ioctl(pty.slave, termios.TIOCEXCL)
    assert "in use by another program" in refusal(pty.link)
    fcntl.ioctl(pty.slave, termios.TIOCNXCL)
    wire(pty.link).close()


def test_a_pseudo_terminal_can_be_had_after_its_user_was_killed(pty: Pty) -> None:
    with program("python", USE, pty.path) as process:
        process.send_signal(signal.SIGKILL)
        process.wait()
        wire(pty.link).close()


def test_a_real_line_keeps_out_who_does_not_lock_until_it_is_closed() -> None:
    terminal = "/dev/tty63"
    try:
        fd = os.open(terminal, os.O_RDWR | os.O_NOCTTY)
    except OSError:
        pytest.skip("no virtual terminal to open")
    line = wire(terminal)
    assert fcntl.ioctl(fd, TIOCGEXCL, bytes(4)) != bytes(4)
    line.close()
    assert fcntl.ioctl(fd, TIOCGEXCL, bytes(4)) == bytes(4)
    os.close(fd)


def test_a_refused_line_leaves_nothing_open(tmp_path: Path, pty: Pty) -> None:
    (tmp_path / "file").write_text("")
    fcntl.ioctl(pty.slave, termios.TIOCEXCL)
    before = len(os.listdir("/proc/self/fd"))
    for path in (pty.link, tmp_path / "file", tmp_path / "gone"):
        refusal(path)
    assert len(os.listdir("/proc/self/fd")) == before


@contextmanager
def an_ordinary_user() -> Iterator[None]:
    user = os.geteuid()
    if user == 0:
        os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(user)


def test_permission_denied_says_how_to_get_it(pty: Pty) -> None:
    group = grp.getgrgid(os.getgid()) if os.getgid() else grp.getgrnam("tty")
    os.chown(pty.path, -1, group.gr_gid)
    os.chmod(pty.path, 0o060)
    with an_ordinary_user():
        said = refusal(pty.path)
    assert said == (
        f"cannot open {pty.path}: Permission denied (add yourself to the group {group.gr_name}: "
        f"sudo usermod -aG {group.gr_name} $USER, then log in again)"
    )


def test_permission_that_no_group_gives_is_a_matter_of_udev(pty: Pty) -> None:
    os.chmod(pty.path, 0o000)
    with an_ordinary_user():
        assert "only root may use the device; check the udev rules" in refusal(pty.path)


def test_who_is_in_the_group_only_has_to_log_in_again(pty: Pty, monkeypatch: pytest.MonkeyPatch) -> None:
    group = next((g for g in grp.getgrall() if g.gr_mem and g.gr_gid), None)
    if group is None or os.geteuid():
        pytest.skip("no group with members")
    os.chown(pty.path, -1, group.gr_gid)
    os.chmod(pty.path, 0o060)
    monkeypatch.setenv("LOGNAME", group.gr_mem[0])
    said = advice(pty.path, OSError(errno.EACCES, ""))
    assert said == f"you are in the group {group.gr_name}, but not yet in this session: log in again"


def test_a_missing_device_comes_with_those_that_are_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ports = [serial.tools.list_ports_linux.SysFS(f"/dev/ttyUSB{i}") for i in (1, 0)]
    monkeypatch.setattr("drivers.port_advice.comports", lambda: ports)
    assert refusal(tmp_path / "tty") == (
        f"cannot open {tmp_path}/tty: No such file or directory "
        "(there are: /dev/ttyUSB0, /dev/ttyUSB1; see companion doctor ports)"
    )
    monkeypatch.setattr("drivers.port_advice.comports", list)
    assert "there are: no serial ports at all" in refusal(tmp_path / "tty")


def test_a_port_that_vanishes_while_ports_are_listed_does_no_harm(monkeypatch: pytest.MonkeyPatch) -> None:
    def comports() -> list[object]:
        return [int(None, 16)]  # type: ignore[call-overload]

    monkeypatch.setattr("drivers.port_advice.comports", comports)
    assert serial_ports() == []


def test_advice_about_what_is_gone_again_is_none() -> None:
    assert advice("/dev/gone", OSError(errno.EACCES, "")) == ""
    assert advice("/dev/gone", ValueError("no such protocol")) == ""


def test_a_changed_rate_forgets_what_came_at_the_other(pty: Pty) -> None:
    line = wire(pty.link)
    os.write(pty.master, b"old")
    line.set_baud(460_800)
    assert termios.tcgetattr(pty.slave)[5] == termios.B460800
    os.write(pty.master, b"new")
    assert line.read() == b"new"
    line.close()


def test_a_closed_line_gives_errors_of_the_system_only(pty: Pty) -> None:
    line = wire(pty.link)
    line.close()
    for use in (line.read, lambda: line.write(b"x"), lambda: line.set_baud(9600)):
        with pytest.raises(OSError):
            use()
