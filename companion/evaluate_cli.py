"""`companion evaluate`: how good the algorithms are, measured."""

import json
import os
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from companion.errors import UserError

app = typer.Typer(help="Measure how good the algorithms are.", no_args_is_help=True, rich_markup_mode="rich")


@app.command()
def functions(
    trials: Annotated[
        int, typer.Option("--trials", min=2, metavar="N", help="Runs of each algorithm on each function.")
    ] = 30,
    seed: Annotated[int, typer.Option("--seed", min=0, metavar="S", help="Of all random numbers.")] = 0,
    figures: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="File for the figures of the tables.")
    ] = None,
    folder: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the pictures.")] = Path(
        "out/functions"
    ),
) -> None:
    """Compare beetle antennae searches with PSO, GA and BA on five test functions in 30 dimensions.

    First as in Tables 1 and 2 of huang2024, whose values stand beside ours: all optima in the
    origin, 200 iterations. Then with optima in random places and the same number of evaluations
    for all. PSO, GA and BA come from public libraries, installed by the extra [bold]bench[/].
    Takes some five minutes.
    """
    from companion.function_benchmark.functions import FUNCTIONS
    from companion.function_benchmark.race import CONTENDERS, Setting, run_race
    from companion.function_benchmark.report import convergence_figure, outcome_table, verdict
    from companion.function_benchmark.rivals import RIVALS, missing

    err = Console(stderr=True, highlight=False, soft_wrap=True)
    out = Console(highlight=False)
    contenders = list(CONTENDERS)
    _make_writable(folder / "convergence_original.png", *([figures] if figures else []))
    if absent := missing():
        err.print(
            f"[yellow]PSO, GA and BA are left out: {' and '.join(absent)} not installed. Install the extra "
            r"bench (pip install -e '.\[bench]') to have them.[/]"
        )
        contenders = [name for name in contenders if name not in RIVALS]
    count = trials * len(Setting) * len(contenders) * len(FUNCTIONS)
    with Progress(
        TextColumn("runs"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=err,
        transient=True,
        disable=not err.is_terminal,
    ) as progress:
        bar = progress.add_task("runs", total=count)
        race = run_race(contenders, trials, seed, os.cpu_count() or 1, lambda: progress.advance(bar))
    for setting in Setting:
        out.print(outcome_table(race, setting))
        picture = folder / f"convergence_{setting}.png"
        convergence_figure(race, setting, picture)
        out.print(f"  picture  {picture}\n", soft_wrap=True)
    out.print(verdict(race), soft_wrap=True)
    if figures is not None:
        figures.write_text(json.dumps(race.to_json(), indent=2) + "\n", encoding="utf-8")


def _make_writable(*paths: Path) -> None:
    """Find out before minutes of work that their result cannot be written."""
    for path in paths:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.open("a").close()
        except OSError as error:
            raise UserError(f"cannot write {path}: {error.strerror}") from error
