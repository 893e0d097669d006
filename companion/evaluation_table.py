"""An evaluation as tables for a terminal and as Markdown, published figures under our own."""

from collections.abc import Mapping, Sequence

import numpy as np
from rich import box
from rich.table import Table

from companion.evaluation import Evaluation, MeanFigures
from companion.legs import LegFigures
from companion.sim.scenario_tables import PaperFigures, PaperLeg

_PAPER = "  paper"
_ERRORS = ("RMSE\nm", "\nx", "\ny", "max\nm", "\nx", "\ny", "yaw\ndeg")
_CONSISTENCY = ("NEES\n(95 %)", "update us\n50/99 %", "RMSE/\nbound")
_TRUST = (
    "RMSE/\nepoch",
    "ATE\nm",
    "RPE\nm/m",
    "RPE\ndeg/m",
    "NIS\n(95 %)",
    "poses\n%",
    "first fix\ns",
    "beyond 3 sigma\n% of healthy",
)

_LEGS = "legs: RMSE / max m"


def evaluation_table(result: Evaluation) -> Table:
    """Mean figures of every estimator; below each, dimmed, what the scenario's paper states of it."""
    return _table(_title(result), (*_ERRORS, *_CONSISTENCY), accuracy_rows(result))


def trust_table(result: Evaluation) -> Table:
    """What an autopilot asks for: drift, availability, first fix, integrity."""
    return _table("", _TRUST, trust_rows(result))


def markdown(result: Evaluation, pictures: Sequence[str] = ()) -> str:
    """The tables and notes as a section of Markdown.

    Args:
        result: to tell of.
        pictures: names of files beside the text.
    """
    parts = [f"## {_title(result)}", ""]
    tables = [((*_ERRORS, *_CONSISTENCY), accuracy_rows(result)), (_TRUST, trust_rows(result))]
    if legs := _leg_names(result):
        tables.append((tuple(f"{name}, RMSE / max m" for name in legs), leg_rows(result)))
    for headings, rows in tables:
        cells = ["estimator", *(heading.replace("\n", " ").strip() for heading in headings)]
        parts += [markdown_line(cells), markdown_line(["---", *["---:"] * len(headings)])]
        parts += [markdown_line([*row, *[""] * (len(cells) - len(row))]) for row in rows]
        parts.append("")
    parts += [f"- {note}" for note in evaluation_notes(result)]
    parts += ["", *(f"![{result.scenario}]({name})" for name in pictures), ""]
    return "\n".join(parts)


def leg_table(result: Evaluation) -> Table | None:
    """RMSE and largest error on every named leg, published figures below ours; None without such legs."""
    names = _leg_names(result)
    return _table(_LEGS, names, leg_rows(result)) if names else None


def evaluation_notes(result: Evaluation) -> list[str]:
    """What the tables leave open, a line each."""
    notes = [
        "NEES bounds: chi-square, one independent sample a trial (instants of a trial are correlated)",
        f"ATE: alignment {result.alignment}; RPE: over 1 m of the way; healthy: a live run would send it",
        "RMSE/bound: posterior Cramer-Rao; RMSE/epoch: of one frame of unblocked ranges, without memory",
    ]
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
    notes += [
        _range_note(name, figures.ranges)
        for name, figures in result.estimators.items()
        if figures and figures.ranges and figures.ranges["biased"]
    ]
    notes += [note for name in result.errors if (note := _height_note(result, name)) is not None]
    notes += [
        f"{name}: {mean.iterations:.1f} iterations of its solver for a frame"
        for name, mean in result.estimators.items()
        if mean is not None and mean.iterations is not None
    ]
    return notes


def _height_note(result: Evaluation, name: str) -> str | None:
    """What an estimator says of the height; None when it takes the site's for granted."""
    errors, body = list(result.errors[name].values()), result.config.body
    if not errors:
        return None
    variances = np.concatenate([each.height_variance for each in errors])
    observed = np.isfinite(variances)
    if np.allclose(variances, body.height_sigma**2):
        return None
    if not observed.any():
        return f"{name}: height unobservable, the anchors lie in one plane; the site's is kept"
    off = np.concatenate([each.height for each in errors])[observed] - body.height
    return (
        f"{name}: height from ranges at {observed.mean():.1%} of the poses, RMSE "
        f"{np.sqrt((off**2).mean()):.3f} m against the site's, claimed "
        f"{np.sqrt(variances[observed].mean()):.3f} m"
    )


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


def accuracy_rows(result: Evaluation) -> list[list[str]]:
    """Name and figures of every estimator, the paper's row after ours."""
    published = result.paper.estimators if result.paper else {}
    rows = []
    for name, figures in result.estimators.items():
        rows.append([name, *(_cells(figures) if figures else ["none"])])
        if name in published:
            rows.append([_PAPER, *_paper_cells(published[name])])
    return rows


def trust_rows(result: Evaluation) -> list[list[str]]:
    """Name, drift, availability, first fix and integrity of every estimator."""
    return [
        [name, *(_trust_cells(figures) if figures else ["none"])]
        for name, figures in result.estimators.items()
    ]


def leg_rows(result: Evaluation) -> list[list[str]]:
    """Name of every estimator and its errors on each named leg, the paper's row after ours."""
    names = _leg_names(result)
    published = result.paper.estimators if result.paper else {}
    rows = []
    for choice, figures in result.estimators.items():
        ours = figures.legs if figures else {}
        rows.append([choice, *(_leg_cell(ours.get(name)) for name in names)])
        if choice in published and published[choice].legs:
            stated = published[choice].legs
            rows.append([_PAPER, *(_leg_cell(stated.get(name)) for name in names)])
    return rows


def _leg_names(result: Evaluation) -> tuple[str, ...]:
    return tuple(dict.fromkeys(leg for mean in result.estimators.values() if mean for leg in mean.legs))


def _title(result: Evaluation) -> str:
    trials = "one trial" if result.trials == 1 else f"means of {result.trials} trials"
    return f"{result.scenario}: {trials}"


def _table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    table = Table(title=title or None, title_justify="left", box=box.SIMPLE_HEAD, padding=0)
    table.add_column("estimator", no_wrap=True)
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*row, style="dim" if row[0] == _PAPER else None)
    return table


def markdown_line(cells: Sequence[str]) -> str:
    """A row of a table."""
    return f"| {' | '.join(cells)} |"


def _cells(figures: MeanFigures) -> list[str]:
    low, high = figures.nees_bounds
    update = figures.update_us
    return [
        *(short(getattr(figures, key), 3) for key in _POSITION),
        "none" if figures.yaw_rmse_deg is None else f"{figures.yaw_rmse_deg:.1f}",
        f"{figures.nees:.1f} ({low:.1f}-{high:.1f})",
        f"{update.median:.0f}/{update.p99:.0f}",
        _known(figures.bound_ratio, 2),
    ]


def _trust_cells(figures: MeanFigures) -> list[str]:
    bounds = figures.nis_bounds
    nis = "-"
    if figures.nis is not None and bounds is not None:
        nis = f"{figures.nis:.2f} ({bounds[0]:.2f}-{bounds[1]:.2f})"
    return [
        _known(figures.epoch_bound_ratio, 2),
        short(figures.ate_m, 3),
        _known(figures.rpe_m, 3),
        _known(figures.rpe_deg, 2),
        nis,
        f"{100 * figures.availability:.1f}",
        _known(figures.first_fix_s, 1),
        "-" if figures.integrity is None else f"{100 * figures.integrity:.2f}",
    ]


def _paper_cells(figures: PaperFigures) -> list[str]:
    stated = [getattr(figures, key, None) for key in _POSITION]
    return ["" if value is None else short(value, 3) for value in stated]


def _leg_cell(figures: LegFigures | PaperLeg | None) -> str:
    if figures is None or (figures.rmse_m is None and figures.max_m is None):
        return ""
    return " / ".join("-" if v is None else short(v, 3) for v in (figures.rmse_m, figures.max_m))


_POSITION = ("rmse_m", "rmse_x_m", "rmse_y_m", "max_m", "max_x_m", "max_y_m")


def _known(value: float | None, digits: int) -> str:
    return "-" if value is None else short(value, digits)


def short(value: float, digits: int) -> str:
    """A number in few characters: what is large needs no decimals."""
    return f"{value:.{digits}f}" if value < 10.0 else f"{value:.1f}"
