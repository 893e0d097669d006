"""Evaluation of logs, of several sources, on a cluster, and what is left of one that is interrupted."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from companion.alignment import Alignment
from companion.errors import UserError
from companion.evaluation import Evaluation, evaluate_scenario
from companion.evaluation_plots import evaluation_figure
from companion.evaluation_table import markdown
from companion.fault_table import fault_markdown
from companion.log import Log, LogWriter, RawChunk
from companion.log_edit import faults
from companion.replay import config_of, replay
from companion.trial_runner import run_trials
from companion.worst_trial import write_worst_trial
from tests.companion.test_evaluation import FEW, PAPER, STRAIGHT_ON, companion, without_times
from tests.conftest import SITE, Command, write_scenario

CHOICES = ["uwb_ls", "ekf"]


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scenario(tmp_path_factory.mktemp("walk"), STRAIGHT_ON, FEW + PAPER)


@pytest.fixture(scope="module")
def result(walk: Path) -> Evaluation:
    return evaluate_scenario(walk, 3, choices=CHOICES, alignment=Alignment.SE2)


def test_a_log_gives_the_figures_of_its_replay(short_log: Path) -> None:
    log = Log(short_log)
    replayed = replay(log, config_of(log, []), ["ekf", "least_squares"])
    accuracy = replayed.accuracy("ekf")
    found = evaluate_scenario(short_log, 30, choices=["ekf", "lidar"])
    assert (found.trials, found.scenario) == (1, "short")
    ekf, lidar = found.estimators["ekf"], found.estimators["lidar"]
    assert accuracy is not None
    assert ekf is not None
    assert (ekf.rmse_m, ekf.nees, ekf.availability) == (accuracy.rmse, accuracy.nees, accuracy.availability)
    # What a live run sends is what the replay's health says: 30 poses a second.
    sent = sum(replayed.health[state] for state in ("ok", "degraded"))
    assert ekf.first_fix_s == pytest.approx((sum(replayed.health.values()) - sent) / 30.0, abs=0.1)
    # Counted from the true start, though the start mark was missed.
    assert lidar is not None
    assert lidar.rmse_m < 0.05


def test_a_log_without_truth_has_nothing_to_compare_with(short_log: Path, tmp_path: Path) -> None:
    log = Log(short_log)
    writer = LogWriter(tmp_path / "bare.mcap", log.config_toml, log.start_ns)
    for record in log:
        if isinstance(record, RawChunk):
            writer.raw(record)
    writer.close()
    with pytest.raises(UserError, match=r"bare\.mcap: no truth in the log"):
        evaluate_scenario(tmp_path / "bare.mcap", 1)


def test_alignment_changes_the_trajectory_error_alone(walk: Path, result: Evaluation) -> None:
    plain = evaluate_scenario(walk, 3, choices=CHOICES)
    for name in CHOICES:
        aligned, unaligned = result.estimators[name], plain.estimators[name]
        assert aligned is not None
        assert unaligned is not None
        assert unaligned.ate_m == pytest.approx(unaligned.rmse_m)
        assert aligned.ate_m < unaligned.ate_m
        assert aligned.rmse_m == unaligned.rmse_m
    assert result.to_json()["alignment"] == "se2"


def test_the_nis_of_the_calibrated_filter_is_near_its_expectation(tmp_path: Path) -> None:
    # Steps of 1 cm and 0.3 deg between them: white noise, as the filter assumes.
    steps = "[increments]\nrate = 10\n[uwb]\nrate = 10\nnlos_least = 0\nnlos_mean = 0\n"
    found = evaluate_scenario(write_scenario(tmp_path, STRAIGHT_ON, steps), 4, choices=["ekf"])
    ekf = found.estimators["ekf"]
    assert ekf is not None
    assert ekf.nis is not None
    assert ekf.nis_bounds is not None
    # The gate cuts the tail off, which costs 3 % of the mean.
    assert 0.9 * ekf.nis_bounds[0] < ekf.nis < ekf.nis_bounds[1]


@pytest.mark.parametrize("workers", [1, 2])
def test_an_interrupt_keeps_the_trials_that_are_done(walk: Path, workers: int) -> None:
    ended: list[int] = []

    def interrupted() -> None:
        ended.append(1)
        if len(ended) == 2:
            raise KeyboardInterrupt

    found = evaluate_scenario(walk, 40, choices=["ekf"], workers=workers, on_trial=interrupted)
    assert found.interrupted
    assert 2 <= found.trials < 40
    whole = evaluate_scenario(walk, found.seeds[-1], choices=["ekf"])
    for seed in found.seeds:
        assert found.errors["ekf"][seed].error.tobytes() == whole.errors["ekf"][seed].error.tobytes()


def test_an_interrupt_before_any_trial_is_done_is_said(walk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: Any, **__: Any) -> dict[str, Any]:
        raise KeyboardInterrupt

    monkeypatch.setattr("companion.evaluation.run_trial", never)
    with pytest.raises(UserError, match="interrupted before the first trial was done"):
        evaluate_scenario(walk, 2, choices=["ekf"])


def test_a_trial_that_fails_ends_the_evaluation(walk: Path) -> None:
    with pytest.raises(ZeroDivisionError):
        run_trials(_fails_at_two, [1, 2, 3], workers=2)


def _fails_at_two(seed: int) -> float:
    return 1 / (seed - 2)


@pytest.mark.filterwarnings("ignore")
def test_a_cluster_of_two_workers_gives_identical_figures(walk: Path, result: Evaluation) -> None:
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:
        there = evaluate_scenario(
            walk, 3, choices=CHOICES, alignment=Alignment.SE2, scheduler=cluster.scheduler_address
        )
    assert without_times(there) == without_times(result)


@pytest.mark.filterwarnings("ignore")
def test_a_scheduler_that_is_not_there_is_named(walk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.trial_runner.CONNECT_TIMEOUT", 0.5)
    with pytest.raises(UserError, match=r"--scheduler tcp://127\.0\.0\.1:9: no Dask scheduler there"):
        evaluate_scenario(walk, 2, choices=["ekf"], scheduler="tcp://127.0.0.1:9")


def test_the_worst_trial_is_the_one_with_the_greatest_error(result: Evaluation) -> None:
    assert result.decisive == "ekf"
    rmse = {seed: float(np.sqrt((e.distance**2).mean())) for seed, e in result.errors["ekf"].items()}
    assert rmse[result.worst_seed()] == max(rmse.values())
    assert len(set(rmse.values())) == 3


def test_the_worst_trial_is_written_as_a_log_that_replays_to_the_same_error(tmp_path: Path) -> None:
    path = write_scenario(tmp_path, STRAIGHT_ON)
    found = evaluate_scenario(path, 1, seed=5, choices=["ekf"])
    log_path = write_worst_trial(found, path, tmp_path, [])
    assert log_path == tmp_path / "scenario_seed5.mcap"
    log = Log(log_path)
    replayed = replay(log, config_of(log, []), ["ekf"]).accuracy("ekf")
    assert replayed is not None
    ekf = found.estimators["ekf"]
    assert ekf is not None
    assert replayed.rmse == ekf.rmse_m


def test_where_there_are_no_bytes_no_log_is_written(walk: Path, result: Evaluation, tmp_path: Path) -> None:
    assert write_worst_trial(result, walk, tmp_path, []) is None
    assert not list(tmp_path.iterdir())


def test_the_picture_has_the_colours_of_every_estimator_in_all_panels(
    result: Evaluation, tmp_path: Path
) -> None:
    evaluation_figure(result, tmp_path / "new" / "picture.png")
    pixels = np.asarray(imread(tmp_path / "new" / "picture.png"), dtype=np.float64)[:, :, :3]
    assert pixels.shape == (1125, 1500, 3)
    for rgb in ((0, 114, 178), (204, 121, 167)):
        near = np.abs(pixels - np.array(rgb) / 255.0).max(axis=2) < 0.15
        for panel in (near[:550, :750], near[:550, 750:], near[550:1050, :750], near[550:1050, 750:]):
            assert panel.sum() > 50


def test_a_picture_that_cannot_be_written_is_the_users_error(result: Evaluation, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"cannot write the picture .*a\.png"):
        evaluation_figure(result, tmp_path / "file" / "a.png")


def test_markdown_has_a_cell_for_every_heading(result: Evaluation) -> None:
    text = markdown(result, ["a.png"])
    tables = [line for line in text.splitlines() if line.startswith("|")]
    widths = [line.count("|") for line in tables]
    assert sorted(set(widths)) == [10, 12]
    ekf = result.estimators["ekf"]
    assert ekf is not None
    assert f"| ekf | {ekf.rmse_m:.3f} |" in text
    assert "| 0.987 |" in text
    assert "![scenario](a.png)" in text
    assert "alignment se2" in text


def test_the_command_takes_several_sources_and_writes_one_report(
    walk: Path, short_log: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run-7"
    run.mkdir()
    (run / "raw.mcap").symlink_to(short_log)
    done = companion(
        *(walk, run, "--trials", "2", "--workers", "1", "--estimators", "ekf"),
        *("--out", "o", "--json", "o/f.json"),
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    first, second = json.loads((tmp_path / "o" / "f.json").read_text())
    assert (first["scenario"], first["trials"]) == ("scenario", 2)
    assert (second["scenario"], second["trials"]) == ("run-7", 1)
    report = (tmp_path / "o" / "report.md").read_text()
    assert report.index("## scenario: means of 2 trials") < report.index("## run-7: one trial")
    assert {p.name for p in (tmp_path / "o").iterdir()} == {
        "f.json",
        "report.md",
        "scenario.png",
        "run-7.png",
    }
    assert "…" not in done.stdout


def test_all_faults_of_the_library_come_in_one_table_after_the_trials_without(
    short_log: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ["drop:anchor=1,at=1", "gone:at=2,for=1"]
    monkeypatch.setattr(faults, "library", lambda _: names)
    done = command(
        *("evaluate", short_log, "--trials", "1", "--workers", "1", "--estimators", "ekf"),
        *("--fault", "library", "--out", tmp_path / "o", "--json", tmp_path / "f.json"),
    )
    assert done.returncode == 0, done.stderr
    table = [line.split() for line in done.stdout.splitlines() if line.startswith("  ")]
    table = table[2 : 3 + len(names)]
    assert [row[0] for row in table] == ["none", *names]
    figures = [each["estimators"]["ekf"] for each in json.loads((tmp_path / "f.json").read_text())]
    shown = [(f"{each['rmse_m']:.3f}", f"{100 * each['integrity']:.2f}") for each in figures]
    assert [(row[1], row[3]) for row in table] == shown
    assert (tmp_path / "o" / "report.md").read_text().count("| ekf |") == 1 + 2 * len(figures)


def test_what_one_would_not_fly_on_is_marked(result: Evaluation) -> None:
    ekf = result.estimators["ekf"]
    assert ekf is not None
    bad = replace(result, estimators={**result.estimators, "ekf": replace(ekf, integrity=0.0123)})
    good = replace(result, estimators={**result.estimators, "ekf": replace(ekf, integrity=0.01)})
    text = fault_markdown("walk", {"": good, "gone:at=1": bad})
    assert f"| gone:at=1 | {ekf.rmse_m:.3f} / -" not in text
    assert f"**{ekf.rmse_m:.3f} / 1.23**" in text
    assert f"| {ekf.rmse_m:.3f} / 1.00 |" in text


def test_a_site_that_is_no_scenario_is_refused(command: Command) -> None:
    done = command("evaluate", SITE, "--trials", "1")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
