"""`companion params`: does the autopilot's setup fit ours, and what is to be changed."""

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table
from rich.text import Text

from companion.terminal import message_console, result_console

if TYPE_CHECKING:
    from companion.autopilot_client import AutopilotClient, Comparison

EXIT_DIFFERENT = 1

app = typer.Typer(
    help="Compare the autopilot's parameters with a file, and set them.",
    no_args_is_help=True,
    rich_markup_mode="rich",
)
out, err = result_console(), message_console()

File = Annotated[
    str,
    typer.Argument(
        metavar="FILE",
        help="A .parm or .params file, or one of ours by name: uwb_lidar, uwb_position, rover, gps_and_uwb.",
    ),
]
Url = Annotated[
    str,
    typer.Option("--mavlink", metavar="URL", help="Device string of the autopilot, e.g. tcp:127.0.0.1:5760."),
]
Baud = Annotated[int, typer.Option("--baud", min=1200, max=4_000_000, help="Of a serial line.")]


@app.command()
def check(file: File, url: Url, baud: Baud = 921_600) -> None:
    """Read the autopilot's parameters and explain each that differs.

    Names that changed between ArduPilot 4.5 and 4.7 are found under either name.

    Exit codes: 0 all agree, 1 some differ, 2 the call is wrong or there is no autopilot.
    """
    with _comparisons(file, url, baud) as (_, comparisons):
        _show(comparisons)
    if not all(comparison.agrees for comparison in comparisons):
        raise typer.Exit(EXIT_DIFFERENT)


@app.command()
def apply(
    file: File,
    url: Url,
    baud: Baud = 921_600,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
    undo: Annotated[
        Path | None,
        typer.Option(
            "--undo", metavar="FILE", help="Where the old values go. Default: params-before-DATE-TIME.parm."
        ),
    ] = None,
) -> None:
    """Write what differs to the autopilot, after asking. The old values go into a file that undoes it.

    Exit codes: 0 all agree now, 1 something was refused or you said no, 2 the call is wrong.
    """
    from companion.mavlink.parameter_files import Setting, write_settings

    with _comparisons(file, url, baud) as (client, comparisons):
        _show(comparisons)
        changes = [c for c in comparisons if c.name and not c.agrees]
        if not changes:
            raise typer.Exit(0 if all(c.agrees for c in comparisons) else EXIT_DIFFERENT)
        if not yes and not typer.confirm(f"Write {len(changes)} parameters?", err=True):
            raise typer.Exit(EXIT_DIFFERENT)
        stamp = datetime.now().astimezone().strftime("%Y%m%d-%H%M%S")
        path = undo or Path(f"params-before-{stamp}.parm")
        # First the way back.
        write_settings(path, [Setting(c.name, c.has) for c in changes], f"before {file} was applied")
        refused = [c.name for c in changes if not client.write(c.name, c.wanted, c.kind)]
    out.print(
        f"{len(changes) - len(refused)} written; back with: companion params apply {path} --mavlink {url}"
    )
    if refused:
        out.print(f"refused by the autopilot: {', '.join(refused)}")
    out.print("Restart the autopilot: some parameters count from then on.")
    if refused or not all(c.name for c in comparisons):
        raise typer.Exit(EXIT_DIFFERENT)


@contextmanager
def _comparisons(file: str, url: str, baud: int) -> Iterator[tuple["AutopilotClient", list["Comparison"]]]:
    from companion.autopilot_client import AutopilotClient, compare_parameters
    from companion.mavlink.parameter_files import read_settings, settings_file

    if Path(file).is_file():
        read_settings(Path(file))  # what is wrong with it is said before anyone is waited for
    err.print(f"[dim]waiting for the autopilot on {url}[/]")
    client = AutopilotClient(url, baud)
    try:
        settings = read_settings(settings_file(file, client.autopilot))
        rows = [(setting.name, setting.value, setting.why) for setting in settings]
        yield client, compare_parameters(client, rows)
    finally:
        client.close()


def _show(comparisons: list["Comparison"]) -> None:
    different = [c for c in comparisons if not c.agrees]
    if different:
        table = Table()
        for heading in ("parameter", "has", "wanted", "why"):
            table.add_column(heading, overflow="fold")
        for c in different:
            name = c.name if c.name in ("", c.asked) else f"{c.name} ({c.asked})"
            if c.name:
                table.add_row(name, f"{c.has:.6g}", f"{c.wanted:.6g}", Text(c.why))
            else:
                table.add_row(c.asked, "none", f"{c.wanted:.6g}", Text(f"not on this autopilot. {c.why}"))
        out.print(table)
    if any(not c.name for c in different):
        out.print("what is not there may appear after a restart, once the setting that enables it is made")
    out.print(f"{len(comparisons) - len(different)} of {len(comparisons)} parameters agree")
