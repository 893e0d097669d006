"""What the commands share: results go to stdout, progress and messages to stderr; options of several."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from inspect import cleandoc
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)

from companion.errors import UserError
from companion.run_folder import log_in

if TYPE_CHECKING:
    from companion.log import Log
    from companion.view.viewer import Shown

LogPath = Annotated[
    Path,
    typer.Argument(
        metavar="LOG|RUN", help="Log (MCAP), or folder of a run, demo or simulation.", callback=log_in
    ),
]
Seed = Annotated[
    int | None, typer.Option("--seed", min=0, metavar="N", help="Instead of the scenario's own seed.")
]
Sets = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change one setting of the site, e.g. --set pipeline.rate=20. Repeatable.",
    ),
]
View = Annotated[
    str,
    typer.Option(
        "--view",
        metavar="WHERE",
        help="Show it in Rerun: web (a page for a browser, see the table view), native (a window on this "
        "computer) or off. `run` and `emulate` show it while it runs.",
    ),
]

INDENT = (0, 0, 0, 2)
"""Padding of lines below a table, folded ones too."""


def result_console() -> Console:
    """Console for what a command was asked for."""
    return Console(highlight=False, emoji=False)


def message_console() -> Console:
    """Console for everything else; its lines are not folded, so that scripts find them whole."""
    return Console(stderr=True, highlight=False, emoji=False, soft_wrap=True)


def progress(console: Console, *, counts: bool = False) -> Progress:
    """Bars with the time left, on a terminal only.

    Args:
        console: of messages.
        counts: say how many are done rather than the percentage.
    """
    return Progress(
        TextColumn("{task.description:>9}"),
        BarColumn(),
        MofNCompleteColumn() if counts else TaskProgressColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )


@contextmanager
def reading(log: "Log") -> Iterator[None]:
    """A bar that shows how much of a log has been read, while something in here reads it."""
    done = Event()
    with progress(message_console()) as shown:
        bar = shown.add_task(log.path.name, total=1.0)

        def follow() -> None:
            while not done.wait(0.1):
                shown.update(bar, completed=log.share_read)

        follower = Thread(target=follow, daemon=True)
        follower.start()
        try:
            yield
        finally:
            done.set()
            follower.join()


def flow_help(app: typer.Typer) -> None:
    """Let paragraphs of commands' help wrap where the terminal ends, not where their source does.

    A line that begins with a dash stays one.
    """
    for command in app.registered_commands:
        paragraphs = cleandoc((command.callback and command.callback.__doc__) or "").split("\n\n")
        command.help = "\n\n".join(re.sub(r"\n(?!- )", " ", paragraph) for paragraph in paragraphs)
    for group in app.registered_groups:
        if group.typer_instance is not None:
            flow_help(group.typer_instance)


def shown_where(view: str) -> "Shown":
    """The value of `--view`.

    Raises:
        UserError: it is none of those there are.
    """
    match view:
        case "web" | "native" | "off":
            return view
    raise UserError(f"--view: {view!r} is none of web, native, off")
