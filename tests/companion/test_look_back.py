"""Closures on the way from scans to estimators: a second round is closed on the first."""

import numpy as np

from companion.config import Config, load_config
from companion.look_back import LookBack, make_look_back
from companion.pipeline import Pipeline, make_parts
from estimators.base import Estimator, Setup, Start, Verdict
from estimators.graph.smoother import GraphSmoother
from estimators.lidar.loop_closure import LoopCloser
from estimators.lidar.odometry import LidarOdometry
from estimators.lidar.scan_matching import ScanMatcher
from estimators.messages import LoopClosure
from tests.conftest import SITE
from tests.estimators.lidar.room_scans import PERIOD, ROOM, Loop, scan_while_moving


def test_a_second_round_is_closed_on_the_first() -> None:
    path, rng = Loop(speed=1.5), np.random.default_rng(1)
    start = Start(path.poses(np.array([PERIOD]))[0], np.array([0.01, 0.01, 0.01]))
    setup = Setup({}, np.zeros(3), start, height=0.3, height_sigma=0.02, level_sigma=0.02)
    matcher = ScanMatcher(ScanMatcher.Config(), np.zeros(3))
    estimators: dict[str, Estimator] = {
        "graph": GraphSmoother(GraphSmoother.Config(nlos=()), setup),
        "lidar_odometry": LidarOdometry(LidarOdometry.Config(), setup),
    }
    pipeline = Pipeline(matcher, estimators, LookBack(LoopCloser.Config(), matcher))
    said: list[tuple[bool, list[Verdict]]] = []
    for k in range(170):
        for outcome in pipeline.step(scan_while_moving(ROOM, path, k * PERIOD, rng, 0.015)):
            if isinstance(outcome.measurement, LoopClosure):
                closes = outcome.measurement.from_stamp_ns < outcome.measurement.stamp_ns
                verdicts = [outcome.reports[name].verdicts[0] for name in estimators]
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
