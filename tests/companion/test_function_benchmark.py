"""The function benchmark: its functions, its runs, its rivals where they are installed, and what it shows."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from rich.console import Console
from typer.testing import CliRunner

from companion.cli import app
from companion.function_benchmark.functions import DIMENSIONS, FUNCTIONS, ITERATIONS, PAPER
from companion.function_benchmark.race import (
    CONTENDERS,
    EVALUATIONS,
    SAMPLES,
    Outcome,
    Race,
    Setting,
    run_once,
)
from companion.function_benchmark.report import convergence_figure, outcome_table, verdict
from companion.function_benchmark.rivals import RIVALS

OURS = [name for name in CONTENDERS if name not in RIVALS]


@pytest.mark.parametrize(
    ("function", "coordinate", "value"),
    [
        ("sphere", 2.0, 120.0),
        ("schwefel", 2.0, 60.0 + 2.0**30),
        ("schwefel", -0.5, 15.0 + 0.5**30),
        ("step", 0.49, 0.0),
        ("step", 0.5, 30.0),
        ("step", -1.6, 120.0),
        ("rastrigin", 0.5, 30 * (0.25 + 10.0 + 10.0)),
        ("rastrigin", 1.0, 30.0),
    ],
)
def test_functions_have_their_values(function: str, coordinate: float, value: float) -> None:
    points = np.full((2, DIMENSIONS), coordinate)
    np.testing.assert_allclose(FUNCTIONS[function].cost(points), [value, value])


def test_griewank_ripples_slower_along_later_axes() -> None:
    points = np.zeros((3, DIMENSIONS))
    points[1, 0], points[2, 8] = np.pi, 3.0 * np.pi  # half a ripple on the first axis and on the ninth
    expected = [0.0, np.pi**2 / 4000.0 + 2.0, 9.0 * np.pi**2 / 4000.0 + 2.0]
    np.testing.assert_allclose(FUNCTIONS["griewank"].cost(points), expected, atol=1e-12)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_nothing_is_below_the_origin(function: str) -> None:
    problem = FUNCTIONS[function]
    points = np.random.default_rng(0).uniform(-problem.half_range, problem.half_range, (200, DIMENSIONS))
    assert problem.cost(np.zeros((1, DIMENSIONS)))[0] == pytest.approx(0.0, abs=1e-12)
    assert problem.cost(points).min() > 0.0


@pytest.mark.parametrize("name", OURS)
def test_shifted_runs_ask_as_often_as_each_other(name: str) -> None:
    run = run_once(Setting.SHIFTED, name, "rastrigin", 0, 0)
    assert EVALUATIONS - 100 < run.evaluations <= EVALUATIONS
    assert run.history.shape == (SAMPLES,)
    assert np.all(np.diff(run.history) <= 0.0)
    assert run.history[-1] < run.history[0]


def test_original_runs_have_the_papers_iterations() -> None:
    runs = {name: run_once(Setting.ORIGINAL, name, "sphere", 0, 0) for name in ("bas", "ibas_printed")}
    assert runs["bas"].evaluations == 1 + 3 * ITERATIONS
    assert runs["ibas_printed"].evaluations == 30 + 91 * ITERATIONS


def test_trials_differ_and_repeat() -> None:
    first, again, second, seeded = (
        run_once(Setting.SHIFTED, "ibas", "griewank", seed, trial).history
        for seed, trial in ((0, 0), (0, 0), (0, 1), (1, 0))
    )
    np.testing.assert_array_equal(first, again)
    assert len({first[-1], second[-1], seeded[-1]}) == 3


def test_all_beetles_of_a_trial_start_alike() -> None:
    starts = {name: run_once(Setting.SHIFTED, name, "sphere", 0, 3).history[0] for name in OURS}
    assert len({starts[name] for name in OURS if CONTENDERS[name] == "IBAS"}) == 1
    assert len({starts[name] for name in OURS if CONTENDERS[name] == "BAS"}) == 1


def test_the_prints_disturbance_finds_the_origin_alone() -> None:
    in_origin, elsewhere = (
        run_once(setting, "ibas_prose", "sphere", 0, 0).history[-1]
        for setting in (Setting.ORIGINAL, Setting.SHIFTED)
    )
    assert in_origin < 1.0
    assert elsewhere > 1e3


@pytest.mark.parametrize("name", RIVALS)
def test_rivals_improve_within_their_evaluations(name: str) -> None:
    pytest.importorskip("niapy")
    pytest.importorskip("pygad")
    first, again, other = (run_once(Setting.SHIFTED, name, "sphere", 0, trial) for trial in (0, 0, 1))
    assert first.evaluations == EVALUATIONS
    # The first population is that of the beetles: they evaluate it at once, rivals one by one.
    best_of_start = run_once(Setting.SHIFTED, "ibas", "sphere", 0, 0).history[0]
    assert best_of_start in first.history
    assert first.history[-1] < best_of_start
    np.testing.assert_array_equal(first.history, again.history)
    assert other.history[-1] != first.history[-1]


def made_up(means: dict[str, list[float]]) -> Race:
    """A race with the same outcomes in both settings; each history falls from ten times the mean to it."""
    rows = {
        name: {
            function: Outcome(mean, 0.1 * mean, 0.0123, 6000, np.linspace(10.0 * mean, mean, SAMPLES))
            for function, mean in zip(FUNCTIONS, row, strict=True)
        }
        for name, row in means.items()
    }
    return Race(7, 3, dict.fromkeys(Setting, rows))


RACE = made_up(
    {
        "bas_range": [1.0, 9.0, 9.0, 9.0, 9.0],
        "bas": [8.0, 9.0, 9.0, 9.0, 9.0],
        "ibas": [3.0, 2.0, 2.0, 2.0, 5.0],
        "ga": [4.0, 4.0, 4.0, 1.5, 4.0],
    }
)


def test_verdict_counts_the_papers_five_and_all() -> None:
    assert verdict(RACE).splitlines()[1:] == [
        "  of bas, ibas, ga: ibas on 3 (sphere, schwefel, step); ga on 2 (rastrigin, griewank)",
        "  of all rows: ibas on 2 (schwefel, step); ga on 2 (rastrigin, griewank); bas_range on 1 (sphere)",
    ]


def test_tables_fit_a_terminal_with_the_paper_beside() -> None:
    text = {}
    for setting in Setting:
        console = Console(width=100, file=io.StringIO(), force_terminal=True, color_system="standard")
        console.print(outcome_table(RACE, setting))
        assert isinstance(console.file, io.StringIO)
        text[setting] = console.file.getvalue()
        assert "…" not in text[setting]
        assert "7 runs" in text[setting]
        # Bold green: the best of a column.
        assert text[setting].count("\x1b[1;32m") == len(FUNCTIONS)
        assert "\x1b[1;32m1.50e+00" in text[setting]
    for mean in ("6.78e-16", "3.10e-10", "2.39e+02", "1.01e+02"):
        assert mean in text[Setting.ORIGINAL]
        assert mean not in text[Setting.SHIFTED]


def test_picture_has_a_panel_for_each_function(tmp_path: Path) -> None:
    path = tmp_path / "picture.png"
    race = made_up({"ibas": [1.0, 1e-9, 0.0, 30.0, 1e-2], "bas": [2.0, 3.0, 4.0, 5.0, 6.0]})
    convergence_figure(race, Setting.SHIFTED, path)
    pixels = np.asarray(imread(path), dtype=np.float64)[:, :, :3]
    assert pixels.shape == (900, 1500, 3)
    blue = np.abs(pixels - np.array([0, 114, 178]) / 255.0).max(axis=2) < 0.1
    panels = [blue[row : row + 450, column : column + 500] for row in (0, 450) for column in (0, 500, 1000)]
    # A cost of 0, here on the third, is below every logarithmic axis; the sixth is the legend's.
    assert [bool(panel.sum() > 100) for panel in panels] == [True, True, False, True, True, True]


def test_command_without_rivals_says_so_and_writes_what_it_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = {name: CONTENDERS[name] for name in ("ibas_printed", "ibas", "pso")}
    monkeypatch.setattr("companion.function_benchmark.race.CONTENDERS", few)
    monkeypatch.setattr("companion.function_benchmark.rivals.missing", lambda: ["niapy"])
    monkeypatch.setenv("COLUMNS", "100")
    figures, folder = tmp_path / "new" / "figures.json", tmp_path / "pictures"
    call = [
        "evaluate",
        "functions",
        "--trials",
        "2",
        "--seed",
        "4",
        "--json",
        str(figures),
        "--out",
        str(folder),
    ]
    done = CliRunner().invoke(app, call)
    assert done.exit_code == 0, done.output
    assert "PSO, GA and BA are left out: niapy not installed" in done.stderr
    assert "pip install -e '.[bench]'" in done.stderr
    written = json.loads(figures.read_text())
    assert (written["trials"], written["seed"]) == (2, 4)
    for setting in Setting:
        assert list(written[setting]) == ["ibas_printed", "ibas"]
        for function, entry in written[setting]["ibas"].items():
            runs = [run_once(setting, "ibas", function, 4, trial).history[-1] for trial in range(2)]
            assert entry["mean"] == pytest.approx(np.mean(runs))
            assert entry["std"] == pytest.approx(abs(runs[0] - runs[1]) / np.sqrt(2.0))
    assert written["paper"]["IBAS"]["sphere"]["mean"] == PAPER["IBAS"]["sphere"].mean
    for setting in Setting:
        assert (folder / f"convergence_{setting}.png").read_bytes().startswith(b"\x89PNG")
        assert f"convergence_{setting}.png" in done.stdout


def test_a_place_that_cannot_be_written_is_refused_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    call = ["evaluate", "functions", "--json", str(tmp_path / "file" / "a.json"), "--out", str(tmp_path)]
    done = CliRunner().invoke(app, call)
    assert done.exit_code != 0
    assert str(done.exception) == f"cannot write {tmp_path / 'file' / 'a.json'}: File exists"
