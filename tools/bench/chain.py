"""Rows of what comes after the decoders, and of the whole: the log of the demo's walk from bytes to poses."""

import atexit
from collections.abc import Callable
from functools import cache
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp

from companion.config import Config, load_config, params_dir
from companion.log import Direction, Log, RawChunk
from companion.replay import config_of, replay
from companion.sim.scenario import load_scenario
from companion.sim.simulate import simulate
from drivers import make_sensor
from estimators import make_estimator
from estimators.messages import Measurement, RangeFrame
from tools.bench.rows import Benchmark


def range_update_ekf() -> Benchmark:
    """All range frames through the filter."""
    return _range_update("ekf")


def range_update_least_squares() -> Benchmark:
    """All range frames through the estimator without memory."""
    return _range_update("least_squares")


def replay_real_time_factor() -> Benchmark:
    """The log through `ekf`: its duration over the time that this takes."""
    log = Log(demo_log())
    config = config_of(log, [])
    duration = replay(log, config, ["ekf"]).duration
    return Benchmark("x", "higher", duration, lambda: replay(log, config, ["ekf"]), needed=("real time", 1.0))


def _range_update(name: str) -> Benchmark:
    config = demo_config()
    frames = [m for m in measurements("uwb") if isinstance(m, RangeFrame)]

    def update() -> None:
        estimator = make_estimator(name, config.estimator_config(name), config.setup())
        for frame in frames:
            estimator.update(frame)

    return Benchmark("ms/frame", "lower", len(frames) / 1e3, update)


@cache
def demo_log() -> Path:
    """Log of the demo's walk, simulated once."""
    folder = Path(mkdtemp(prefix="bench-"))
    atexit.register(rmtree, folder)
    path = folder / "square_room.mcap"
    for _ in simulate(load_scenario(params_dir() / "scenarios" / "square_room.toml", 1, []), path):
        pass
    return path


@cache
def demo_config() -> Config:
    """Of the demo's site."""
    return load_config(params_dir() / "sites" / "demo_room.toml")


def measurements(source: str) -> list[Measurement]:
    """All that a sensor measured on the walk."""
    table = demo_config().sensor[source]
    sensor = make_sensor(table.driver, table.settings)
    return [
        measurement
        for record in Log(demo_log())
        if isinstance(record, RawChunk) and record.source == source and record.direction is Direction.IN
        for measurement in sensor.feed(record.data, record.stamp_ns)
    ]


BENCHMARKS: dict[str, Callable[[], Benchmark]] = {
    "range_update_ekf": range_update_ekf,
    "range_update_least_squares": range_update_least_squares,
    "replay_real_time_factor": replay_real_time_factor,
}
"""Name of the row -> what makes its benchmark."""
