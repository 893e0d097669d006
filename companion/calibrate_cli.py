"""`companion calibrate`: what a drive tells of the sensors, written into the site file."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.table import Table

from companion.errors import UserError
from companion.shipped_files import named_file
from companion.terminal import LogPath, message_console, reading, result_console

if TYPE_CHECKING:
    from companion.calibration.bearings import BearingFit
    from companion.calibration.ranges import Calibration
    from companion.config import Config

MAX_SPREAD, MIN_USED_SHARE = 0.2, 0.8
"""An anchor whose used errors scatter more than this [m], or with a smaller share used, was hidden."""

app = typer.Typer(
    help="Find out from a drive what the sensors do wrong.", no_args_is_help=True, rich_markup_mode="rich"
)

Site = Annotated[Path, typer.Option("--site", metavar="FILE", help="Site file of the drive.")]
Until = Annotated[
    float | None,
    typer.Option("--until", min=1.0, metavar="S", help="Use the first seconds of the log alone."),
]
Json = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the figures there, too.")]


@app.command()
def ranges(
    log: LogPath,
    site: Site,
    against: Annotated[
        str,
        typer.Option(
            "--against",
            metavar="WHAT",
            help="What tells the true distances: lidar (the log's scans, poses and biases found together), "
            "truth (poses stored in the log) or a CSV file of surveyed points.",
        ),
    ] = "lidar",
    until: Until = None,
    to: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="Site file to write instead of changing the given one."),
    ] = None,
    picture: Annotated[Path, typer.Option("--picture", metavar="FILE", help="PNG of the errors.")] = Path(
        "out/range_calibration.png"
    ),
    figures: Json = None,
) -> None:
    """Find the bias of every anchor's ranges and write it into the site file, table [bold]range_bias[/].

    All later runs and replays with that file take the bias off. A point file has the columns begin, end (of
    the stay, in seconds since the log began), x, y, z (of the tag's antenna, in metres). The site file
    keeps its comments and its order.

    Of several tags on the robot (body.tags) truth calibrates all, points and lidar the one at body.tag; what
    the others differ from it by stays. Truth with a heading also tells what a tag's ranges add by the bearing
    of the anchor in the body frame: it is kept where it is beyond noise.
    """
    import numpy as np

    from companion.calibration.bearings import BearingFit, fit_bearings, without_bearings
    from companion.calibration.picture import residual_figure
    from companion.calibration.ranges import fit_biases, ranges_by_anchor
    from companion.calibration.recording import read_recording
    from companion.calibration.reference import poses_from_truth, tags_from_points, tags_from_truth
    from companion.calibration.site_file import write_range_bias
    from companion.calibration.tags import TagBias, carried_over, fit_tags, without_tag_bias
    from companion.config import load_config
    from companion.log import Log

    config = load_config(site)
    opened = Log(log)
    with reading(opened):
        recording = read_recording(
            opened, config, until, with_odometry=against == "lidar", every_tag=against == "truth"
        )
    frames = recording.range_frames
    seen = {frame.tag_id for frame in frames}
    of_tags: dict[int, TagBias] = {}
    bearings: dict[int, BearingFit] = {}
    if against == "lidar":
        from companion.calibration.drive import calibrate_on_drive

        found = calibrate_on_drive(recording, config)
    else:
        anchors = {i: np.array(position) for i, position in config.anchors.items()}
        if against == "truth":
            poses = poses_from_truth(recording)
            tags = tags_from_truth(recording, poses, config)
            bearings = fit_bearings(frames, poses, tags, anchors, recording.start_ns)
            frames = without_bearings(frames, poses, bearings, config.setup())
        else:
            tags = tags_from_points(Path(against), recording)
        of_tags = fit_tags(frames, tags, anchors, recording.start_ns)
        frames = [without_tag_bias(frame, of_tags) for frame in frames]
        by_anchor = ranges_by_anchor(frames, tags, anchors, recording.start_ns)
        if not by_anchor:
            raise UserError(f"{log}: no anchor has enough ranges where the position is known")
        found = fit_biases(by_anchor)
    # What an earlier drive said of a tag is replaced, though this one says nothing of it.
    known = {i: TagBias(row.constant, row.constant_sigma) for i, row in config.range_bias.tags.items()}
    replaced = seen & known.keys() | bearings.keys()
    of_tags = {i: TagBias(0.0, 0.0) for i in sorted(replaced)} | of_tags | carried_over(known, seen)
    out = result_console()
    out.print(_range_table(found, config))
    err, badly_seen = message_console(), _badly_seen(found)
    for anchor_id in badly_seen:
        err.print(
            f"[yellow]anchor {anchor_id}: its errors scatter too much for noise, something stood before it; "
            "calibrate in line of sight[/]"
        )
    residual_figure(found, picture, f"{config.site.name}: ranges of {log.name}")
    if badly_seen and against == "lidar":
        # Poses and biases were found together: one wrong anchor shifts the way, and with it all biases.
        err.print(f"  picture {picture}")
        err.print("[red]nothing written: without known positions one hidden anchor spoils the bias of all[/]")
        raise typer.Exit(1)
    told = {i: bearings.get(i) for i in seen} if against == "truth" else {}
    write_range_bias(site, found, of_tags, told, to or site)
    out.print(f"  common bias {found.common:+.4f} +- {found.common_sigma:.4f} m, {found.common_ns:+.2f} ns")
    for tag_id, bias in of_tags.items():
        out.print(f"  tag {tag_id} beyond that {bias.constant:+.4f} +- {bias.sigma:.4f} m")
    for tag_id, fit in bearings.items():
        out.print(
            f"  tag {tag_id} by the bearing b of the anchor: cos 2b {fit.bias.cosine:+.4f} +- "
            f"{fit.cosine_sigma:.4f} m, sin 2b {fit.bias.sine:+.4f} +- {fit.sine_sigma:.4f} m",
            soft_wrap=True,
        )
    out.print(f"  written to {to or site}, table range_bias", soft_wrap=True)
    out.print(f"  picture {picture}", soft_wrap=True)
    by_tag = {
        str(i): {"bias_m": bias.constant, "bias_sigma_m": bias.sigma} | _bearing_figures(bearings.get(i))
        for i, bias in of_tags.items()
    }
    _write_json(figures, _range_figures(found) | {"tags": by_tag})


@app.command()
def mounting(log: LogPath, site: Site, until: Until = None, figures: Json = None) -> None:
    """Find where the UWB tag sits on the robot and how late its ranges are stamped, against the LiDAR.

    The drive must turn, both ways best: what a turn does not show of the tag's place, nothing shows. Range
    biases are found along with it. Nothing is written: compare with a ruler before you change the site file.
    """
    from companion.calibration.drive import mounting_on_drive
    from companion.calibration.recording import read_recording
    from companion.config import load_config
    from companion.log import Log

    config = load_config(named_file(site, "sites"))
    opened = Log(log)
    with reading(opened):
        recording = read_recording(opened, config, until, with_odometry=True)
    found = mounting_on_drive(recording, config)
    table = Table(title=f"{config.site.name}: UWB tag against LiDAR", title_justify="left")
    for heading in ("", "site", "found", "sigma", "unit"):
        table.add_column(heading, justify="right" if heading else "left")
    for i, axis in enumerate("xy"):
        row = (f"{config.body.tag[i]:.3f}", f"{found.arm[i]:.3f}", f"{found.arm_sigma[i]:.3f}", "m")
        table.add_row(f"body.tag {axis}", *row)
    delay = (f"{found.delay * 1e3:.1f}", f"{found.delay_sigma * 1e3:.1f}", "ms")
    table.add_row("ranges stamped late by", "0.0", *delay)
    out = result_console()
    out.print(table)
    sensor = "UWB" if found.delay >= 0.0 else "LiDAR"
    out.print(
        f"  to take the delay off: add {abs(found.delay) * 1e3:.1f} to latency_ms of the {sensor} sensor"
    )
    _write_json(
        figures,
        {
            "tag_m": found.arm,
            "tag_sigma_m": found.arm_sigma,
            "delay_s": found.delay,
            "delay_sigma_s": found.delay_sigma,
        },
    )


def _badly_seen(found: "Calibration") -> list[int]:
    """Anchors whose errors scatter more than noise does, or of whose ranges many were left out."""
    return [
        anchor_id
        for anchor_id, fit in found.anchors.items()
        if fit.spread > MAX_SPREAD or fit.used < MIN_USED_SHARE * len(fit.ranges.measured)
    ]


def _range_table(found: "Calibration", config: "Config") -> Table:
    import numpy as np

    table = Table(
        title=f"{config.site.name}: range minus distance",
        title_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    for heading in ("anchor", "bias\nm", "sigma\nm", "at\nm", "per metre\nm/m", "sigma\nm/m"):
        table.add_column(heading, justify="right")
    for heading in ("RMS\nbefore", "RMS\nafter", "used", "of"):
        table.add_column(heading, justify="right", no_wrap=True)
    for anchor_id in config.anchors:
        fit = found.anchors.get(anchor_id)
        if fit is None:
            table.add_row(str(anchor_id), "too few ranges")
            continue
        before, after = (float(np.sqrt((fit.residuals(c) ** 2).mean())) for c in (False, True))
        table.add_row(
            str(anchor_id),
            f"{fit.bias.constant:+.3f}",
            f"{fit.constant_sigma:.3f}",
            f"{fit.bias.distance:.1f}",
            f"{fit.bias.per_metre:+.4f}" if fit.per_metre_sigma else "-",
            f"{fit.per_metre_sigma:.4f}" if fit.per_metre_sigma else "-",
            f"{before:.3f}",
            f"{after:.3f}",
            str(fit.used),
            str(len(fit.ranges.measured)),
        )
    return table


def _bearing_figures(fit: "BearingFit | None") -> dict[str, float]:
    if fit is None:
        return {}
    return {
        "cosine_m": fit.bias.cosine,
        "cosine_sigma_m": fit.cosine_sigma,
        "sine_m": fit.bias.sine,
        "sine_sigma_m": fit.sine_sigma,
    }


def _range_figures(found: "Calibration") -> dict[str, object]:
    return {
        "common_m": found.common,
        "common_sigma_m": found.common_sigma,
        "anchors": {
            str(i): {
                "bias_m": fit.bias.constant,
                "bias_sigma_m": fit.constant_sigma,
                "at_m": fit.bias.distance,
                "per_metre": fit.bias.per_metre,
                "per_metre_sigma": fit.per_metre_sigma,
                "ranges_used": fit.used,
                "ranges": len(fit.ranges.measured),
            }
            for i, fit in found.anchors.items()
        },
    }


def _write_json(path: Path | None, figures: dict[str, object]) -> None:
    if path is None:
        return
    try:
        path.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error
