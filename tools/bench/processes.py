"""Rows of whole processes: how long a start takes, what a live run costs in time and memory."""

import os
import resource
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from companion.shipped_files import params_dir
from tools.bench.rows import Row

_STARTS = 5
_WARM_UP_S, _LIVE_S = 6.0, 20.0
"""A live run begins with the search for its place; then it is watched for so long."""
_SETTLED_S = 1.0
"""The emulator has loaded what it needs by then."""
_HELP_NEEDED_S, _FIRST_POSE_NEEDED_S, _LIVE_SHARE_NEEDED, _LIVE_MEMORY_NEEDED_MB = 0.5, 3.0, 0.15, 300.0
_COMPANION = [sys.executable, "-m", "companion"]


def startup_help_s() -> Row:
    """CPU time of `companion --help`: its time on a machine that does nothing else."""
    seconds = []
    for _ in range(_STARTS):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([*_COMPANION, "--help"], stdout=subprocess.DEVNULL, check=True)  # noqa: S603
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return _lower("startup_help_s", seconds, "s", "the issue's limit", _HELP_NEEDED_S)


def live_cpu_share() -> Row:
    """Share of one core that `companion run` takes beside emulated devices on pseudo-terminals."""
    share, _ = _live()
    return _lower("live_cpu_share", [share], "of a core", "the issue's limit", _LIVE_SHARE_NEEDED)


def live_memory_mb() -> Row:
    """Resident memory of the same run."""
    _, megabytes = _live()
    return _lower("live_memory_mb", [megabytes], "MB", "of a 512 MB computer", _LIVE_MEMORY_NEEDED_MB)


def live_first_pose_s() -> Row:
    """Time from the start of `companion run` to its first pose that may be flown on."""
    seconds = []
    for _ in range(_STARTS):
        with _live_run(stderr=subprocess.PIPE) as run:
            begin = time.monotonic()
            assert run.stderr is not None
            next(line for line in run.stderr if line.rstrip().endswith("health: ok"))
            seconds.append(time.monotonic() - begin)
    return _lower("live_first_pose_s", seconds, "s", "the issue's limit", _FIRST_POSE_NEEDED_S)


def _lower(name: str, figures: list[float], unit: str, needed_name: str, needed: float) -> Row:
    ours = statistics.median(figures)
    spread = (max(figures) - min(figures)) / ours
    return Row(name, ours, needed, needed_name, needed / ours, unit, "lower", spread)


@cache
def _live() -> tuple[float, float]:
    """CPU share and memory [MB] of a run; the walk of the demo in real time."""
    with _live_run(stderr=subprocess.DEVNULL) as run:
        time.sleep(_WARM_UP_S)
        before, begin = _cpu_s(run.pid), time.monotonic()
        time.sleep(_LIVE_S)
        return (_cpu_s(run.pid) - before) / (time.monotonic() - begin), _resident_mb(run.pid)


@contextmanager
def _live_run(stderr: int) -> Iterator["subprocess.Popen[str]"]:
    """`companion run`, just started, beside emulated devices that are there already."""
    with TemporaryDirectory(prefix="bench-") as folder:
        site = params_dir() / "sites" / "demo_room.toml"
        emulate = [*_COMPANION, "emulate", "square_room"]
        emulator = subprocess.Popen(  # noqa: S603
            emulate, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert emulator.stdout is not None
        ports = dict(emulator.stdout.readline().split() for _ in range(2))
        time.sleep(_SETTLED_S)
        options = [f"--set=sensor.{name}.port={path}" for name, path in ports.items()]
        run = subprocess.Popen(  # noqa: S603
            [*_COMPANION, "run", "--site", str(site), *options, "--out", str(Path(folder) / "run")],
            stderr=stderr,
            text=True,
        )
        try:
            yield run
        finally:
            for process in (run, emulator):
                process.send_signal(signal.SIGINT)
            for process in (run, emulator):
                process.wait(timeout=20)


def _cpu_s(pid: int) -> float:
    """CPU time that a process has used [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _resident_mb(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


ROWS: dict[str, Callable[[], Row]] = {
    "startup_help_s": startup_help_s,
    "live_cpu_share": live_cpu_share,
    "live_memory_mb": live_memory_mb,
    "live_first_pose_s": live_first_pose_s,
}
"""Name of the row -> what measures it."""
