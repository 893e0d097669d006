"""`companion evaluate`: how good the algorithms are, measured."""

import atexit
import json
import os
from functools import partial
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Annotated

import typer

from companion.alignment import Alignment
from companion.errors import UserError
from companion.run_folder import log_in, log_name
from companion.shipped_files import named_file
from companion.terminal import Seed, Sets, message_console, progress, result_console

if TYPE_CHECKING:
    from rich.console import Console

    from companion.evaluation import Evaluation

_TABLE_WIDTH = 160
"""Of what goes to a file, where there is no terminal to fit into."""

app = typer.Typer(help="Measure how good the algorithms are.", no_args_is_help=True, rich_markup_mode="rich")


@app.command("scenario")
def scenario(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCE...",
            help="Scenario file, name of one in params/scenarios, log (MCAP) with truth, data set's folder.",
        ),
    ],
    trials: Annotated[
        int, typer.Option("--trials", min=1, metavar="N", help="Number of runs of each scenario.")
    ] = 30,
    seed: Seed = None,
    estimators: Annotated[
        str | None,
        typer.Option(
            "--estimators",
            metavar="A,B",
            help="Estimators, NAME or NAME:PARAM; uwb_ls and lidar are the single sensors. "
            "Default: uwb_ls,lidar,ekf.",
        ),
    ] = None,
    align: Annotated[
        Alignment, typer.Option("--align", help="How tracks are moved onto the truth for the ATE.")
    ] = Alignment.NONE,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the figures there, too.")
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="DIR", help="Write report.md, pictures, and the worst trial as a log there."
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, metavar="N", help="Processes; default: one a core.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler",
            metavar="URL",
            help="Dask scheduler (tcp://host:8786) whose workers, with this program and the same files, run "
            "the trials. Needs the extra cluster.",
        ),
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            "--fault",
            metavar="KIND:KEY=VALUE,...",
            help="Put a fault into every trial (see companion edit --help); repeat it for several at once. "
            "library: every sort of fault, each in trials of its own, against the same trials without; the "
            "result is one table.",
        ),
    ] = None,
    sets: Sets = None,
) -> None:
    """Measure estimators on many trials of scenarios, or on logs: errors, consistency, time, integrity.

    The word "scenario" may be left out: [bold]companion evaluate huang2024[/]. Trial k has the seed S + k
    for everything random: obstacles, start, gait and noise. The same seed gives the same figures, times
    excepted. Where the scenario holds figures of a paper, they stand below ours. Ctrl-C ends it and keeps
    the trials that are done (exit code 1).
    """
    from companion.evaluation import DEFAULT_CHOICES, evaluate_scenario
    from companion.fault_table import fault_table
    from companion.log_trial import LOG_SUFFIX

    out, err = result_console(), message_console()
    if not out.is_terminal:
        out.width = max(out.width, _TABLE_WIDTH)
    choices = DEFAULT_CHOICES if estimators is None else estimators.split(",")
    if folder is not None:
        _make_writable(folder / "report.md")
    if json_file is not None and not json_file.parent.is_dir():
        raise UserError(f"cannot write {json_file}: there is no folder {json_file.parent}")
    paths = [_imported(named_file(Path(source), "scenarios"), sets or []) for source in sources]
    results: list[Evaluation] = []
    is_library = fault == ["library"]
    by_fault: dict[str, dict[str, Evaluation]] = {}
    for path, faults in _runs(paths, fault or [], sets or []):
        with progress(err, counts=True) as shown:
            count = 1 if path.suffix == LOG_SUFFIX and not faults else trials
            bar = shown.add_task(" ".join([log_name(path), *faults]), total=count)
            results.append(
                evaluate_scenario(
                    path,
                    trials,
                    seed,
                    choices,
                    sets or [],
                    workers or os.cpu_count() or 1,
                    partial(shown.advance, bar),
                    align,
                    scheduler,
                    faults,
                )
            )
        result = results[-1]
        if is_library:
            by_fault.setdefault(log_name(path), {})[" ".join(faults)] = result
        else:
            _print(result, out)
        if folder is not None:
            lines = _write_report(results, by_fault, path, folder, sets or [], faults)
            if not is_library:
                out.print("\n".join(f"  {line}" for line in lines), soft_wrap=True)
        if result.interrupted:
            err.print(f"[yellow]interrupted: {path} has {result.trials} of {count} trials[/]")
            break
    for name, found in by_fault.items():
        out.print(fault_table(name, found))
    if is_library and folder is not None:
        out.print(f"  report, pictures and worst trials: {folder}", soft_wrap=True)
    if json_file is not None:
        figures = [result.to_json() for result in results]
        try:
            text = json.dumps(figures[0] if len(figures) == 1 else figures, indent=2)
            json_file.write_text(text + "\n", encoding="utf-8")
        except OSError as error:
            raise UserError(f"cannot write {json_file}: {error.strerror}") from error
    if results[-1].interrupted:
        raise typer.Exit(1)


def _print(result: "Evaluation", out: "Console") -> None:
    """Tables and notes of one evaluation."""
    from companion.evaluation_table import evaluation_notes, evaluation_table, leg_table, trust_table

    out.print(evaluation_table(result))
    out.print(trust_table(result))
    if (legs := leg_table(result)) is not None:
        out.print(legs)
    for line in evaluation_notes(result):
        out.print(f"  {line}", soft_wrap=True)


def _imported(path: Path, sets: list[str]) -> Path:
    """The source itself, the log of a run's folder, or for that of a data set the log that is made of it."""
    if not path.is_dir():
        return path
    if log_in(path).exists():
        return log_in(path)
    from companion.importers.sources import import_log

    folder = mkdtemp(prefix="companion-")
    atexit.register(rmtree, folder)
    log = Path(folder) / f"{path.name}.mcap"
    import_log(path, log, sets=sets)
    return log


def _runs(paths: list[Path], faults: list[str], sets: list[str]) -> list[tuple[Path, list[str]]]:
    """What is to be evaluated: source and faults of each evaluation."""
    from companion.log_edit.faults import library
    from companion.log_trial import LOG_SUFFIX, log_config
    from companion.sim.scenario import load_scenario

    if faults != ["library"]:
        return [(path, faults) for path in paths]
    runs = []
    for path in paths:
        is_log = path.suffix == LOG_SUFFIX
        config = log_config(path, sets) if is_log else load_scenario(path, None, sets).config
        runs += [(path, []), *((path, [text]) for text in library(config))]
    return runs


def _write_report(
    results: "list[Evaluation]",
    by_fault: "dict[str, dict[str, Evaluation]]",
    path: Path,
    folder: Path,
    sets: list[str],
    faults: list[str],
) -> list[str]:
    """Picture, worst trial and Markdown of the newest result, after those before; says what is there."""
    from companion.evaluation_plots import evaluation_figure
    from companion.evaluation_table import markdown
    from companion.fault_table import fault_markdown
    from companion.worst_trial import write_worst_trial

    newest = results[-1]
    picture = folder / f"{newest.file_stem}.png"
    evaluation_figure(newest, picture)
    text = "".join(fault_markdown(name, found) for name, found in by_fault.items())
    text += "\n".join(markdown(result, [f"{result.file_stem}.png"]) for result in results)
    (folder / "report.md").write_text(text, encoding="utf-8")
    lines = [f"report   {folder / 'report.md'}", f"picture  {picture}"]
    log = write_worst_trial(newest, path, folder, sets, faults)
    if log is not None:
        lines.append(f"worst trial of {newest.decisive}, seed {newest.worst_seed()}: {log}")
        lines.append(f"look at it: companion review {log}")
    return lines


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

    out, err = result_console(), message_console()
    contenders = list(CONTENDERS)
    _make_writable(folder / "convergence_original.png", *([figures] if figures else []))
    if absent := missing():
        err.print(
            f"[yellow]PSO, GA and BA are left out: {' and '.join(absent)} not installed. Install the extra "
            r"bench (pip install -e '.\[bench]') to have them.[/]"
        )
        contenders = [name for name in contenders if name not in RIVALS]
    count = trials * len(Setting) * len(contenders) * len(FUNCTIONS)
    with progress(err, counts=True) as shown:
        bar = shown.add_task("runs", total=count)
        race = run_race(contenders, trials, seed, os.cpu_count() or 1, lambda: shown.advance(bar))
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
