"""Commands that make something of a log, or a log of something."""

from pathlib import Path
from typing import Annotated

import typer

from companion.errors import UserError
from companion.shipped_files import named_file
from companion.terminal import LogPath, Seed, Sets, message_console, progress, reading, result_console


def make_map(
    log: LogPath,
    out_file: Annotated[
        Path, typer.Option("--out", metavar="FILE", help="Map (YAML) to write, with a PNG beside it.")
    ] = Path("map.yaml"),
    estimator: Annotated[
        str | None,
        typer.Option("--estimator", metavar="NAME", help="Whose poses are used. Default: the log's."),
    ] = None,
    sets: Sets = None,
) -> None:
    """Make a floor plan of what the LiDAR saw in a log, as a picture and a YAML file.

    The files follow the convention of the ROS map_server, which other tools read, too.
    """
    from companion.log import Log
    from companion.map_file import save_map
    from companion.mapping import survey
    from companion.replay import config_of
    from estimators import ESTIMATORS

    if out_file.suffix not in (".yaml", ".yml"):
        raise UserError(f"--out {out_file}: the name must end in .yaml")
    opened = Log(log)
    config = config_of(opened, sets or [])
    name = estimator or config.pipeline.estimator
    if name not in ESTIMATORS:
        raise UserError(f"--estimator: unknown estimator {name!r}, there are: {', '.join(ESTIMATORS)}")
    with progress(message_console()) as shown:
        bar = shown.add_task(log.name, total=1.0)
        made = survey(opened, config, name, lambda share: shown.update(bar, completed=share))
        shown.update(bar, completed=1.0)
    save_map(made.floor, out_file)
    rows, columns = made.floor.occupied.shape
    cell = made.floor.cell
    result_console().print(
        f"{out_file}  {columns * cell:.1f} m x {rows * cell:.1f} m in cells of {cell:g} m, "
        f"{made.inserted} of {made.scans} scans",
        soft_wrap=True,
    )


def edit(
    log: LogPath,
    fault: Annotated[
        list[str],
        typer.Option("--fault", metavar="KIND:KEY=VALUE,...", help="What goes wrong. Repeatable."),
    ],
    path: Annotated[Path, typer.Option("--out", metavar="LOG", help="Log (MCAP) to write.")],
    seed: Seed = None,
) -> None:
    """Write a log as it would be had something gone wrong: what if anchor 3 dies at 20 s?

    [bold]companion edit raw.mcap --fault drop:anchor=3,at=20 --out what_if.mcap[/], then replay what_if.mcap.

    Every fault has at= and for= (seconds), lengths are in metres, and:
    - silent: sensor
    - late: sensor, by (seconds)
    - drop: anchor
    - spike: anchor, size, share
    - nlos: anchor, least, mean
    - moved: anchor, x, y, z; needs truth
    - clock: by (seconds), the tag's clock jumps
    - rotated: yaw_deg, the tag in its mount
    - blocked: from_deg, to_deg, distance, a sector of the LiDAR
    - gone: share of LiDAR beams without return
    """
    from companion.log import Log
    from companion.log_edit.edit import edit_log
    from companion.log_edit.faults import parse_fault
    from companion.replay import config_of

    opened = Log(log)
    config = config_of(opened, [])
    faults = [parse_fault(text, config) for text in fault]
    with reading(opened):
        edit_log(opened, config, faults, seed or 0, path)
    result_console().print(f"{path}  replay it with: companion replay {path}", soft_wrap=True)


def import_recording(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE",
            help="Folder of a public data set (lias_planar, labyrinth_uwb, robotino_uwb) or of text files as "
            "export writes them, CARMEN log, ROS 1 or 2 bag.",
        ),
    ],
    path: Annotated[Path, typer.Option("--out", metavar="LOG", help="Log (MCAP) to write.")],
    site: Annotated[
        Path | None,
        typer.Option("--site", metavar="FILE", help="Site file; we have one for each of the data sets."),
    ] = None,
    truth: Annotated[
        str | None,
        typer.Option("--truth", metavar="TOPIC", help="Odometry or PoseStamped of a bag to compare with."),
    ] = None,
    sets: Sets = None,
) -> None:
    """Make a log of somebody else's recording, in the bytes that our sensors would have sent.

    Ranges become LinkTrack frames, scans RPLIDAR packets: replay and evaluate take the one path that a
    robot takes.
    """
    from companion.importers.sources import import_log

    count = import_log(source, path, site and named_file(site, "sites"), sets, truth)
    result_console().print(f"{path}  {count} measurements", soft_wrap=True)


def export(
    log: LogPath,
    folder: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write.")],
) -> None:
    """Write what a log holds as text: ranges.csv, scans.csv, imu.csv, truth.tum."""
    from companion.importers.text_folder import write_folder
    from companion.log import Log
    from companion.replay import config_of

    opened = Log(log)
    with reading(opened):
        written = write_folder(opened, config_of(opened, []), folder)
    for path in written:
        result_console().print(str(path), soft_wrap=True)
