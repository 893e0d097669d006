"""Memory of an hour's run: one walk that never ends, and what the process holds meanwhile.

    python -m tests.soak.memory --minutes 60

Emulated devices, drivers, estimator, health, MAVLink and the log run in memory in simulated time, as in a
live run. What is loaded and what a window or a map of the room needs is there after some minutes; from then
on the process may not grow. Exit code 1 when it does.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from rich.console import Console

from companion.log import Direction, LogWriter, RawChunk
from companion.sim.scenario import load_scenario
from companion.sim.simulate import START_NS
from tests.soak.onboard import BASE, Onboard, scenario_text

SETTLED = 5.0
"""Until then the process grows [min]: code is loaded, windows and map fill."""
ALLOWED_MB = 10.0
"""By which an hour may grow it."""


def resident_mb() -> float:
    """Memory that the process holds now [MB]."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * 4096 / 1e6


def held(minutes: float, estimator: str, folder: Path) -> Iterator[tuple[float, float]]:
    """Walk laps of the demo's room.

    Args:
        minutes: of simulated time.
        estimator: whose poses are sent.
        folder: for scenario and log.

    Yields:
        Minute and memory [MB], every minute.
    """
    path = folder / "laps.toml"
    laps = f"laps = {2 * round(minutes) + 1}\n"
    path.write_text(scenario_text(BASE).replace("laps = 1\n", laps), encoding="utf-8")
    scenario = load_scenario(path, 1, [])
    config = scenario.config
    next_ns, end_ns = START_NS, START_NS + round(minutes * 60e9)
    with closing(LogWriter(folder / "run.mcap", config.to_toml(), START_NS)) as log:
        for item in Onboard(config).walk(scenario, estimator):
            if isinstance(item, RawChunk):
                if item.stamp_ns >= end_ns:
                    break
                log.raw(item)
                if item.stamp_ns >= next_ns:
                    yield (next_ns - START_NS) / 60e9, resident_mb()
                    next_ns += 60_000_000_000
            else:
                for name, data in item.data.items():
                    log.raw(RawChunk(name, Direction.OUT, item.now_ns, data))
    yield minutes, resident_mb()


def main() -> int:
    """Run as told on the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=60.0, help="of simulated time (default 60)")
    parser.add_argument("--estimator", default="pf_ibas_graph", help="default pf_ibas_graph")
    arguments = parser.parse_args()
    out = Console(highlight=False)
    settled = 0.0
    with tempfile.TemporaryDirectory() as folder:
        for minute, megabytes in held(arguments.minutes, arguments.estimator, Path(folder)):
            if minute <= SETTLED:
                settled = megabytes
            if minute % 5.0 == 0.0:
                out.print(f"{minute:4.0f} min  {megabytes:6.1f} MB")
    growth = megabytes - settled
    out.print(f"grew by {growth:.1f} MB from minute {SETTLED:.0f} on, at most {ALLOWED_MB:.0f} are allowed")
    return 0 if growth <= ALLOWED_MB else 1


if __name__ == "__main__":
    sys.exit(main())
