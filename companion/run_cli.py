"""`companion run`: what a robot runs."""

import threading
import time
from datetime import datetime
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from companion.interrupt import set_by_signals
from companion.run_folder import RAW_LOG
from companion.shipped_files import named_file
from companion.terminal import Sets, View, message_console, shown_where

if TYPE_CHECKING:
    from companion.live import LiveRun, LiveStatus

err = message_console()


def run(
    site: Annotated[Path, typer.Option("--site", metavar="FILE", help="Site file: anchors, sensors, start.")],
    folder: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Run folder; default out/run-DATE-TIME.")
    ] = None,
    mavlink: Annotated[
        str | None,
        typer.Option(
            "--mavlink",
            metavar="URL",
            help="Device string of the autopilot, /dev/ttyAMA0,921600 or udpout:host:14550 or tcp:host:5760.",
        ),
    ] = None,
    view: View = "off",
    sets: Sets = None,
) -> None:
    """Estimate live: sensors in, poses to the autopilot, everything logged. Ctrl-C ends it.

    Missing ports and a missing autopilot are waited for, and taken up again after an unplug. A pose is only
    sent while its health is ok or degraded.
    """
    from companion.config import load_config
    from companion.live import LiveRun
    from companion.mavlink.parameters import saved_settings

    assignments = [*(sets or []), *([f"mavlink.url={mavlink}"] if mavlink is not None else [])]
    config = load_config(named_file(site, "sites"), assignments)
    if config.mavlink.parameter_file:
        saved = saved_settings(Path(config.mavlink.parameter_file))
        config = load_config(named_file(site, "sites"), [*saved, *assignments])
    folder = folder or Path("out") / datetime.now().astimezone().strftime("run-%Y%m%d-%H%M%S")
    begin = time.monotonic()

    def say(line: str) -> None:
        err.print(f"[dim]{time.monotonic() - begin:8.1f}[/]  {escape(line)}")

    with set_by_signals() as stop:
        live = LiveRun(config, folder, say, view=shown_where(view))
        say(f"{config.site.name}: estimator {config.pipeline.estimator}, log {folder / RAW_LOG}")
        reporter = threading.Thread(target=_report, args=(live, stop), daemon=True)
        reporter.start()
        live.run(stop)
        reporter.join()
    say(f"ended: {live.status.poses_sent} poses sent; replay with: companion replay {folder}")


def _report(live: "LiveRun", stop: threading.Event) -> None:
    """Show the state of a run until it stops: a status line on a terminal, else a line every 5 s."""
    if err.is_terminal:
        with err.status("starting") as status:
            while not stop.wait(0.2):
                status.update(_status_line(live.status))
    else:
        while not stop.wait(5.0):
            err.print(_status_line(live.status))


def _status_line(status: "LiveStatus") -> str:
    pose, health = status.pose, status.health
    if pose is None or health is None:
        return "starting: no pose yet"
    x, y = pose.xy
    sigma = float(max(pose.cov[0, 0], pose.cov[1, 1]) ** 0.5)
    parts = [
        f"[bold]{health.state}[/]",
        f"x {x:6.2f}  y {y:6.2f} m  yaw {degrees(pose.yaw):6.1f} deg",
        f"sigma {sigma:.2f} m",
        f"sent {status.poses_sent}",
        f"autopilot {status.autopilot}" if status.autopilot is not None else "no autopilot heard",
    ]
    parts += [f"{name} dropped {count}" for name, count in status.dropped.items() if count]
    if status.stale_ticks:
        parts.append(f"late {status.stale_ticks}")
    if health.reason:
        parts.append(health.reason)
    return "  ".join(parts)
