"""`companion smooth`: the course that fits a whole log best, and the anchors that fit it."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from companion.errors import UserError
from companion.run_folder import folder_for
from companion.shipped_files import named_file
from companion.terminal import LogPath, Sets, message_console, progress, result_console

if TYPE_CHECKING:
    from companion.smooth import SmoothedLog


def smooth(
    log: LogPath,
    site: Annotated[
        Path | None,
        typer.Option("--site", metavar="FILE", help="Site file instead of the log's own settings."),
    ] = None,
    anchors: Annotated[bool, typer.Option("--anchors", help="Find where the anchors are, too.")] = False,
    biases: Annotated[
        bool, typer.Option("--biases", help="Find how much too long each anchor's ranges are, too.")
    ] = False,
    folder: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder to write; default out/NAME-smooth.")
    ] = None,
    sets: Sets = None,
) -> None:
    """Find the course that fits a whole log best: every pose from what came before it and after.

    Writes poses.tum, summary.json and smooth.png; with --anchors or --biases a survey of the anchors from the
    drive, and anchors.toml to paste into the site file. Afterwards only: a live pose knows no future.
    """
    from companion.config import load_config
    from companion.log import Log
    from companion.plots import figure
    from companion.replay import config_of, tum_line

    # Numba loads slowly: only who smooths waits for it.
    from companion.smooth import SMOOTHED, anchors_toml, smooth_log
    from companion.tables import accuracy_table

    out, err = result_console(), message_console()
    opened = Log(log)
    config = load_config(named_file(site, "sites"), sets or []) if site else config_of(opened, sets or [])
    folder = folder or folder_for(log, "smooth")
    with progress(err) as shown:
        bar = shown.add_task(log.name, total=1.0)
        found = smooth_log(opened, config, anchors, biases, lambda share: shown.update(bar, completed=share))
    files = {
        "poses.tum": "".join(tum_line(pose) for pose in found.replay.poses[SMOOTHED]),
        "summary.json": json.dumps(_summary(found), indent=2) + "\n",
    }
    if anchors or biases:
        files["anchors.toml"] = anchors_toml(found)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot write to {folder}: {error.strerror}") from error
    figure(found.replay, folder / "smooth.png", f"{log.name}, smoothed", None)
    errors = "" if found.replay.errors else ", no truth in the log"
    out.print(accuracy_table(found.replay, f"{found.replay.duration:.1f} s{errors}"))
    out.print(_anchor_table(found, anchors, biases))
    out.print(f"  frame: {found.gauge}", highlight=False, soft_wrap=True)
    out.print(f"  loop closures: {_closures(found)}", highlight=False, soft_wrap=True)
    if anchors:
        out.print()
        out.print(anchors_toml(found), highlight=False, markup=False)
    out.print(f"  written to {folder}: {', '.join([*files, 'smooth.png'])}", highlight=False, soft_wrap=True)


def _closures(found: "SmoothedLog") -> str:
    smoothed = found.smoothed
    return f"{smoothed.closures} used, {smoothed.false_closures} refused because they contradict the rest"


def _anchor_table(found: "SmoothedLog", anchors: bool, biases: bool) -> Table:
    import numpy as np

    table = Table(title="anchors, and what is left of their ranges", title_justify="left")
    headings = ["anchor"]
    headings += ["x\nm", "y\nm", "sigma\nm", "moved\nm"] if anchors else []
    headings += ["bias\nm"] if biases else []
    for heading in [*headings, "used", "out", "left: mean,\nRMS m"]:
        table.add_column(heading, justify="right", no_wrap=True)
    for anchor_id, fix in found.smoothed.anchors.items():
        cells = [str(anchor_id)]
        if anchors:
            sigma = float(np.sqrt(np.linalg.eigvalsh(fix.position_cov)[-1]))
            x, y = fix.position.tolist()
            moved = float(np.linalg.norm(found.moved[anchor_id]))
            cells += [f"{x:.3f}", f"{y:.3f}", f"{sigma:.3f}", f"{moved:.3f}"]
        if biases:
            cells += [f"{fix.bias:+.3f} ± {fix.bias_sigma:.3f}"]
        cells += [f"{fix.ranges}", f"{fix.blocked}", f"{fix.residual_mean:+.3f}, {fix.residual_rms:.3f}"]
        table.add_row(*cells)
    return table


def _summary(found: "SmoothedLog") -> dict[str, object]:
    accuracies = {name: found.replay.accuracy(name) for name in found.replay.names}
    return {
        "rmse_m": {name: accuracy.rmse for name, accuracy in accuracies.items() if accuracy is not None},
        "gauge": found.gauge,
        "solver_steps": found.smoothed.iterations,
        "loop_closures": {"used": found.smoothed.closures, "refused": found.smoothed.false_closures},
        "anchors": {
            str(anchor_id): {
                "position": fix.position.tolist(),
                "position_cov": fix.position_cov.tolist(),
                "moved": found.moved[anchor_id].tolist(),
                "bias": fix.bias,
                "bias_sigma": fix.bias_sigma,
                "ranges": fix.ranges,
                "blocked": fix.blocked,
                "residual_mean": fix.residual_mean if fix.ranges else None,
                "residual_rms": fix.residual_rms if fix.ranges else None,
            }
            for anchor_id, fix in found.smoothed.anchors.items()
        },
    }
