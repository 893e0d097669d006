"""An evaluation as a table for a terminal, published figures under our own."""

from rich import box
from rich.table import Table

from companion.evaluation import Evaluation, MeanFigures
from companion.legs import LegFigures
from companion.sim.scenario_tables import PaperFigures, PaperLeg


def evaluation_table(result: Evaluation) -> Table:
    """Mean figures of every estimator; below each, dimmed, what the scenario's paper states of it."""
    title = f"{result.scenario}: means of {result.trials} trials"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=0)
    table.add_column("estimator", no_wrap=True)
    for heading in ("RMSE\nm", "\nx", "\ny", "max\nm", "\nx", "\ny", "yaw\ndeg"):
        table.add_column(heading, justify="right", no_wrap=True)
    for heading in ("NEES\n(95 %)", "update us\n50/99 %", "RMSE/\nbound"):
        table.add_column(heading, justify="right", no_wrap=True)
    published = result.paper.estimators if result.paper else {}
    for name, figures in result.estimators.items():
        table.add_row(name, *(_cells(figures) if figures else ["none"]))
        if name in published:
            table.add_row("  paper", *_paper_cells(published[name]), style="dim")
    return table


def leg_table(result: Evaluation) -> Table | None:
    """RMSE and largest error on every named leg, published figures below ours; None without such legs."""
    names = list(dict.fromkeys(leg for mean in result.estimators.values() if mean for leg in mean.legs))
    if not names:
        return None
    table = Table(title="legs: RMSE / max [m]", title_justify="left", box=box.SIMPLE_HEAD, padding=0)
    table.add_column("estimator", no_wrap=True)
    for name in names:
        table.add_column(name, justify="right", no_wrap=True)
    published = result.paper.estimators if result.paper else {}
    for choice, mean in result.estimators.items():
        ours = mean.legs if mean else {}
        table.add_row(choice, *(_leg_cell(ours.get(name)) for name in names))
        if choice in published and published[choice].legs:
            stated = published[choice].legs
            table.add_row("  paper", *(_leg_cell(stated.get(name)) for name in names), style="dim")
    return table


def evaluation_notes(result: Evaluation) -> list[str]:
    """What the table leaves open, a line each."""
    notes = ["NEES bounds: chi-square, one independent sample a trial (instants of a trial are correlated)"]
    if result.paper:
        notes.append(f"paper: {result.paper.source}")
    notes += [
        f"{name}: a pose at {share:.1%} of the instants only"
        for name, share in result.availability.items()
        if share < 0.99
    ]
    notes += [
        f"{name}: {mean.iterations:.1f} iterations of its solver for a frame"
        for name, mean in result.estimators.items()
        if mean is not None and mean.iterations is not None
    ]
    return notes


def _cells(figures: MeanFigures) -> list[str]:
    low, high = figures.nees_bounds
    update = figures.update_us
    return [
        *(_short(getattr(figures, key), 3) for key in _POSITION),
        "none" if figures.yaw_rmse_deg is None else f"{figures.yaw_rmse_deg:.1f}",
        f"{figures.nees:.1f} ({low:.1f}-{high:.1f})",
        f"{update.median:.0f}/{update.p99:.0f}",
        "-" if figures.bound_ratio is None else _short(figures.bound_ratio, 2),
    ]


def _paper_cells(figures: PaperFigures) -> list[str]:
    stated = [getattr(figures, key, None) for key in _POSITION]
    return ["" if value is None else _short(value, 3) for value in stated]


def _leg_cell(figures: LegFigures | PaperLeg | None) -> str:
    if figures is None or (figures.rmse_m is None and figures.max_m is None):
        return ""
    return " / ".join("-" if v is None else _short(v, 3) for v in (figures.rmse_m, figures.max_m))


_POSITION = ("rmse_m", "rmse_x_m", "rmse_y_m", "max_m", "max_x_m", "max_y_m")


def _short(value: float, digits: int) -> str:
    """A number in few characters: what is large needs no decimals."""
    return f"{value:.{digits}f}" if value < 10.0 else f"{value:.1f}"
