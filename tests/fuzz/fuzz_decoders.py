"""Feeds hostile bytes to every decoder and checks what it does with them.

`python tests/fuzz/fuzz_decoders.py` runs each decoder on 10 million bytes, a few minutes in all. After every
chunk: nothing was raised, no more bytes were skipped than fed, and what came out is well-formed. All along:
what the decoder holds stays bounded, and memory does not grow from the second tenth of the run to the last.
A failure names its seed and a file with the bytes that led to it. Exit codes: 0 clean, 1 a failure.
"""

import gc
import logging
import random
import signal
import time
import tracemalloc
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import Progress, TaskID
from rich.table import Table

from drivers.framing import DecodeStats
from tests.fuzz.hostile_streams import Material, hostile_segments
from tests.fuzz.subjects import SUBJECTS, Subject
from tests.fuzz.well_formed import FindingError, held_bytes, require

HELD_LIMIT = 2_000_000
"""Bytes that a decoder may hold: a second of the fastest scan mode, and frames that wait for their end."""
GROWTH_LIMIT = 150_000
"""Bytes by which memory may grow; the bytes kept for the file of a failure are in it."""
HANG_S = 20.0
"""Longest time for one chunk: some 10 000 times what the slowest takes."""

_TAIL_BYTES = 64_000  # kept for the file of a failure: longer than any frame, and a second of most devices
_LOOKS = 100  # at what is held, over a run
_BYTE_NS = (0, 10_850, 86_800)  # a burst, 921600 baud, 115200 baud
_MS = 1_000_000


@dataclass(frozen=True, slots=True)
class Report:
    """What a run without a failure saw.

    Attributes:
        fed: bytes.
        seconds: that this took.
        stats: what the decoder made of them.
        found: kind -> how many came out.
        peak_held: most that the decoder held [bytes].
        memory: least memory in use in the second tenth of the run, and in the last [bytes].
    """

    fed: int
    seconds: float
    stats: DecodeStats
    found: Counter[str]
    peak_held: int
    memory: tuple[int, int]


def fuzz(
    name: str,
    subject: Subject,
    byte_count: int,
    seed: int,
    folder: Path,
    on_progress: Callable[[int], None] | None = None,
) -> Report:
    """Feed a decoder hostile bytes.

    Args:
        name: key of `SUBJECTS`; with the seed it determines the bytes.
        subject: the decoder.
        byte_count: how many at least.
        seed: of everything random.
        folder: where the last bytes before a failure go.
        on_progress: called now and then with the number of bytes fed.

    Raises:
        FindingError: the decoder failed; names seed, reason and file.
    """
    rng = random.Random(f"{name} {seed}")
    material = SUBJECTS[name][1](rng)
    tail = bytearray()
    fed = looks = peak_held = 0
    found: Counter[str] = Counter()
    early: list[int] = []
    late: list[int] = []
    begin = time.perf_counter()
    try:
        with _traced_memory(), _alarm():
            for chunk, stamp_ns in _chunks(subject, material, rng):
                tail += chunk
                del tail[:-_TAIL_BYTES]
                fed += len(chunk)
                signal.setitimer(signal.ITIMER_REAL, HANG_S)
                found.update(subject.feed(chunk, stamp_ns))
                skipped = subject.stats.skipped_bytes
                require(skipped <= fed, f"{skipped} bytes were skipped of {fed}")
                if fed * _LOOKS < byte_count * looks:
                    continue
                looks += 1
                held = held_bytes(subject.decoder)
                require(held <= HELD_LIMIT, f"holds {held} bytes, must not hold more than {HELD_LIMIT}")
                peak_held = max(peak_held, held)
                if byte_count <= 10 * fed < 2 * byte_count:
                    early.append(_memory_in_use())
                elif 10 * fed >= 9 * byte_count:
                    late.append(_memory_in_use())
                if on_progress is not None:
                    on_progress(fed)
                if fed >= byte_count:
                    break
        memory = min(early), min(late)
        growth = memory[1] - memory[0]
        require(growth <= GROWTH_LIMIT, f"memory grew by {growth} bytes, allowed are {GROWTH_LIMIT}")
    except Exception as error:
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{name.replace(' ', '_')}-seed{seed}-byte{fed}.bin"
        path.write_bytes(tail)
        reason = str(error) if isinstance(error, FindingError) else f"raised {error!r}"
        raise FindingError(
            f"{name}, seed {seed}: after {fed} bytes: {reason}; the last {len(tail)} bytes are in {path}"
        ) from error
    return Report(fed, time.perf_counter() - begin, subject.stats, found, peak_held, memory)


def _chunks(subject: Subject, material: Material, rng: random.Random) -> Iterator[tuple[bytes, int]]:
    """Endless: pieces of hostile streams with their arrival, among them answers to what the host asks."""
    now_ns = 0
    segments = hostile_segments(material, rng)
    segment = next(segments)
    while True:
        longest = rng.choices((3, 50, 400, 4096), (1, 10, 45, 44))[0]
        byte_ns = rng.choice(_BYTE_NS)
        at = 0
        reply = b""
        while at < len(segment) and not reply:
            chunk = segment[at : at + rng.randint(1, longest)]
            at += len(chunk)
            now_ns += byte_ns * len(chunk)
            if rng.random() < 0.003:
                now_ns += rng.randrange(3000) * _MS
            yield chunk, now_ns
            reply = material.replies.get(subject.converse(rng, now_ns), b"")
        segment = reply if reply and rng.random() < 0.8 else next(segments)


def _memory_in_use() -> int:
    gc.collect()  # empties the interpreter's lists of free objects too, which are no leak
    return tracemalloc.get_traced_memory()[0]


@contextmanager
def _traced_memory() -> Iterator[None]:
    gc.freeze()  # what was there before need not be looked through
    tracemalloc.start()
    try:
        yield
    finally:
        tracemalloc.stop()
        gc.unfreeze()


@contextmanager
def _alarm() -> Iterator[None]:
    """Turns the alarm of the interval timer into a finding: the decoder does not come back."""

    def over(signum: int, frame: FrameType | None) -> None:
        raise FindingError(f"took more than {HANG_S} s for one chunk")

    before = signal.signal(signal.SIGALRM, over)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


class Choice(StrEnum):
    """Whose decoders to run."""

    LINKTRACK = "linktrack"
    RPLIDAR = "rplidar"
    ALL = "all"


def main(
    byte_count: Annotated[int, typer.Option("--bytes", min=50_000, help="For each decoder.")] = 10_000_000,
    seed: Annotated[int, typer.Option(help="Of everything random.")] = 1,
    decoder: Annotated[Choice, typer.Option(help="Whose decoders to run.")] = Choice.ALL,
    out: Annotated[Path, typer.Option(help="Where the bytes that led to a failure go.")] = Path("out/fuzz"),
) -> None:
    """Feed hostile bytes to the decoders; exit with 1 if one fails."""
    logging.disable()  # a damaged line is what drivers warn of
    reports: dict[str, Report] = {}
    failures = []
    names = [name for name in SUBJECTS if decoder is Choice.ALL or name.startswith(decoder)]
    with Progress(console=Console(stderr=True), transient=True) as progress:
        for name in names:
            try:
                on_progress = partial(_show, progress, progress.add_task(name, total=byte_count))
                reports[name] = fuzz(name, SUBJECTS[name][0](), byte_count, seed, out, on_progress)
            except FindingError as error:
                failures.append(str(error))
    if reports:
        Console().print(_table(reports, f"seed {seed}"))
    for failure in failures:
        Console(stderr=True).print(failure, soft_wrap=True, markup=False)
    if failures:
        raise typer.Exit(1)


def _show(progress: Progress, task: TaskID, fed: int) -> None:
    progress.update(task, completed=fed)


def _table(reports: dict[str, Report], title: str) -> Table:
    """A column for every decoder."""
    columns = {
        name: {
            "bytes fed": report.fed,
            "bytes/s": round(report.fed / report.seconds),
            **asdict(report.stats),
            **dict(sorted(report.found.items())),
            "most held [bytes]": report.peak_held,
            "memory, second tenth": report.memory[0],
            "memory, last tenth": report.memory[1],
        }
        for name, report in reports.items()
    }
    found = Table("", title=title, title_justify="left")
    for name in columns:
        found.add_column(name, justify="right")
    lines = dict.fromkeys(line for column in columns.values() for line in column)
    for line in lines:
        found.add_row(line, *(f"{column[line]:,}" if line in column else "-" for column in columns.values()))
    return found


if __name__ == "__main__":
    typer.run(main)
