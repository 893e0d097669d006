"""What faults do to estimators, in one table: a row for each fault, the trials without one first."""

from collections.abc import Iterator, Mapping

from rich import box
from rich.table import Table

from companion.evaluation import Evaluation, MeanFigures
from companion.evaluation_table import markdown_line, short

MOST_BEYOND = 0.01
"""Share of the poses sent that may be beyond 3 sigma; more is marked."""


def fault_table(name: str, results: Mapping[str, Evaluation]) -> Table:
    """Errors and integrity by fault and estimator.

    Args:
        name: of scenario or log.
        results: fault, "" for none -> its evaluation.
    """
    table = Table(title=_title(name, results), title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1))
    table.add_column("fault", no_wrap=True)
    for heading in _headings(results):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in _rows(results, "[bold red]{}[/]"):
        table.add_row(*row)
    return table


def fault_markdown(name: str, results: Mapping[str, Evaluation]) -> str:
    """The same as a section of Markdown, with what is marked in bold."""
    headings = ["fault", *_headings(results)]
    lines = [f"## {_title(name, results)}", "", markdown_line(headings)]
    lines.append(markdown_line(["---", *["---:"] * (len(headings) - 1)]))
    lines += map(markdown_line, _rows(results, "**{}**"))
    return "\n".join([*lines, "", ""])


def _title(name: str, results: Mapping[str, Evaluation]) -> str:
    trials = max(result.trials for result in results.values())
    count = "one trial" if trials == 1 else f"{trials} trials"
    return f"{name}, {count} a fault: RMSE m / healthy poses beyond 3 sigma, %"


def _headings(results: Mapping[str, Evaluation]) -> list[str]:
    return list(next(iter(results.values())).estimators)


def _rows(results: Mapping[str, Evaluation], mark: str) -> Iterator[list[str]]:
    """Fault and cells; those that one would not fly on are put into the mark."""
    for fault, result in results.items():
        yield [fault or "none", *(_cell(figures, mark) for figures in result.estimators.values())]


def _cell(figures: MeanFigures | None, mark: str) -> str:
    if figures is None:
        return "none"
    error = short(figures.rmse_m, 3)
    if figures.integrity is None:
        return f"{error} / -"
    cell = f"{error} / {100 * figures.integrity:.2f}"
    return mark.format(cell) if figures.integrity > MOST_BEYOND else cell
