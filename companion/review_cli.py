"""`companion review`: a log replayed into Rerun, with a list of what happened and when."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from companion.errors import UserError
from companion.run_folder import log_in
from companion.terminal import message_console, progress, result_console

if TYPE_CHECKING:
    import rerun as rr

    from companion.config import Config
    from companion.review import Review
    from companion.view.viewer import Viewer

LOGS = 2
"""So many can be compared at once."""
EVENTS = 40
"""More than so many events of a log are not printed."""


def review(
    logs: Annotated[
        list[Path],
        typer.Argument(
            metavar="LOG|RUN...", help="Log (MCAP) or run folder; two to compare before and after."
        ),
    ],
    estimator: Annotated[
        str | None,
        typer.Option(
            "--estimator", metavar="A,B", help="Estimators to run side by side. Default: the log's own."
        ),
    ] = None,
    begin: Annotated[
        float, typer.Option("--from", metavar="S", min=0.0, help="Show from this second on.")
    ] = 0.0,
    end: Annotated[
        float | None, typer.Option("--to", metavar="S", help="Show to this second; the rest is not read.")
    ] = None,
    save: Annotated[
        Path | None, typer.Option("--save", metavar="FILE", help="Write an .rrd file instead of opening it.")
    ] = None,
    web: Annotated[
        bool, typer.Option("--web", help="Serve it as a page for a browser, until Ctrl-C.")
    ] = False,
    site: Annotated[
        Path | None,
        typer.Option("--site", metavar="FILE", help="Site file instead of the logs' own settings."),
    ] = None,
    sets: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change one setting of the site. Repeatable."),
    ] = None,
) -> None:
    """Replay a log, open it in Rerun, and print what happened: blocked anchors, blackouts, resets, causes.

    The viewer opens at once and fills while the log is replayed. Estimators always run from the log's start;
    --from and --to choose what is shown. Two logs are shown side by side under one time cursor.
    """
    from companion.config import load_config
    from companion.log import Log
    from companion.replay import config_of
    from estimators import ESTIMATORS

    out, err = result_console(), message_console()
    if len(logs) > LOGS:
        raise UserError(f"{len(logs)} logs given, at most {LOGS} can be compared")
    if save is not None and web:
        raise UserError("--save and --web: a file is not served; open it with: rerun FILE")
    if end is not None and end <= begin:
        raise UserError(f"--to {end:g}: must be above --from {begin:g}")
    names = None if estimator is None else list(dict.fromkeys(estimator.split(",")))
    for name in names or []:
        if name not in ESTIMATORS:
            raise UserError(f"--estimator: unknown estimator {name!r}, there are: {', '.join(ESTIMATORS)}")
    opened: list[tuple[Log, Config]] = []
    for path in logs:
        log = Log(log_in(path))
        opened.append((log, load_config(site, sets or []) if site else config_of(log, sets or [])))

    from companion.review import Span
    from companion.review import review as review_logs

    stream, viewer = _stream(opened[0][1], save, web, err)
    begun = time.perf_counter()
    with progress(err) as shown:
        bar = shown.add_task("review", total=1.0)
        reviews = review_logs(
            opened, names, Span(begin, end), stream, lambda share: shown.update(bar, completed=share)
        )
        try:
            stream.flush()
        except RuntimeError as error:
            where = f"cannot write {save}" if save is not None else "the viewer was closed"
            raise UserError(f"{where}: {error}") from error
    took = time.perf_counter() - begun
    for found in reviews:
        _print(found, took, out)
    if save is not None:
        stream.disconnect()
        out.print(f"  written to {save}; open it with: rerun {save}", soft_wrap=True)
    elif viewer is not None and viewer.is_page:
        err.print("served until Ctrl-C")
        viewer.serve_until_interrupted()


def _stream(
    config: "Config", save: Path | None, web: bool, err: Console
) -> "tuple[rr.RecordingStream, Viewer | None]":
    from uuid import uuid4

    import rerun as rr

    from companion.view.files import APPLICATION
    from companion.view.files import save as save_to
    from companion.view.viewer import Viewer, free_port, has_screen

    if save is None and not web and not has_screen():
        raise UserError("this computer has no screen (DISPLAY is not set); use --web or --save FILE")
    stream = rr.RecordingStream(APPLICATION, recording_id=uuid4())
    stream_name = config.site.name
    if save is not None:
        save_to(stream, save)
        viewer = None
    else:
        # A window needs no known port, and there may be one of an earlier review.
        table = config.view if web else config.view.model_copy(update={"data_port": free_port()})
        viewer = Viewer("web" if web else "native", table)
        viewer.wait_until_ready()
        stream.connect_grpc(viewer.url)
        if viewer.is_page:
            err.print(f"open {viewer.page}", soft_wrap=True)
    stream.send_recording_name(f"{stream_name}, review")
    return stream, viewer


def _print(found: "Review", took: float, out: Console) -> None:
    from companion.tables import accuracy_table

    result = found.result
    title = f"{found.log.path}: {result.duration:.1f} s replayed and drawn in {took:.1f} s"
    out.print(accuracy_table(result, title))
    if not found.log.complete:
        out.print("  the log ends abruptly (killed process or damaged file)")
    events = Table(title="events", title_justify="left", box=None, show_header=False, pad_edge=True)
    events.add_column(justify="right", no_wrap=True)
    events.add_column(no_wrap=True)
    events.add_column(overflow="fold")
    for event in found.events[:EVENTS]:
        seconds = (event.stamp_ns - found.log.start_ns) * 1e-9
        events.add_row(f"{seconds:.2f} s", f"[bold]{escape(event.title)}[/]", escape(event.text))
    out.print(events if found.events else "  no events: nothing lost, blocked, reset or contradicted")
    if len(found.events) > EVENTS:
        out.print(f"  and {len(found.events) - EVENTS} more, in the log of the view")
