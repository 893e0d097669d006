"""Counting what became of blocked and of clean ranges, and knowing which is which."""

import csv
import io
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from companion.errors import UserError
from companion.evaluation import evaluate_scenario
from companion.evaluation_table import evaluation_notes
from companion.range_log import HEADER, range_lines
from companion.range_score import RangeScore, TrueExcess, pooled
from companion.sim.scenario import load_scenario
from companion.trial import run_trial
from estimators.base import Report, Verdict
from tests.conftest import write_scenario
from tests.strategies import range_frame

WALK = "[trajectory]\nwaypoints = [[1.5, 1.2], [3.5, 1.2]]\nlaps = 0\nrest = 1.0\n"
INCREMENTS = "[increments]\nrate = 10\n"
BLOCKED = "[[nlos]]\nanchors = 2\nat = [1.0, 2.0]\nduration = 2.0\n"
EXCESS = "[uwb]\nnlos_least = 0.5\nnlos_mean = 0.0\ndropout = 0.0\n"


def test_ranges_are_counted_by_their_true_excess() -> None:
    score = RangeScore()
    excess = np.array([0.0, 0.0, 0.4, 0.4, 0.29, np.nan, 0.0, 0.4])
    verdicts = [Verdict.ACCEPTED, Verdict.GATED, Verdict.TOO_LONG, Verdict.DOWNWEIGHTED]
    verdicts += [Verdict.SUSPECT, Verdict.SUSPECT, Verdict.LATE, Verdict.IMPOSSIBLE]
    score.note(excess, 0.1, Report(tuple(verdicts)))
    assert asdict(score) == {
        "biased": 2,
        "biased_rejected": 1,
        "biased_downweighted": 1,
        "clean": 2,
        "clean_rejected": 1,
        "clean_downweighted": 0,
    }


def test_shares_are_those_of_all_trials_together_and_a_share_of_nothing_is_none() -> None:
    shares = pooled([RangeScore(clean=1, clean_rejected=1), RangeScore(clean=3)])
    assert (shares["clean"], shares["clean_rejected"], shares["clean_downweighted"]) == (4, 0.25, 0.0)
    assert (shares["biased"], shares["biased_rejected"]) == (0, None)


def test_a_frame_finds_its_excess_by_the_nearest_stamp() -> None:
    truth = TrueExcess(period=0.04)
    assert np.isnan(truth.of(range_frame(0, [1], [2.0]))).all()
    for k in range(3):
        truth.note(k * 40_000_000, {1: 0.1 * k, 2: 0.0})
    assert truth.of(range_frame(41_000_000, [2, 1], [2.0, 2.0])).tolist() == [0.0, 0.1]
    assert truth.of(range_frame(79_000_000, [1], [2.0])).tolist() == [0.2]
    assert np.isnan(truth.of(range_frame(101_000_000, [1], [2.0])))[0]
    assert np.isnan(truth.of(range_frame(0, [9], [2.0])))[0]


def test_a_line_for_every_range_holds_its_verdict() -> None:
    frame = range_frame(5, [1, 2], [2.5, np.nan])
    told = Report((Verdict.TOO_LONG, Verdict.IMPOSSIBLE), np.array([0.4, np.nan]), np.array([9.5, np.nan]))
    rows = list(csv.DictReader(io.StringIO(HEADER + range_lines(frame, told))))
    assert rows[0] == {
        "stamp_ns": "5",
        "anchor": "1",
        "range_m": "2.500",
        "residual_m": "0.4000",
        "nis": "9.500",
        "verdict": "NLOS: longer than predicted",
    }
    assert rows[1]["verdict"] == "impossible"
    (untold, _) = csv.DictReader(io.StringIO(HEADER + range_lines(frame, Report(told.verdicts))))
    assert (untold["residual_m"], untold["nis"]) == ("", "")


@pytest.mark.parametrize("kind", [INCREMENTS, ""], ids=["measurements", "bytes"])
def test_blocked_anchors_are_refused_and_counted_with_and_without_bytes(tmp_path: Path, kind: str) -> None:
    path = write_scenario(tmp_path, WALK + kind + EXCESS + BLOCKED)
    figures = run_trial(path, 3, [], ["ekf"])["ekf"]
    assert figures is not None
    assert figures.ranges is not None
    # Two anchors for two seconds at 25 Hz, and what stands in the room.
    assert figures.ranges.biased >= 98
    assert figures.ranges.biased_rejected > 0.9 * figures.ranges.biased
    assert figures.ranges.clean > 300
    assert figures.ranges.clean_rejected < 0.03 * figures.ranges.clean


def test_other_anchors_are_blocked_in_every_trial_at_once_and_in_time(tmp_path: Path) -> None:
    path = write_scenario(tmp_path, WALK + INCREMENTS + BLOCKED)
    tag = np.array([1.5, 1.2, 0.5])
    hidden = set()
    for seed in range(20):
        scenario = load_scenario(path, seed, [])
        (blockade,) = scenario.blockades
        assert 1.0 <= blockade.begin <= 2.0
        assert blockade.end == pytest.approx(blockade.begin + 2.0)
        free = scenario.world.line_of_sight(tag, np.array(list(scenario.config.anchors.values())))
        for seconds, blocked in ((0.99, False), (blockade.begin, True), (blockade.end, False)):
            seen = scenario.sees(tag, seconds)
            assert (seen == (free & ~blockade.blocked if blocked else free)).all()
        assert blockade.blocked.sum() == 2
        hidden.add(tuple(blockade.blocked))
    assert len(hidden) > 3


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("[[nlos]]\nanchors = 9\nat = [1, 2]\n", r"nlos\.0\.anchors: the site has 4 anchors, got 9"),
        ("[[nlos]]\nanchors = 1\nat = [3, 2]\n", r"nlos\.0: at: earliest 3 is above latest 2"),
    ],
)
def test_a_blockade_that_cannot_be_is_the_users_error(tmp_path: Path, table: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        load_scenario(write_scenario(tmp_path, WALK + INCREMENTS + table), 1, [])


def test_the_notes_say_what_became_of_blocked_and_clean_ranges(tmp_path: Path) -> None:
    path = write_scenario(tmp_path, WALK + INCREMENTS + EXCESS + BLOCKED)
    sets = ['estimator.ekf.nlos=["robust"]']
    (note,) = [n for n in evaluation_notes(evaluate_scenario(path, 1, 1, ["ekf"], sets)) if "3 sigma" in n]
    assert "0.0% rejected" in note
    assert "down-weighted" in note
    clean = write_scenario(tmp_path, WALK + INCREMENTS)
    assert not [n for n in evaluation_notes(evaluate_scenario(clean, 1, 1, ["lidar"])) if "3 sigma" in n]
