"""Closures on the way from scans to estimators: a second round is closed on the first."""

from companion.config import Config, load_config
from companion.look_back import make_look_back
from companion.pipeline import make_parts
from estimators.base import Verdict
from estimators.lidar.scan_matching import ScanMatcher
from estimators.messages import LoopClosure
from tests.companion.second_round import drive
from tests.conftest import SITE


def test_a_second_round_is_closed_on_the_first() -> None:
    said: list[tuple[bool, list[Verdict]]] = []
    for tick in drive(170):
        for outcome in tick.outcomes:
            if isinstance(outcome.measurement, LoopClosure):
                closes = outcome.measurement.from_stamp_ns < outcome.measurement.stamp_ns
                verdicts = [outcome.reports[name].verdicts[0] for name in ("graph", "lidar_odometry")]
                said.append((closes, verdicts))
    assert sum(closes for closes, _ in said) >= 3
    assert {tuple(verdicts) for _, verdicts in said} == {(Verdict.ACCEPTED, Verdict.NOT_USED)}


def test_closures_are_only_looked_for_where_somebody_has_a_use_for_them() -> None:
    config: Config = load_config(SITE)
    matcher = ScanMatcher(config.scan_matcher, config.lidar_mounting())
    assert make_look_back(config, matcher, ["ekf", "pf"]) is None
    assert make_look_back(config, matcher, ["ekf", "graph"]) is not None
    assert make_parts(config, ["ekf"])[2] is None
    assert make_parts(config, ["ekf"], close_loops=True)[2] is not None
