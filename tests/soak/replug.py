"""Pull and put back the plugs of both emulated devices during a live run, at random moments, many times.

    python tests/soak/replug.py --cycles 100

Every time the ranges and the scans must be back within 2 s; at the end no thread and no file handle may be
left over, nothing may have been raised, and the log must be whole. Exit code 1 when something is not so.
"""

import argparse
import os
import random
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console
from rich.progress import track

from companion.config import load_config
from companion.live import LiveRun
from companion.log import Direction, Log, RawChunk
from companion.pipeline import make_sensors
from companion.replay import config_of
from companion.shipped_files import params_dir
from companion.sim.emulate import Emulator
from companion.sim.scenario import load_scenario
from estimators.messages import RangeFrame, Scan

RECOVERY = 2.0
"""Longest time from the plug to the next measurement [s]."""
SETTLE = 4.0
"""Time for the first opening [s]."""
PULSE = {"uwb": RangeFrame, "lidar": Scan}
"""Sensor -> the measurement that shows that it works again."""


@dataclass
class Outcome:
    """What a soak run found.

    Attributes:
        recoveries: seconds from each plug to the next measurement of that sensor.
        faults: what is wrong, a line each; empty when all is well.
    """

    recoveries: list[float] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)


def soak(cycles: int, seed: int, folder: Path) -> Outcome:
    """Run the cycles and judge them.

    Args:
        cycles: how often plugs are pulled.
        seed: of the moments and of which plugs.
        folder: run folder to write.
    """
    outcome = Outcome()
    rng = random.Random(seed)
    emulator = Emulator(load_scenario(params_dir() / "scenarios" / "square_room.toml", seed, []))
    ports = [f"sensor.{name}.port={port.path}" for name, port in emulator.ports.items()]
    config = load_config(params_dir() / "sites" / "demo_room.toml", [*ports, 'mavlink.url=""'])
    stop = threading.Event()
    raised: list[str] = []
    threading.excepthook = lambda args: raised.append(repr(args.exc_value))
    devices = threading.Thread(target=emulator.run, args=(stop, lambda _: None))
    live = LiveRun(config, folder, lambda _: None)
    process = threading.Thread(target=live.run, args=(stop,))
    threads, plugged = threading.active_count(), []
    devices.start()
    process.start()
    try:
        time.sleep(SETTLE)
        handles = _open_files()
        for _ in track(range(cycles), "unplugging", console=Console(stderr=True), transient=True):
            names = rng.choice((["uwb"], ["lidar"], ["uwb", "lidar"]))
            for name in names:
                emulator.ports[name].line.plugged = False
            time.sleep(rng.uniform(0.05, 0.8))
            for name in names:
                emulator.ports[name].line.plugged = True
                plugged.append((name, time.monotonic_ns()))
            time.sleep(RECOVERY + rng.uniform(0.0, 0.5))
        if (left := _open_files()) != handles:
            outcome.faults.append(f"{handles} file handles before the first pull, {left} after the last")
    finally:
        stop.set()
        process.join()
        devices.join()
        emulator.close()
        threading.excepthook = threading.__excepthook__
    if (left := threading.active_count()) != threads:
        outcome.faults.append(f"{threads} threads before, {left} after")
    outcome.faults += [f"raised: {what}" for what in raised]
    _judge_log(folder / "raw.mcap", plugged, outcome)
    return outcome


def _judge_log(path: Path, plugged: Sequence[tuple[str, int]], outcome: Outcome) -> None:
    log = Log(path)
    sensors = make_sensors(config_of(log, []))
    measured: dict[str, list[int]] = {name: [] for name in sensors}
    for record in log:
        if isinstance(record, RawChunk) and record.direction is Direction.IN and record.source in sensors:
            for measurement in sensors[record.source].feed(record.data, record.stamp_ns):
                if isinstance(measurement, PULSE[record.source]):
                    measured[record.source].append(record.stamp_ns)
    if not log.complete:
        outcome.faults.append(f"{path} is damaged")
    for name, stamp_ns in plugged:
        after = next((at for at in measured[name] if at > stamp_ns), None)
        recovery = (after - stamp_ns) * 1e-9 if after is not None else float("inf")
        outcome.recoveries.append(recovery)
        if recovery > RECOVERY:
            outcome.faults.append(
                f"{name} came back {recovery:.2f} s after the plug, allowed are {RECOVERY:g} s"
            )


def _open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


def main() -> int:
    """Soak as told on the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cycles", type=int, default=100, help="how often plugs are pulled (default 100)")
    parser.add_argument("--seed", type=int, default=1, help="of the moments and of which plugs (default 1)")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        outcome = soak(arguments.cycles, arguments.seed, Path(folder))
    times = sorted(outcome.recoveries)
    out = Console(soft_wrap=True)
    out.print(
        f"{arguments.cycles} cycles, {len(times)} plugs: back after {times[len(times) // 2]:.2f} s (median), "
        f"{times[-1]:.2f} s (longest)"
    )
    out.print("\n".join(outcome.faults) or "nothing left over, nothing raised, log whole")
    return 1 if outcome.faults else 0


if __name__ == "__main__":
    sys.exit(main())
