"""Latency of a live run: from the last byte of a sensor to the pose's byte on the way to the autopilot.

    python tools/bench/latency.py --seconds 30
    python tools/bench/latency.py --views off web stalled --rounds 3

Emulated sensors in a process of their own (scans at 10 Hz, ranges at 50 Hz) on pseudo-terminals, `companion
run`'s loop in this one, a UDP autopilot. Times are those of the log, which stamps what is read and written.
The second command compares a run without viewer, one with the web viewer and .rrd files, and one whose viewer
is stopped (SIGSTOP) while it is measured; they take turns, so that what else the machine does hits all alike.
"""

import argparse
import os
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from bisect import bisect_right
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import all as mavlink2
from rich.console import Console

from companion.config import load_config
from companion.live import LiveRun
from companion.log import Direction, Log, RawChunk
from companion.mavlink.link import NAME
from companion.shipped_files import params_dir
from companion.view.viewer import free_port

RANGE_RATE = 50
VIEWS = ("off", "web", "stalled")
WARM_UP = 8.0
"""Until poses are sent and every piece of code has run [s]."""


def main() -> int:
    """Measure as told on the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=30.0, help="measured after a warm-up (default 30)")
    parser.add_argument(
        "--views", nargs="+", choices=VIEWS, default=["off"], help="what watches (default off)"
    )
    parser.add_argument("--rounds", type=int, default=1, help="turns of each (default 1)")
    arguments = parser.parse_args()
    found: dict[str, list[tuple[float, list[float], list[float], float]]] = {v: [] for v in arguments.views}
    for _ in range(arguments.rounds):
        for view in arguments.views:
            with tempfile.TemporaryDirectory() as folder:
                share = _run(Path(folder), arguments.seconds, view)
                found[view].append((share, *_latencies(Path(folder) / "run" / "raw.mcap")))
    out = Console(soft_wrap=True, highlight=False)
    for view, turns in found.items():
        shares, ages, waits, rates = zip(*turns, strict=True)
        out.print(f"view {view}: poses at {np.mean(rates):.1f} Hz, {np.mean(shares):.0%} of one core")
        for name, each in (
            ("last sensor byte in to pose byte out", waits),
            ("age of a pose when sent", ages),
        ):
            values = np.concatenate(each)
            median, high = np.quantile(values, [0.5, 0.99])
            by_turn = ", ".join(f"{np.quantile(turn, 0.99):.1f}" for turn in each)
            out.print(
                f"  {name}: median {median:.2f} ms, p99 {high:.2f} ms (by turn {by_turn}), "
                f"max {values.max():.1f} ms"
            )
    return 0


def _run(folder: Path, seconds: float, view: str) -> float:
    """Leave a log; gives the share of one core that the run took after its warm-up."""
    scenario = folder / "fast.toml"
    base = (params_dir() / "scenarios" / "square_room.toml").read_text(encoding="utf-8")
    base = base.replace('"../sites/', f'"{params_dir() / "sites"}/').replace("laps = 1", "laps = 100")
    scenario.write_text(base + f"\n[uwb]\nrate = {RANGE_RATE}\n", encoding="utf-8")
    emulate = subprocess.Popen(  # noqa: S603 - our own program
        [sys.executable, "-m", "companion", "emulate", str(scenario)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    stop = threading.Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.bind(("127.0.0.1", 0))
        autopilot.settimeout(0.2)
        assert emulate.stdout is not None
        ports = dict(emulate.stdout.readline().split() for _ in range(2))
        sets = [f"sensor.{name}.port={path}" for name, path in ports.items()]
        url = f"mavlink.url=udpout:127.0.0.1:{autopilot.getsockname()[1]}"
        sets += [f"view.data_port={free_port()}", f"view.web_port={free_port()}"]
        sets += ["view.record=true"] if view != "off" else []
        config = load_config(params_dir() / "sites" / "demo_room.toml", [*sets, url])
        live = LiveRun(config, folder / "run", lambda _: None, view="off" if view == "off" else "web")
        threads = [
            threading.Thread(target=live.run, args=(stop,)),
            threading.Thread(target=_answer, args=(autopilot, stop)),
        ]
        for thread in threads:
            thread.start()
        while view != "off" and not _viewers():
            time.sleep(0.5)
        time.sleep(WARM_UP)
        if view == "stalled":
            for process in _viewers():
                os.kill(process, signal.SIGSTOP)
        begin, used = time.monotonic(), _cpu()
        time.sleep(seconds)
        share = (_cpu() - used) / (time.monotonic() - begin)
        stop.set()
        for thread in threads:
            thread.join()
    emulate.terminate()
    emulate.wait()
    emulate.stdout.close()
    return share


def _viewers() -> list[int]:
    """Rerun's own processes that descend from this one."""
    known = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        name, _, rest = stat.read_text(encoding="utf-8").partition(") ")
        known[int(stat.parent.name)] = int(rest.split()[1]), name.partition("(")[2]
    found = []
    for process, (parent, name) in known.items():
        while parent > 1 and parent != os.getpid():
            parent = known.get(parent, (0, ""))[0]
        if parent == os.getpid() and name == "rerun":
            found.append(process)
    return found


def _answer(autopilot: socket.socket, stop: threading.Event) -> None:
    """HEARTBEATs, so that poses are sent."""
    packer = mavlink2.MAVLink(None, srcSystem=1, srcComponent=1)
    due = 0.0
    while not stop.is_set():
        try:
            _, peer = autopilot.recvfrom(4096)
        except TimeoutError:
            continue
        if time.monotonic() >= due:
            due = time.monotonic() + 1.0
            beat = mavlink2.MAVLink_heartbeat_message(2, mavlink2.MAV_AUTOPILOT_ARDUPILOTMEGA, 0, 0, 3, 3)
            autopilot.sendto(bytes(beat.pack(packer)), peer)


def _latencies(path: Path) -> tuple[list[float], list[float], float]:
    """Ages of poses when sent [ms], times since the last sensor byte [ms], rate of poses [Hz]."""
    parser = mavlink2.MAVLink(None)
    arrivals: list[int] = []
    sent: list[tuple[int, int]] = []
    for record in Log(path):
        if not isinstance(record, RawChunk):
            continue
        if record.direction is Direction.IN and record.source != NAME:
            arrivals.append(record.stamp_ns)
        elif record.direction is Direction.OUT and record.source == NAME:
            sent += [
                (record.stamp_ns, message.usec * 1000)
                for message in parser.parse_buffer(record.data) or []
                if message.get_type() == "VISION_POSITION_ESTIMATE"
            ]
    arrivals.sort()
    begin_ns = sent[0][0] + 2_000_000_000
    sent = [pair for pair in sent if pair[0] > begin_ns]
    waits = [(out_ns - arrivals[bisect_right(arrivals, out_ns) - 1]) * 1e-6 for out_ns, _ in sent]
    ages = [(out_ns - stamp_ns) * 1e-6 for out_ns, stamp_ns in sent]
    return ages, waits, (len(sent) - 1) / ((sent[-1][0] - sent[0][0]) * 1e-9)


def _cpu() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


if __name__ == "__main__":
    sys.exit(main())
