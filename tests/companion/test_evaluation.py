"""Evaluation over trials: what is averaged, against what, and that processes change nothing."""

import json
import os
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.config import load_config
from companion.errors import UserError
from companion.evaluation import Evaluation, evaluate_scenario
from companion.evaluation_table import evaluation_notes
from companion.log import Log
from companion.replay import config_of, replay
from companion.shipped_files import params_dir
from companion.sim.scenario import load_scenario
from companion.trial import run_trial
from companion.trial_figures import TrialFigures
from tests.conftest import SITE, Command, write_log, write_scenario

STRAIGHT_ON = "[trajectory]\nwaypoints = [[1.5, 1.2], [3.5, 1.2]]\nlaps = 0\nrest = 1.0\n"
FEW = "[increments]\nrate = 10\n[uwb]\nrate = 10\n"
"""Few enough measurements for a trial in a tenth of a second."""
EXACT = (
    "[increments]\nrate = 10\nsigma_x = 1e-7\nsigma_y = 1e-7\nsigma_yaw_deg = 1e-6\n"
    "[uwb]\nrate = 10\nsigma = 1e-6\nnlos_least = 0\nnlos_mean = 0\ndropout = 0\n"
)
FIGURES = [
    "rmse_m",
    "rmse_x_m",
    "rmse_y_m",
    "max_m",
    "max_x_m",
    "max_y_m",
    "p95_m",
    "yaw_rmse_deg",
    "nees",
    "nees_bounds",
    "update_us",
    "bound_ratio",
    "ranges",
    "ate_m",
    "rpe_m",
    "rpe_deg",
    "nis",
    "nis_bounds",
    "availability",
    "first_fix_s",
    "integrity",
    "epoch_bound_ratio",
    "iterations",
    "legs",
]
ALL = ["uwb_ls", "lidar", "ekf"]


def without_times(result: Evaluation) -> dict[str, Any]:
    data = result.to_json()
    for figures in data["estimators"].values():
        del figures["update_us"]
    return data


def figures_of(path: Path, choice: str, seed: int = 1) -> TrialFigures:
    figures = run_trial(path, seed, [], [choice])[choice]
    assert figures is not None
    return figures


def test_the_json_has_the_layout_that_other_programs_rely_on(tmp_path: Path) -> None:
    data = evaluate_scenario(write_scenario(tmp_path, STRAIGHT_ON, FEW), 2, choices=ALL).to_json()
    assert list(data) == ["scenario", "trials", "estimators", "alignment"]
    assert (data["scenario"], data["trials"]) == ("scenario", 2)
    assert list(data["estimators"]) == ALL
    for figures in data["estimators"].values():
        assert list(figures) == FIGURES
        assert list(figures["update_us"]) == ["median", "p99"]
        assert 0.0 < figures["update_us"]["median"] <= figures["update_us"]["p99"]
        assert figures["nees_bounds"][0] < figures["nees_bounds"][1]
    assert data["estimators"]["uwb_ls"]["yaw_rmse_deg"] is None
    assert data["estimators"]["ekf"]["yaw_rmse_deg"] > 0.0
    json.dumps(data, allow_nan=False)


def test_figures_are_means_over_trials_with_consecutive_seeds(tmp_path: Path) -> None:
    path = write_scenario(tmp_path, STRAIGHT_ON, FEW)
    mean = evaluate_scenario(path, 3, seed=7, choices=["lidar"]).to_json()["estimators"]["lidar"]
    trials = [asdict(figures_of(path, "lidar", seed)) for seed in (7, 8, 9)]
    for name in FIGURES:
        unlike = ("nees_bounds", "nis_bounds", "update_us", "ranges", "legs")
        if name not in unlike and mean[name] is not None:
            assert mean[name] == pytest.approx(np.mean([trial[name] for trial in trials])), name
    assert len({trial["rmse_m"] for trial in trials}) == 3


def test_seed_and_choices_alone_decide_the_figures(tmp_path: Path) -> None:
    path = write_scenario(tmp_path, STRAIGHT_ON, FEW)
    here = evaluate_scenario(path, 2, choices=ALL)
    elsewhere = evaluate_scenario(path, 2, choices=ALL, workers=2)
    assert without_times(here) == without_times(elsewhere)
    other_seed = evaluate_scenario(path, 2, seed=50, choices=ALL)
    assert without_times(other_seed) != without_times(here)
    alone = evaluate_scenario(path, 2, choices=["ekf", "ekf"])
    assert without_times(alone)["estimators"] == {"ekf": without_times(here)["estimators"]["ekf"]}


def test_every_trial_is_told_of(tmp_path: Path) -> None:
    ended: list[int] = []
    evaluate_scenario(
        write_scenario(tmp_path, STRAIGHT_ON, FEW), 3, choices=["lidar"], on_trial=lambda: ended.append(1)
    )
    assert len(ended) == 3


def test_exact_measurements_leave_no_error(tmp_path: Path) -> None:
    path = write_scenario(tmp_path, STRAIGHT_ON, EXACT)
    tag_off_the_origin = 0.1
    # Ranges say where the tag is, not the body's origin 0.1 m before it.
    assert figures_of(path, "uwb_ls").max_m == pytest.approx(tag_off_the_origin, abs=1e-4)
    # The start is off by centimetres, yet `lidar` counts from where the robot really stands.
    assert figures_of(path, "lidar").max_m < 1e-4
    assert figures_of(path, "lidar_odometry").max_m > 1e-3


def test_errors_along_the_axes_make_up_the_whole(tmp_path: Path) -> None:
    f = figures_of(write_scenario(tmp_path, STRAIGHT_ON, FEW), "uwb_ls")
    assert f.rmse_m == pytest.approx(np.hypot(f.rmse_x_m, f.rmse_y_m))
    assert max(f.max_x_m, f.max_y_m) <= f.max_m <= np.hypot(f.max_x_m, f.max_y_m)
    assert f.rmse_m < f.p95_m < f.max_m


def test_an_honest_dead_reckoning_keeps_the_bounds(tmp_path: Path) -> None:
    path = write_scenario(tmp_path, STRAIGHT_ON, FEW + "nlos_mean = 0.1\n")
    figures = evaluate_scenario(path, 30, choices=["lidar"]).estimators["lidar"]
    assert figures is not None
    assert figures.nees_bounds[0] < figures.nees < figures.nees_bounds[1]


def test_no_estimator_without_a_motion_model_beats_the_bound(tmp_path: Path) -> None:
    path = write_scenario(tmp_path, STRAIGHT_ON, FEW)
    result = evaluate_scenario(path, 5, choices=["uwb_ls"])
    figures = result.estimators["uwb_ls"]
    assert figures is not None
    assert figures.bound_ratio is not None
    assert figures.bound_ratio > 1.5


def test_the_bound_leaves_blocked_ranges_out_and_counts_landmarks(tmp_path: Path) -> None:
    def bound(more: str) -> float:
        f = figures_of(write_scenario(tmp_path, STRAIGHT_ON, more), "lidar")
        assert f.bound_ratio is not None
        return f.rmse_m / f.bound_ratio

    poor = "[increments]\nrate = 10\nsigma_x = 0.1\nsigma_y = 0.1\nsigma_yaw_deg = 3\n[uwb]\nrate = 10\n"
    fence = "[[world.boxes]]\ncentre = [4.0, 2.2]\nsize = [7.9, 0.1]\nheight = 3.0\n"
    landmarks = "[landmarks]\npositions = [[1.0, 5.0], [6.0, 5.0]]\nrate = 10\n"
    # The fence hides two of four anchors, those that see the robot across its way.
    assert bound(poor + fence) > 1.2 * bound(poor)
    assert bound(poor + landmarks) < 0.5 * bound(poor)


def test_without_blocked_ranges_least_squares_reaches_the_bound_of_its_frames(tmp_path: Path) -> None:
    free = "[increments]\nrate = 10\n[uwb]\nrate = 10\nsigma = 0.05\ndropout = 0\n"
    # Here no anchor hides behind the column.
    sets = ["anchors.2=[7.85, 4.0, 2.3]"]
    result = evaluate_scenario(
        write_scenario(tmp_path, STRAIGHT_ON, free), 6, choices=["uwb_ls", "ekf"], sets=sets
    )
    alone, fused = result.estimators["uwb_ls"], result.estimators["ekf"]
    assert alone is not None
    assert fused is not None
    assert alone.epoch_bound_ratio is not None
    assert fused.epoch_bound_ratio is not None
    # The antenna is 0.1 m off the body's origin, which least squares takes for it.
    tag_error = np.sqrt(alone.rmse_m**2 - 0.1**2)
    assert tag_error / (alone.rmse_m / alone.epoch_bound_ratio) == pytest.approx(1.0, abs=0.1)
    assert fused.epoch_bound_ratio < 1.0


@pytest.mark.parametrize(
    ("heights", "told"),
    [((2.0, 2.0, 2.0, 2.0), "height unobservable"), ((0.2, 2.6, 0.3, 2.6), "height from ranges at 9")],
)
def test_what_ranges_tell_of_the_height_is_told(
    tmp_path: Path, heights: tuple[float, ...], told: str
) -> None:
    places = load_config(SITE).anchors.items()
    sets = [f"anchors.{i}=[{x},{y},{z}]" for (i, (x, y, _)), z in zip(places, heights, strict=True)]
    path = write_scenario(tmp_path, STRAIGHT_ON, FEW)
    result = evaluate_scenario(path, 1, choices=["momentum_gd:3", "momentum_gd:2"], sets=sets)
    (note,) = [line for line in evaluation_notes(result) if "height" in line]
    assert note.startswith(f"momentum_gd:3: {told}")


def test_what_is_measured_between_steps_counts(tmp_path: Path) -> None:
    def bound(rate: int, landmarks: str = "") -> float:
        more = f"[increments]\nrate = 10\n[uwb]\nrate = {rate}\n{landmarks}"
        f = figures_of(write_scenario(tmp_path, STRAIGHT_ON, more), "lidar")
        assert f.bound_ratio is not None
        return f.rmse_m / f.bound_ratio

    # Five times as many ranges, and the little that increments forget: less than half the error.
    assert 0.4 * bound(10) < bound(50) < 0.8 * bound(10)
    assert bound(10, "[landmarks]\npositions = [[1, 5]]\nrate = 3\n") < bound(10)


@pytest.mark.parametrize(
    "more",
    [
        "[increments]\nrate = 10\n[uwb]\nrate = 10\nsigma = 0\n",
        "[increments]\nrate = 10\n[uwb]\nrate = 10\n[[kidnap]]\nat = 2.0\nx = [1.2, 6.8]\ny = [1.2, 5.8]\n",
    ],
    ids=["no noise", "carried off"],
)
def test_a_bound_that_is_not_known_is_null(tmp_path: Path, more: str) -> None:
    assert figures_of(write_scenario(tmp_path, STRAIGHT_ON, more), "lidar").bound_ratio is None


def test_an_ordinary_scenario_goes_through_the_whole_chain_as_in_a_replay(tmp_path: Path) -> None:
    path = write_scenario(tmp_path, STRAIGHT_ON)
    log = Log(write_log(load_scenario(path, 4, []), tmp_path / "raw.mcap"))
    replayed = replay(log, config_of(log, []), ["ekf", "least_squares"])
    trial = run_trial(path, 4, [], ["ekf", "uwb_ls", "lidar"])
    for choice, name in (("ekf", "ekf"), ("uwb_ls", "least_squares")):
        accuracy, figures = replayed.accuracy(name), trial[choice]
        assert accuracy is not None
        assert figures is not None
        assert figures.rmse_m == accuracy.rmse
        assert figures.nees == accuracy.nees
        assert figures.availability == accuracy.availability
        assert figures.bound_ratio is None
    lidar = trial["lidar"]
    assert lidar is not None
    assert lidar.rmse_m < 0.05


UNKNOWN = ["start.known=false"]


def test_a_pose_that_had_to_be_found_is_told_of_with_the_time_it_took(tmp_path: Path) -> None:
    path = write_scenario(tmp_path, more=FEW)
    result = evaluate_scenario(path, 2, choices=["ekf", "uwb_ls"], sets=UNKNOWN)
    assert all(0.5 < seconds < 5.0 for seconds in result.settled["ekf"])
    assert result.to_json()["settled"] == {
        "ekf": {"within_5_s": 2, "median_s": pytest.approx(np.median(result.settled["ekf"]))},
        "uwb_ls": {"within_5_s": 0, "median_s": None},
    }
    figures = result.estimators["ekf"]
    assert figures is not None
    assert figures.bound_ratio is None
    assert figures.rmse_m < 0.15
    assert any(note.startswith("ekf: within 0.3 m and 10 deg") for note in evaluation_notes(result))
    assert "uwb_ls: within 0.3 m and 10 deg to the end never" in " ".join(evaluation_notes(result))
    assert evaluate_scenario(path, 1, choices=["ekf"]).settled == {}


def test_time_to_be_found_counts_from_the_kidnapping(tmp_path: Path) -> None:
    kidnap = "[[kidnap]]\nat = 3.0\nto = [4.0, 4.0, 90.0]\n"
    path = write_scenario(tmp_path, more=kidnap + FEW)
    found = run_trial(path, 1, [], ["ekf"])["ekf"]
    given_up = run_trial(path, 1, ["relocation.enabled=false"], ["ekf"])["ekf"]
    assert found is not None
    assert found.settled_s is not None
    assert given_up is not None
    assert given_up.settled_s is not None
    assert 0.5 < found.settled_s < 5.0
    assert given_up.settled_s > 5.0


def test_an_unknown_start_is_found_through_the_whole_chain(tmp_path: Path) -> None:
    figures = run_trial(write_scenario(tmp_path), 2, UNKNOWN, ["ekf"])["ekf"]
    assert figures is not None
    assert figures.settled_s is not None
    assert figures.settled_s < 5.0
    assert 0.4 < figures.availability < 0.95
    assert figures.rmse_m < 0.15


def test_an_estimator_without_any_pose_has_no_figures(tmp_path: Path) -> None:
    site = tmp_path / "no_lidar.toml"
    text = SITE.read_text(encoding="utf-8")
    site.write_text(text[: text.index("[sensor.lidar]")], encoding="utf-8")
    path = write_scenario(tmp_path, STRAIGHT_ON)
    path.write_text(path.read_text(encoding="utf-8").replace(str(SITE), str(site)), encoding="utf-8")
    result = evaluate_scenario(path, 1, choices=["uwb_ls", "lidar"])
    assert result.to_json()["estimators"]["lidar"] is None
    assert result.availability["lidar"] == 0.0
    assert result.estimators["uwb_ls"] is not None


@pytest.mark.parametrize(
    ("choices", "said"),
    [
        (["magic"], r"--estimators: unknown estimator 'magic', there are: uwb_ls, lidar, ekf, "),
        (["ekf", "ekf:5"], r"--estimators ekf:5: ekf takes no parameter, got '5'"),
        (["lidar:5"], r"--estimators lidar:5: lidar takes no parameter, got '5'"),
        ([""], r"--estimators: unknown estimator ''"),
    ],
)
def test_wrong_choices_are_refused_before_any_trial(tmp_path: Path, choices: list[str], said: str) -> None:
    ended: list[int] = []
    with pytest.raises(UserError, match=said):
        evaluate_scenario(
            write_scenario(tmp_path, STRAIGHT_ON, FEW), 1, choices=choices, on_trial=lambda: ended.append(1)
        )
    assert not ended


def test_the_calibrated_scenario_errs_like_the_papers_sensors() -> None:
    """A few trials of the calibration that the scenario file states; the LiDAR scatters too much for them."""
    path = params_dir() / "scenarios" / "huang2024.toml"
    result = evaluate_scenario(path, 4, choices=["uwb_ls"])
    uwb = result.estimators["uwb_ls"]
    assert uwb is not None
    assert result.paper is not None
    paper = result.paper.estimators["uwb_ls"]
    assert uwb.rmse_m == pytest.approx(paper.rmse_m, rel=0.1)
    assert uwb.rmse_x_m == pytest.approx(paper.rmse_x_m, rel=0.15)
    assert uwb.rmse_y_m == pytest.approx(paper.rmse_y_m, rel=0.15)


def companion(*arguments: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "companion", "evaluate", *map(str, arguments)]
    environment = {**os.environ, "COLUMNS": "100", "PYTHONPATH": os.getcwd()}
    return subprocess.run(
        command, cwd=cwd, env=environment, text=True, capture_output=True, timeout=100, check=False
    )


PAPER = '[paper]\nsource = "somebody2020, Table 9"\n[paper.estimators]\nekf = { rmse_x_m = 0.987 }\n'


def test_the_command_prints_our_figures_and_the_papers(tmp_path: Path) -> None:
    path = write_scenario(tmp_path, STRAIGHT_ON, FEW + PAPER)
    options = ["--estimators", "ekf,lidar", "--workers", "2", "--json", "out.json"]
    done = companion(path, "--trials", "2", *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    figures = json.loads((tmp_path / "out.json").read_text())["estimators"]
    assert list(figures) == ["ekf", "lidar"]
    errors, _ = done.stdout.split("RPE", 1)
    rows = {line.split()[0]: line.split()[1:] for line in errors.splitlines() if line.strip()}
    for i, name in enumerate(["rmse_m", "rmse_x_m", "rmse_y_m", "max_m", "max_x_m", "max_y_m"]):
        assert rows["ekf"][i] == f"{figures['ekf'][name]:.3f}"
    assert rows["paper"] == ["0.987"]
    assert "paper: somebody2020, Table 9" in done.stdout
    assert "…" not in done.stdout


def test_options_may_come_first(tmp_path: Path, command: Command) -> None:
    path = write_scenario(tmp_path, STRAIGHT_ON, FEW)
    done = command("evaluate", "--trials", "1", "--workers", "1", "--estimators", "lidar", path)
    assert done.returncode == 0, done.stderr
    assert "scenario: one trial" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["FILE", "--estimators", "magic"], "--estimators: unknown estimator 'magic'"),
        (["FILE", "--json", "gone/out.json"], "cannot write gone/out.json: there is no folder gone"),
    ],
)
def test_bad_input_gives_one_line_and_exit_code_2(
    tmp_path: Path, command: Command, arguments: list[str], said: str
) -> None:
    path = write_scenario(tmp_path, STRAIGHT_ON, FEW)
    done = command("evaluate", *(str(path) if word == "FILE" else word for word in arguments))
    assert done.returncode == 2
    assert done.stdout == ""
    assert said in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_scenario_without_bytes_is_refused_where_bytes_are_needed(tmp_path: Path, command: Command) -> None:
    done = command("simulate", write_scenario(tmp_path, STRAIGHT_ON, FEW), "--out", "x")
    assert done.returncode == 2
    assert "a scenario with [increments] has no bytes" in done.stderr
    assert not (tmp_path / "x").exists()
