"""The outcomes as tables for a terminal and as pictures."""

from itertools import groupby
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from companion.function_benchmark.functions import FUNCTIONS, ITERATIONS, PAPER
from companion.function_benchmark.race import (
    CONTENDERS,
    EVALUATIONS,
    PAPER_SETTINGS,
    SAMPLES,
    Race,
    Setting,
)

# Okabe and Ito's colours, each with a dash of its own; ours in full lines, rivals in broken ones.
_LINES: dict[str, tuple[str, str, float]] = {
    "bas_printed": ("#999999", "-", 1.0),
    "bas": ("#56B4E9", "-", 1.2),
    "bas_range": ("#56B4E9", "--", 1.2),
    "ibas_printed": ("#E69F00", "-", 1.2),
    "ibas_prose": ("#E69F00", "--", 1.2),
    "ibas": ("#0072B2", "-", 2.4),
    "pso": ("#D55E00", "-.", 1.2),
    "ga": ("#009E73", "-.", 1.2),
    "ba": ("#CC79A7", "-.", 1.2),
}
_INK, _GRID = "#303030", "#E4E4E4"


def outcome_table(race: Race, setting: Setting) -> Table:
    """Mean and standard deviation of each contender on each function; the best mean in bold."""
    if setting is Setting.ORIGINAL:
        title = f"optimum in the origin, {ITERATIONS} iterations as in the paper"
    else:
        title = f"optimum shifted, {EVALUATIONS} evaluations for all"
    table = Table(
        title=f"{title}; mean ± std of {race.trials} runs",
        title_justify="left",
        caption="_printed: as printed; ibas_prose: as its text says; bas, ibas: corrected; "
        "bas_range: first step as large as half the range",
        caption_justify="left",
    )
    table.add_column("search", no_wrap=True)
    for heading in ("evalu-\nations", "ms"):
        table.add_column(heading, justify="right")
    for function in FUNCTIONS.values():
        table.add_column(function.label.replace(" ", "\n"), justify="right", no_wrap=True)
    best = race.best(setting)
    for algorithm, group in groupby(race.outcomes[setting].items(), lambda item: CONTENDERS[item[0]]):
        if setting is Setting.ORIGINAL:
            printed = PAPER[algorithm]
            table.add_row(
                f"{algorithm} in the paper",
                "",
                _milliseconds([entry.seconds for entry in printed.values()]),
                *(_entry(printed[f].mean, printed[f].std) for f in FUNCTIONS),
                style="italic",
            )
        for name, row in group:
            table.add_row(
                name,
                str(max(outcome.evaluations for outcome in row.values())),
                _milliseconds([outcome.seconds for outcome in row.values()]),
                *(_entry(row[f].mean, row[f].std, bold=best[f] == name) for f in FUNCTIONS),
            )
        table.add_section()
    return table


def _entry(mean: float, std: float, bold: bool = False) -> str:
    style = "bold green" if bold else "default"
    return f"[{style}]{mean:.2e}[/]\n[dim]± {std:.0e}[/]"


def _milliseconds(seconds: list[float]) -> str:
    return f"{1000.0 * float(np.mean(seconds)):.0f}"


def verdict(race: Race) -> str:
    """Who has the least mean on the shifted functions: with the paper's settings, and of all that ran."""
    ran = [name for name in PAPER_SETTINGS if name in race.outcomes[Setting.SHIFTED]]
    return (
        f"least mean on the shifted functions:\n"
        f"  of {', '.join(ran)}: {_counted(race.best(Setting.SHIFTED, PAPER_SETTINGS))}\n"
        f"  of all rows: {_counted(race.best(Setting.SHIFTED))}"
    )


def _counted(best: dict[str, str]) -> str:
    where: dict[str, list[str]] = {}
    for function, name in best.items():
        where.setdefault(name, []).append(function)
    ranked = sorted(where.items(), key=lambda item: -len(item[1]))
    return "; ".join(f"{name} on {len(there)} ({', '.join(there)})" for name, there in ranked)


def convergence_figure(race: Race, setting: Setting, path: Path) -> None:
    """Draw how the least cost so far falls, one panel a function, as a PNG picture of 1500 x 900 pixels.

    Args:
        race: the outcomes.
        setting: the one to draw.
        path: file to write.
    """
    picture = Figure(figsize=(10.0, 6.0), dpi=150, layout="constrained")
    shifted = setting is Setting.SHIFTED
    kind = "random optima, equal evaluations" if shifted else "optimum in the origin, as in the paper"
    picture.suptitle(f"Least cost so far, mean of {race.trials} runs: {kind}", fontsize=11, color=_INK)
    axes = picture.subplots(2, 3).ravel()
    instants = np.linspace(0.0, EVALUATIONS if shifted else ITERATIONS, SAMPLES)
    for ax, (function, problem) in zip(axes, FUNCTIONS.items(), strict=False):
        positive: list[float] = []
        for name, row in race.outcomes[setting].items():
            history = row[function].history
            colour, dash, width = _LINES[name]
            ax.plot(instants, history, dash, color=colour, linewidth=width, label=name)
            positive.extend(history[history > 0.0])
        ax.set_yscale("log")
        # Where all runs have reached 0, a line leaves the panel at the bottom.
        ax.set_ylim(0.5 * min(positive), None)
        ax.set_title(problem.label, loc="left", fontsize=9)
        ax.tick_params(which="both", labelsize=8, colors=_INK)
        ax.spines[["top", "right"]].set_visible(False)
        ax.set_axisbelow(True)
        ax.grid(color=_GRID, linewidth=0.6)
        ax.set_xlabel("evaluations" if shifted else "iterations", fontsize=9)
    axes[-1].set_axis_off()
    axes[-1].legend(*axes[0].get_legend_handles_labels(), loc="center", fontsize=9, frameon=False)
    picture.savefig(path, format="png")
