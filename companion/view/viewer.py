"""Rerun's own viewer as a process beside ours: in a window, or as a page for a browser."""

import os
import socket
import subprocess
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from companion.config_tables import ViewTable
from companion.errors import UserError
from companion.interrupt import set_by_signals

Mode = Literal["web", "native"]
Shown = Literal["web", "native", "off"]
READY_WITHIN = 20.0
"""A viewer that does not listen so long [s] after its start will not come."""
_NICE = 10
"""Whatever else this computer has to do comes before pictures."""


class Viewer:
    """A viewer of a file, or one that waits for data.

    Args:
        mode: "web" serves a page and its data at `view.bind`; "native" opens a window on this computer.
        table: addresses and limits.
        file: `.rrd` file to show; None to wait for data.

    Raises:
        UserError: no screen for a window, or a port is in use.
    """

    def __init__(self, mode: Mode, table: ViewTable, file: Path | None = None) -> None:
        self._mode, self._bind = mode, _address(mode, table)
        check_viewer(mode, table)
        self._data_port, self._web_port = table.data_port, table.web_port
        limit = f"{table.memory_mb}MB"
        options = ["--bind", self._bind, "--port", str(table.data_port), "--server-memory-limit", limit]
        if mode == "web":
            options += ["--serve-web", "--web-viewer-port", str(table.web_port)]
            if not table.bind.is_loopback:
                # The page comes from this computer under whatever name the browser has for it.
                options += ["--cors-allow-origin", f"http://*:{table.web_port}"]
        else:
            options += ["--expect-data-soon"] if file is None else []
        options += [str(file)] if file is not None else []
        self._process = subprocess.Popen(  # noqa: S603  # a program of ours with checked settings
            [_program(), *options],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "RERUN_APP_ONLY": "true"},
            # A window outlives the run; a page ends with whatever process group serves it.
            start_new_session=mode == "native",
        )
        os.setpriority(os.PRIO_PROCESS, self._process.pid, _NICE)

    @property
    def url(self) -> str:
        """Where data is to be sent."""
        return f"rerun+http://{_host(self._bind)}:{self._data_port}/proxy"

    @property
    def page(self) -> str:
        """What to open in a browser; empty for a window."""
        if self._mode == "native":
            return ""
        host = _host(self._bind)
        data = f"rerun%2Bhttp%3A%2F%2F{host}%3A{self._data_port}%2Fproxy"
        # Labels are drawn for a dark ground, whatever the browser prefers.
        return f"http://{host}:{self._web_port}/?url={data}&theme=dark"

    @property
    def is_page(self) -> bool:
        """Whether it is a page for a browser, not a window."""
        return self._mode == "web"

    @property
    def is_running(self) -> bool:
        """False once it was closed, or died."""
        return self._process.poll() is None

    def wait_until_ready(self) -> None:
        """Wait until it listens.

        Raises:
            UserError: it ended, or does not listen in time.
        """
        end = time.monotonic() + READY_WITHIN
        while time.monotonic() < end and self.is_running:
            with socket.socket() as probe:
                probe.settimeout(1.0)
                if probe.connect_ex((_host(self._bind), self._data_port)) == 0:
                    return
            time.sleep(0.05)
        self.kill()
        raise UserError("rerun: the viewer does not start; try: python -m rerun_cli --version")

    def serve_until_interrupted(self) -> None:
        """Wait for Ctrl-C, or until it ends by itself; then end it."""
        with set_by_signals() as stop:
            while self.is_running and not stop.wait(0.2):
                pass
        self.kill()

    def kill(self) -> None:
        """End it at once, whatever state it is in."""
        self._process.kill()
        self._process.wait()


def has_screen() -> bool:
    """Whether this computer can open a window."""
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def check_viewer(mode: Mode, table: ViewTable) -> None:
    """Whether a viewer can be started.

    Raises:
        UserError: no screen for a window, or a port is in use.
    """
    if mode == "native" and not has_screen():
        raise UserError("--view native: this computer has no screen (DISPLAY is not set); use --view web")
    _check_port(_address(mode, table), table.data_port, "view.data_port")
    if mode == "web":
        _check_port(_address(mode, table), table.web_port, "view.web_port")


def _program() -> str:
    """Rerun's viewer, without the Python program before it, which would not hand on that it was killed."""
    spec = find_spec("rerun_cli")
    program = Path(spec.origin if spec is not None and spec.origin else "").with_name("rerun")
    if not program.is_file():
        raise UserError(f"rerun: the viewer is not installed for this system (no file {program})")
    return str(program)


def free_port() -> int:
    """A port of the loopback interface that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _address(mode: Mode, table: ViewTable) -> str:
    """Where it listens; a window needs nothing from other computers."""
    return str(table.bind) if mode == "web" else "127.0.0.1"


def _check_port(address: str, port: int, key: str) -> None:
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
        except OSError as error:
            raise UserError(
                f"{key}: cannot listen at {address}:{port}: {error.strerror}; "
                f"choose another with --set {key}=PORT"
            ) from error


def _host(address: str) -> str:
    """An address to reach this computer at, for one to listen at."""
    if address in ("0.0.0.0", "::"):  # noqa: S104
        return socket.gethostname() if address == "0.0.0.0" else "[::1]"  # noqa: S104
    return f"[{address}]" if ":" in address else address
