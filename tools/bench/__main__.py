"""Benchmarks: `python tools/bench` prints a table; see `--help`.

Peers come with `pip install -e .[test,bench]`. Ratios are what to look at: a figure alone says as much about
the machine as about the code. To set a new baseline, run the rows that it names with
`--json tools/bench/baseline.json` on an idle machine.
"""

import datetime
import json
import platform
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress

from tools.bench import chain, decoders, growth, matching, particles, processes, smoother
from tools.bench.decoders import DisagreementError
from tools.bench.rows import ROUNDS, TOLERANCE, Row, measure, shortfalls, table

BENCHMARKS = {
    **decoders.BENCHMARKS,
    **particles.BENCHMARKS,
    **matching.BENCHMARKS,
    **smoother.BENCHMARKS,
    **chain.BENCHMARKS,
}
"""Rows that `measure` makes."""
WHOLE_ROWS = {**particles.ROWS, **processes.ROWS}
"""Rows that come as they are."""
BASELINE = Path(__file__).with_name("baseline.json")


def main(
    only: Annotated[str, typer.Option(metavar="NAME,...", help="These rows alone.")] = "",
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the rows here too.")
    ] = None,
    curves: Annotated[bool, typer.Option("--growth", help="Instead of rows, how costs grow.")] = False,
    check: Annotated[
        bool, typer.Option("--check", help="Exit with 1 if a ratio falls short of the baseline.")
    ] = False,
) -> None:
    """Measure the hot paths beside what others make of the same bytes."""
    if curves:
        title = f"Python {platform.python_version()}, {datetime.date.today()}; CPU time"
        Console().print(growth.curves_table([curve() for curve in growth.CURVES], title))
        return
    known = [*BENCHMARKS, *WHOLE_ROWS]
    names = only.split(",") if only else known
    for name in names:
        if name not in known:
            raise typer.BadParameter(f"{name!r} is no row, there are: {', '.join(known)}")
    try:
        rows = _measured(names)
    except DisagreementError as error:
        Console(stderr=True).print(str(error), soft_wrap=True)
        raise typer.Exit(1) from error
    versions = f"Python {platform.python_version()}, NumPy {np.__version__}"
    title = f"{versions}, {datetime.date.today()}; CPU time, median of {ROUNDS} rounds"
    Console().print(table(rows, title))
    if json_file is not None:
        text = json.dumps([asdict(row) for row in rows], indent=2) + "\n"
        try:
            json_file.write_text(text, encoding="utf-8")
        except OSError as error:
            raise typer.BadParameter(f"cannot write {json_file}: {error.strerror}") from error
    if check:
        _check(rows)


def _measured(names: list[str]) -> list[Row]:
    rows = []
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=len(names))
        for name in names:
            progress.update(task, description=name)
            whole = WHOLE_ROWS.get(name)
            rows.append(whole() if whole else measure(name, BENCHMARKS[name]()))
            progress.advance(task)
    return rows


def _check(rows: list[Row]) -> None:
    baseline = json.loads(BASELINE.read_text(encoding="utf-8"))
    lines = shortfalls(rows, baseline)
    for line in lines:
        Console(stderr=True).print(line, soft_wrap=True)
    if lines:
        raise typer.Exit(1)
    compared = {row.name for row in rows} & {entry["name"] for entry in baseline}
    Console(stderr=True).print(f"{len(compared)} ratios are within {TOLERANCE:.0%} of the baseline or above")


if __name__ == "__main__":
    typer.run(main)
