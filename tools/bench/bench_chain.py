"""Hot paths and the whole replay, timed.

Install with `pip install -e .[test,bench]`, run with `pytest tools/bench/bench_chain.py`. pytest-benchmark
prints the table and compares runs of one machine (`--benchmark-save`, `--benchmark-compare`). Absolute times
differ between machines; no test asserts one.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.config import Config, load_config, params_dir
from companion.log import Direction, Log, RawChunk
from companion.replay import config_of, replay
from companion.sim.scenario import load_scenario
from companion.sim.simulate import simulate
from drivers import make_sensor
from estimators import make_estimator
from estimators.lidar.scan_matching import ScanMatcher
from estimators.messages import Measurement, RangeFrame, Scan

Benchmark = Callable[..., Any]


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Log of the demo's walk."""
    path = tmp_path_factory.mktemp("bench") / "room.mcap"
    for _ in simulate(load_scenario(params_dir() / "scenarios" / "square_room.toml", 1, []), path):
        pass
    return path


@pytest.fixture(scope="session")
def config() -> Config:
    """Configuration of the demo room."""
    return load_config(params_dir() / "sites" / "demo_room.toml")


def chunks(log: Path, source: str) -> list[RawChunk]:
    """What one sensor sent."""
    records = [r for r in Log(log) if isinstance(r, RawChunk)]
    return [r for r in records if r.source == source and r.direction is Direction.IN]


def decode(config: Config, source: str, data: list[RawChunk]) -> list[Measurement]:
    """All measurements of a sensor."""
    table = config.sensor[source]
    sensor = make_sensor(table.driver, table.settings)
    return [m for chunk in data for m in sensor.feed(chunk.data, chunk.stamp_ns)]


@pytest.mark.parametrize("source", ["uwb", "lidar"])
def test_decode(benchmark: Benchmark, log: Path, config: Config, source: str) -> None:
    """All bytes of one sensor to measurements."""
    data = chunks(log, source)
    assert benchmark(decode, config, source, data)


def test_scan_matcher(benchmark: Benchmark, log: Path, config: Config) -> None:
    """A hundred scans of a walking robot."""
    scans = [m for m in decode(config, "lidar", chunks(log, "lidar")) if isinstance(m, Scan)][50:150]

    def match() -> ScanMatcher:
        matcher = ScanMatcher(config.scan_matcher, config.lidar_mounting())
        for scan in scans:
            matcher.update(scan)
        return matcher

    assert benchmark(match).refused == 0


@pytest.mark.parametrize("name", ["ekf", "least_squares"])
def test_range_update(benchmark: Benchmark, log: Path, config: Config, name: str) -> None:
    """All range frames through one estimator."""
    frames = [m for m in decode(config, "uwb", chunks(log, "uwb")) if isinstance(m, RangeFrame)]

    def update() -> None:
        estimator = make_estimator(name, config.estimator_config(name), config.setup())
        for frame in frames:
            estimator.update(frame)

    benchmark(update)


def test_replay(benchmark: Benchmark, log: Path) -> None:
    """The demo's log, bytes to poses; its duration over this time is the speed of replay."""
    opened = Log(log)
    result = benchmark(replay, opened, config_of(opened, []), ["ekf"])
    assert np.isfinite(result.accuracy("ekf").rmse)
