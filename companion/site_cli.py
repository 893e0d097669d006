"""Commands that need nothing but a site file."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from companion.errors import UserError
from companion.shipped_files import named_file
from companion.terminal import Sets, result_console

out = result_console()


def plan(
    site: Annotated[
        Path, typer.Argument(metavar="SITE", help="Site file with walls, or the name of one in params/sites.")
    ],
    scenario: Annotated[
        str | None,
        typer.Option("--scenario", metavar="NAME", help="Take furniture from the boxes of this scenario."),
    ] = None,
    limit: Annotated[
        float,
        typer.Option("--limit", min=0.001, metavar="M", help="Position error that is still good, in metres."),
    ] = 0.2,
    sigma: Annotated[
        float | None,
        typer.Option("--sigma", min=0.001, metavar="M", help="Range noise in metres; default: that of ekf."),
    ] = None,
    folder: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for plan.png.")] = Path(
        "out/plan"
    ),
    sets: Sets = None,
) -> None:
    """Say how accurate ranges can be over the floor, where they are bad, where one more anchor helps most.

    Walls and furniture block ranges, and a blocked range does not count. The error is the least that a single
    frame of ranges allows (Cramer-Rao): a filter with a LiDAR does better, nothing without memory does.
    """
    from companion.config import load_config
    from companion.plan import plan_layout
    from companion.plan_plot import plan_figure
    from companion.sim.scenario import load_scenario

    config = load_config(named_file(site, "sites"), sets or [])
    world = load_scenario(named_file(Path(scenario), "scenarios"), None, []).world if scenario else None
    layout = plan_layout(config, world, limit, sigma)
    plan_figure(layout, config, folder / "plan.png")
    for line in layout.lines():
        out.print(line, soft_wrap=True)
    out.print(f"picture  {folder / 'plan.png'}", soft_wrap=True)


def dump_config(
    site: Annotated[
        Path | None, typer.Option("--site", metavar="FILE", help="Resolve this site file instead.")
    ] = None,
    sets: Sets = None,
) -> None:
    """Print every setting with its default, or a site's whole configuration, as TOML."""
    from companion.config import default_toml, load_config

    if site is None:
        if sets:
            raise UserError("--set: give --site too; the defaults alone are no configuration to change")
        sys.stdout.write(default_toml())
    else:
        sys.stdout.write(load_config(named_file(site, "sites"), sets or []).to_toml())
