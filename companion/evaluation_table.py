"""An evaluation as a table for a terminal, published figures under our own."""

from collections.abc import Mapping

from rich import box
from rich.table import Table

from companion.evaluation import Evaluation, MeanFigures
from companion.sim.scenario_tables import PaperFigures


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
    for name in result.settled:
        found = result.settled_figures(name)
        median = "never" if found["median_s"] is None else f"after {found['median_s']:.1f} s"
        notes.append(
            f"{name}: within 0.3 m and 10 deg to the end {median} (median); within 5 s of motion in "
            f"{found['within_5_s']} of {result.trials} trials"
        )
    return notes + [
        _range_note(name, figures.ranges)
        for name, figures in result.estimators.items()
        if figures and figures.ranges["biased"]
    ]


def _range_note(name: str, ranges: Mapping[str, float | int | None]) -> str:
    """What an estimator made of blocked and of clean ranges."""

    def fate(kind: str) -> str:
        rejected, weakened = ranges[f"{kind}_rejected"], ranges[f"{kind}_downweighted"]
        if rejected is None or weakened is None:
            return "none"
        return f"{rejected:.1%} rejected" + (f", {weakened:.1%} down-weighted" if weakened else "")

    return (
        f"{name}: of {ranges['biased']} ranges that are too long by more than 3 sigma {fate('biased')}; of "
        f"{ranges['clean']} clean ones {fate('clean')}"
    )


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


_POSITION = ("rmse_m", "rmse_x_m", "rmse_y_m", "max_m", "max_x_m", "max_y_m")


def _short(value: float, digits: int) -> str:
    """A number in few characters: what is large needs no decimals."""
    return f"{value:.{digits}f}" if value < 10.0 else f"{value:.1f}"
