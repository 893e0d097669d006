"""`companion sitl`: let a simulated vehicle fly on our pose alone."""

import threading
import time
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from companion.interrupt import set_by_signals
from companion.run_folder import RAW_LOG
from companion.shipped_files import named_file
from companion.terminal import message_console, result_console

EXIT_NOT_FOLLOWED = 1


def sitl(
    connect: Annotated[
        str,
        typer.Option("--connect", metavar="URL", help="The simulated autopilot, e.g. tcp:127.0.0.1:5760."),
    ],
    world: Annotated[
        str,
        typer.Option("--world", metavar="SCENARIO", help="Scenario file, or the name of one of ours."),
    ] = "square_room",
    seconds: Annotated[
        float | None, typer.Option("--seconds", min=1, help="End after so long; default: Ctrl-C.")
    ] = None,
    folder: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Run folder; default out/sitl-DATE-TIME.")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", min=0, metavar="N", help="Of the noise.")] = None,
    sets: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change a setting of the site.")
    ] = None,
) -> None:
    """Fly a simulated vehicle on our pose alone.

    ArduPilot's SITL says where its vehicle truly is. From there the world's UWB and LiDAR bytes are rendered,
    run through drivers and estimator, and the pose goes back to SITL's filter. Set that up once with
    [bold]companion params apply uwb_lidar --mavlink URL[/] and a restart. At the end it prints how well the
    autopilot followed.

    Exit codes: 0 it followed, 1 it had no position of its own, 2 the call is wrong or there is no SITL.
    """
    import numpy as np

    from companion.sim.scenario import load_scenario
    from companion.sitl import SitlRun

    out, err = result_console(), message_console()
    path = named_file(Path(world), "scenarios")
    folder = folder or Path("out") / datetime.now().astimezone().strftime("sitl-%Y%m%d-%H%M%S")
    begin = time.monotonic()

    def say(line: str) -> None:
        err.print(f"[dim]{time.monotonic() - begin:8.1f}[/]  {escape(line)}")

    say(f"waiting for the autopilot on {connect}")
    with set_by_signals() as stop:
        run = SitlRun(load_scenario(path, seed, sets or []), connect, folder, say)
        if seconds is not None:
            timer = threading.Timer(seconds, stop.set)
            timer.daemon = True
            timer.start()
        run.run(stop)
    errors = run.our_errors()
    if len(errors):
        rmse = float(np.sqrt(np.mean(np.square(errors))))
        out.print(f"companion: {len(errors)} poses, RMSE {rmse:.3f} m, max {errors.max():.3f} m")
    for line in run.score.lines():
        out.print(line, markup=False, soft_wrap=True)
    out.print(f"log: {folder / RAW_LOG}", soft_wrap=True)
    if not run.score.errors:
        raise typer.Exit(EXIT_NOT_FOLLOWED)
