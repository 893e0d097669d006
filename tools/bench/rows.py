"""A row of the table: one task done by us and by peers in the same run, interleaved, in the same process."""

import gc
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

from rich.box import SIMPLE
from rich.table import Table

Run: TypeAlias = Callable[[], object]

ROUNDS = 7
TOLERANCE = 0.3
"""A ratio may fall below its baseline by this share: so much differs between processors and runs."""

_LEAST_S = 0.1  # a run shorter than this is repeated within its round


@dataclass(frozen=True, slots=True)
class Benchmark:
    """A task and who does it.

    Attributes:
        unit: of the figure.
        better: "higher": the figure is `work` per second; "lower": it is seconds per `work`.
        work: what one run does, in the unit.
        ours: one run by this project.
        peers: program and version -> one run that does the same work.
        needed: what a device or the clock on the wall asks for, and that as a figure; instead of a peer.
    """

    unit: str
    better: Literal["higher", "lower"]
    work: float
    ours: Run
    peers: Mapping[str, Run] = field(default_factory=dict)
    needed: tuple[str, float] | None = None


@dataclass(frozen=True, slots=True)
class Row:
    """Result of a benchmark.

    Attributes:
        name: of the benchmark.
        ours: our figure, median over the rounds.
        peer: figure of the fastest peer; None without one.
        peer_name: its name and version.
        ratio: how many times better ours is: 1 is equal, above 1 ours is better.
        unit: of both figures.
        better: which of two figures is the better one.
        spread: (slowest - fastest round) / median, the larger one of ours and the peer's.
    """

    name: str
    ours: float
    peer: float | None
    peer_name: str | None
    ratio: float | None
    unit: str
    better: Literal["higher", "lower"]
    spread: float


def measure(name: str, benchmark: Benchmark) -> Row:
    """Run a benchmark: each round has one turn of ours and one of every peer."""
    ours = "ours"
    runs = {ours: benchmark.ours, **benchmark.peers}
    repeats = {who: max(1, math.ceil(_LEAST_S / _seconds(run, 1))) for who, run in runs.items()}
    rounds: dict[str, list[float]] = {who: [] for who in runs}
    for _ in range(ROUNDS):
        for who, run in runs.items():
            rounds[who].append(_seconds(run, repeats[who]))
    median = {who: statistics.median(seconds) for who, seconds in rounds.items()}

    def figure(who: str) -> float:
        return benchmark.work / median[who] if benchmark.better == "higher" else median[who] / benchmark.work

    peer: float | None = None
    peer_name: str | None = None
    spread = _spread(rounds[ours])
    if benchmark.peers:
        peer_name = min(benchmark.peers, key=median.__getitem__)
        peer = figure(peer_name)
        spread = max(spread, _spread(rounds[peer_name]))
    elif benchmark.needed is not None:
        peer_name, peer = benchmark.needed
    ratio = None
    if peer is not None:
        ratio = figure(ours) / peer if benchmark.better == "higher" else peer / figure(ours)
    return Row(name, figure(ours), peer, peer_name, ratio, benchmark.unit, benchmark.better, spread)


def table(rows: Sequence[Row], title: str) -> Table:
    """The rows for a terminal."""
    found = Table(title=title, title_justify="left", box=SIMPLE)
    found.add_column("row", no_wrap=True)
    for heading in ("ours", "ratio", "spread"):
        found.add_column(heading, justify="right", no_wrap=True)
    found.add_column("peer", overflow="fold")
    for row in rows:
        found.add_row(
            row.name,
            f"{_number(row.ours)}{row.unit}",
            "-" if row.ratio is None else f"{row.ratio:.3g}",
            f"{row.spread:.0%}",
            "-" if row.peer is None else f"{_number(row.peer).strip()}, {row.peer_name}",
        )
    return found


def shortfalls(rows: Sequence[Row], baseline: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line for every row whose ratio is not what the baseline lets expect; the others are not compared."""
    expected = {entry["name"]: entry for entry in baseline}
    lines = []
    for row in rows:
        if row.name not in expected:
            continue
        ratio, peer_name = expected[row.name]["ratio"], expected[row.name]["peer_name"]
        least = (1 - TOLERANCE) * ratio
        if row.ratio is None:
            lines.append(f"{row.name}: no peer to compare with (baseline: {ratio:.3g} x {peer_name})")
        elif row.ratio < least:
            lines.append(
                f"{row.name}: {row.ratio:.3g} x {row.peer_name}, must be at least {least:.3g} "
                f"(baseline: {ratio:.3g} x {peer_name})"
            )
    return lines


def _seconds(run: Run, repeats: int) -> float:
    """CPU time of one run, which other processes do not lengthen.

    The garbage collector is off: when it runs depends on what ran before.
    """
    gc.collect()
    gc.disable()
    try:
        begin = time.process_time()
        for _ in range(repeats):
            run()
        return (time.process_time() - begin) / repeats
    finally:
        gc.enable()


def _spread(seconds: Sequence[float]) -> float:
    return (max(seconds) - min(seconds)) / statistics.median(seconds)


def _number(value: float) -> str:
    for scale, prefix in ((1e6, "M"), (1e3, "k")):
        if value >= scale:
            return f"{value / scale:.3g} {prefix}"
    return f"{value:.3g} "
