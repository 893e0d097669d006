"""A robot that goes round a room again by scans alone: what it sees, and the closures on the first."""

from collections.abc import Iterator

import numpy as np

from companion.health import Health, State
from companion.look_back import LookBack
from companion.pipeline import Pipeline, Tick
from estimators.base import Estimator, Setup, Start
from estimators.graph.smoother import GraphSmoother
from estimators.lidar.loop_closure import LoopCloser
from estimators.lidar.odometry import LidarOdometry
from estimators.lidar.scan_matching import ScanMatcher
from tests.estimators.lidar.room_scans import PERIOD, ROOM, Loop, scan_while_moving

PERIOD_NS = round(PERIOD * 1e9)
PATH = Loop(speed=1.5)


def drive(scans: int) -> Iterator[Tick]:
    """A tick after each scan, by a smoother that closes loops and by odometry that does not."""
    rng = np.random.default_rng(1)
    start = Start(PATH.poses(np.array([PERIOD]))[0], np.array([0.01, 0.01, 0.01]))
    setup = Setup({}, np.zeros(3), start, height=0.3, height_sigma=0.02, level_sigma=0.02)
    matcher = ScanMatcher(ScanMatcher.Config(), np.zeros(3))
    estimators: dict[str, Estimator] = {
        "graph": GraphSmoother(GraphSmoother.Config(nlos=()), setup),
        "lidar_odometry": LidarOdometry(LidarOdometry.Config(), setup),
    }
    pipeline = Pipeline(matcher, estimators, LookBack(LoopCloser.Config(), matcher))
    for k in range(scans):
        outcomes = pipeline.step(scan_while_moving(ROOM, PATH, k * PERIOD, rng, 0.015))
        stamp_ns = (k + 1) * PERIOD_NS
        yield Tick(stamp_ns, outcomes, pipeline.poses_at(stamp_ns), Health(State.OK, ""))
