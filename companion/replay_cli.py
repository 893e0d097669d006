"""`companion replay`: a log through drivers and estimators once more."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.padding import Padding

from companion.errors import UserError
from companion.run_folder import folder_for
from companion.shipped_files import named_file
from companion.terminal import INDENT, LogPath, Sets, message_console, progress, result_console

if TYPE_CHECKING:
    from companion.config import Config
    from companion.log import Log

out, err = result_console(), message_console()


def replay(
    log: LogPath,
    estimator: Annotated[
        list[str] | None,
        typer.Option(
            "--estimator", metavar="NAME", help="Estimator to run; repeat it to compare. Default: the log's."
        ),
    ] = None,
    folder: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder to write; default out/NAME-replay.")
    ] = None,
    site: Annotated[
        Path | None,
        typer.Option("--site", metavar="FILE", help="Site file instead of the log's own settings."),
    ] = None,
    mavlink: Annotated[
        str | None,
        typer.Option("--mavlink", metavar="URL", help="Send the poses to an autopilot, in real time."),
    ] = None,
    speed: Annotated[
        float,
        typer.Option("--speed", min=0.1, max=10.0, metavar="X", help="With --mavlink: X times as fast."),
    ] = 1.0,
    sets: Sets = None,
) -> None:
    """Run a log through the very same decoders and estimators as live, without sleeping.

    Writes poses.tum, ranges.csv (every range with its verdict), summary.json, config.toml and replay.rrd.
    The same log and settings give the same poses, byte for byte. The settings are those stored in the log;
    change them with --set, or give a corrected site file with --site.
    """
    from companion.config import load_config
    from companion.log import Log
    from companion.replay import config_of, write_outputs
    from companion.replay import replay as run_log
    from companion.tables import accuracy_table, anchor_table, sensor_lines
    from companion.view.files import RerunFiles
    from estimators import ESTIMATORS

    opened = Log(log)
    if mavlink is not None:
        sets = [*(sets or []), f"mavlink.url={mavlink}"]
    config = load_config(named_file(site, "sites"), sets or []) if site else config_of(opened, sets or [])
    names = list(dict.fromkeys(estimator or [config.pipeline.estimator]))
    for name in names:
        if name not in ESTIMATORS:
            raise UserError(f"--estimator: unknown estimator {name!r}, there are: {', '.join(ESTIMATORS)}")
    if mavlink is not None:
        _play(opened, config, names[0], speed)
        return
    folder = folder or folder_for(log, "replay")
    view = RerunFiles(config, names, folder / "replay.rrd", opened.start_ns)
    begin = time.perf_counter()
    with progress(err) as shown:
        bar = shown.add_task(log.name, total=1.0)
        result = run_log(
            opened,
            config,
            names,
            view.tick,
            lambda share: shown.update(bar, completed=share),
            on_chunk=view.chunk,
        )
        view.close()
        shown.update(bar, completed=1.0)
    took = time.perf_counter() - begin
    write_outputs(result, folder)
    if not result.complete:
        err.print(f"[yellow]{log} ends abruptly (killed process or damaged file); replayed what is there[/]")
    title = f"{result.duration:.1f} s in {took:.1f} s ({result.duration / took:.0f} x real time)"
    out.print(accuracy_table(result, title + ("" if result.errors else ", no truth in the log")))
    out.print(anchor_table(result))
    for line in sensor_lines(result):
        out.print(Padding(line, INDENT, expand=False))
    out.print(
        f"  written to {folder}: poses.tum, ranges.csv, summary.json, config.toml, replay.rrd", soft_wrap=True
    )


def _play(log: "Log", config: "Config", primary: str, speed: float) -> None:
    """Send a log's poses to an autopilot and print how well it followed."""
    from companion.replay_out import Player

    player = Player(log, config, primary, speed, lambda line: err.print(line, markup=False))
    player.play()
    out.print(f"{player.poses_sent} poses sent")
    for line in player.score.lines():
        out.print(line, markup=False, soft_wrap=True)
