"""Who has a serial port, and what to do when it cannot be opened.

Source: Linux man pages proc(5), pty(7).
"""

import errno
import getpass
import grp
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from serial.tools.list_ports import comports
from serial.tools.list_ports_common import ListPortInfo

_KNOWN_PROGRAMS = {
    "ModemManager": "it tries every new serial port: sudo systemctl disable --now ModemManager",
    "agetty": "a serial console: sudo systemctl disable --now serial-getty@{name}, and take "
    "console={name} off the kernel's command line",
    "brltty": "it takes adapters for a braille display: sudo apt remove brltty",
}
"""Programs that take serial ports without having been asked to, and how to stop them."""
_LONGEST_PROGRAM = 40
_CONSOLES = Path("/sys/class/tty/console/active")
_PSEUDO_TERMINAL_MASTERS = ("/dev/ptmx", "/dev/pts/ptmx")


@dataclass(frozen=True, slots=True)
class Holder:
    """A program that has a device open.

    Attributes:
        pid: its process; 0 = the kernel.
        program: how its command line begins.
    """

    pid: int
    program: str

    def __str__(self) -> str:
        return f"{self.program} (pid {self.pid})" if self.pid else self.program


def serial_ports() -> list[ListPortInfo]:
    """Serial ports of this machine, by path; none while one of them is being unplugged."""
    try:
        return sorted(comports(), key=lambda port: port.device)
    except (OSError, TypeError, ValueError):
        # pyserial reads what is no longer there.
        return []


def holders(paths: Iterable[str]) -> dict[str, list[Holder]]:
    """Who has devices open, this program included; programs of other users only root can see.

    The kernel has its consoles, which are not to be disturbed either. Who serves the far side of a
    pseudo-terminal is its device, not one of its users.

    Args:
        paths: of the devices, or links to them.

    Returns:
        For each path the programs, by process.
    """
    devices = {path: os.path.realpath(path) for path in paths}
    found: dict[str, list[Holder]] = {path: [] for path in devices}
    with suppress(OSError):
        consoles = _CONSOLES.read_text(encoding="ascii").split()
        for path, device in devices.items():
            if Path(device).name in consoles:
                found[path].append(Holder(0, "the kernel, as its console"))
    for process in _processes():
        links = _open_files(process)
        opened = set(links.values())
        for path, device in devices.items():
            if device in opened and not _serves(process, links, device):
                found[path].append(Holder(int(process.name), _program(process)))
    return found


def advice(path: str, error: Exception) -> str:
    """What to do about a device that could not be opened; empty when there is nothing to say.

    Args:
        path: of the device.
        error: that opening it raised.
    """
    # The device may vanish meanwhile, and a user may have no name.
    with suppress(OSError, KeyError):
        match getattr(error, "errno", None):
            case errno.ENOENT:
                there = ", ".join(port.device for port in serial_ports())
                return f"there are: {there or 'no serial ports at all'}; see companion doctor ports"
            case errno.EACCES:
                return _permission_advice(path)
            case errno.EAGAIN | errno.EBUSY:
                return _busy_advice(path)
    return ""


def _permission_advice(path: str) -> str:
    status = os.stat(path)
    try:
        group = grp.getgrgid(status.st_gid)
    except KeyError:
        return f"the device belongs to group {status.st_gid}, which has no name; check the udev rules"
    if not status.st_gid or not status.st_mode & stat.S_IWGRP:
        return "only root may use the device; check the udev rules"
    if getpass.getuser() in group.gr_mem:
        return f"you are in the group {group.gr_name}, but not yet in this session: log in again"
    return (
        f"add yourself to the group {group.gr_name}: sudo usermod -aG {group.gr_name} $USER, "
        "then log in again"
    )


def _busy_advice(path: str) -> str:
    users = holders([path])[path]
    said = []
    for user in users:
        known = _known(user.program, path)
        if user.pid == os.getpid():
            known = ", this one: is the port given twice?"
        said.append(f"{user}{known}")
    if not users:
        said.append(f"sudo fuser -v {path} tells which")
        programs = {_program(process).partition(" ")[0] for process in _processes()}
        said += [f"{program} runs{_known(program, path)}" for program in programs & set(_KNOWN_PROGRAMS)]
    return "; ".join(said)


def _known(program: str, path: str) -> str:
    how = _KNOWN_PROGRAMS.get(program.partition(" ")[0], "")
    return how and ", " + how.format(name=Path(os.path.realpath(path)).name)


def _processes() -> Iterator[Path]:
    with suppress(OSError):
        yield from (entry for entry in Path("/proc").iterdir() if entry.name.isdigit())


def _open_files(process: Path) -> dict[str, str]:
    """Descriptor -> path of what a process has open; empty when that may not be known."""
    links: dict[str, str] = {}
    with suppress(OSError):
        for fd in (process / "fd").iterdir():
            with suppress(OSError):
                links[fd.name] = str(fd.readlink())
    return links


def _serves(process: Path, links: dict[str, str], device: str) -> bool:
    """Whether a process holds the master of this pseudo-terminal."""
    index = f"tty-index:\t{Path(device).name}\n"
    for fd, path in links.items():
        with suppress(OSError):
            if path in _PSEUDO_TERMINAL_MASTERS and index in (process / "fdinfo" / fd).read_text():
                return True
    return False


def _program(process: Path) -> str:
    """Begin of a command line, without folders: `python3 mavproxy.py --master`."""
    try:
        words = (process / "cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return "?"
    return " ".join(Path(word).name for word in words[:3] if word)[:_LONGEST_PROGRAM] or "?"
