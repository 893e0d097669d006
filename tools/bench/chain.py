"""Rows of what comes after the decoders, and of the whole: the log of the demo's walk from bytes to poses."""

import atexit
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from heapq import merge
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp

from pymavlink.dialects.v20 import all as mavlink2

from companion.config import Config, load_config
from companion.log import Direction, Log, RawChunk
from companion.log_edit.edit import write_log
from companion.mavlink.link import NAME
from companion.replay import config_of, replay
from companion.shipped_files import params_dir
from companion.sim.scenario import load_scenario
from companion.sim.simulate import START_NS, records, simulate
from drivers import make_sensor
from estimators import make_estimator
from estimators.messages import Measurement, RangeFrame
from tools.bench.rows import Benchmark

RANGE_RATE, IMU_RATE = 50.0, 100
"""Of the log with all sensors [Hz]; scans come at 10 Hz with 800 beams."""


def range_update_ekf() -> Benchmark:
    """All range frames through the filter."""
    return _range_update("ekf")


def range_update_least_squares() -> Benchmark:
    """All range frames through the estimator without memory."""
    return _range_update("least_squares")


def replay_real_time_factor() -> Benchmark:
    """A log of all sensors through `pf_ibas_graph`: its duration over the time that this takes."""
    return _real_time_factor("pf_ibas_graph")


def replay_real_time_factor_ekf() -> Benchmark:
    """The same through `ekf`."""
    return _real_time_factor("ekf")


def _real_time_factor(name: str) -> Benchmark:
    log = Log(full_log())
    config = config_of(log, [])
    duration = replay(log, config, [name]).duration
    return Benchmark(
        "x", "higher", duration, lambda: replay(log, config, [name]), needed=("real time, the target", 30.0)
    )


def _range_update(name: str) -> Benchmark:
    config = demo_config()
    frames = [m for m in measurements("uwb") if isinstance(m, RangeFrame)]

    def update() -> None:
        estimator = make_estimator(name, config.estimator_config(name), config.setup())
        for frame in frames:
            estimator.update(frame)

    return Benchmark("ms/frame", "lower", len(frames) / 1e3, update)


@cache
def _folder() -> Path:
    folder = Path(mkdtemp(prefix="bench-"))
    atexit.register(rmtree, folder)
    return folder


@cache
def demo_log() -> Path:
    """Log of the demo's walk, simulated once."""
    path = _folder() / "square_room.mcap"
    for _ in simulate(load_scenario(params_dir() / "scenarios" / "square_room.toml", 1, []), path):
        pass
    return path


@cache
def full_log() -> Path:
    """Log of the same walk with ranges as often as a tag can, and an autopilot's inertial sensor."""
    scenario = load_scenario(
        params_dir() / "scenarios" / "square_room.toml", 1, [f"mavlink.inputs.imu={IMU_RATE}"]
    )
    uwb = scenario.file.uwb.model_copy(update={"rate": RANGE_RATE})
    scenario = replace(scenario, file=scenario.file.model_copy(update={"uwb": uwb}))
    walk = list(records(scenario))
    path = _folder() / "full.mcap"
    both = merge(walk, _inertial(walk[-1].stamp_ns), key=lambda record: record.stamp_ns)
    write_log(path, scenario.config, START_NS, both)
    return path


def _inertial(end_ns: int) -> Iterator[RawChunk]:
    """What an autopilot at rest sends of its inertial sensor, one message a chunk."""
    packer = mavlink2.MAVLink(None, srcSystem=1, srcComponent=mavlink2.MAV_COMP_ID_AUTOPILOT1)
    autopilot = mavlink2.MAV_AUTOPILOT_ARDUPILOTMEGA
    beat = mavlink2.MAVLink_heartbeat_message(mavlink2.MAV_TYPE_QUADROTOR, autopilot, 0, 0, 0, 3)
    yield RawChunk(NAME, Direction.IN, START_NS, bytes(beat.pack(packer)))
    gravity, all_fields = -9.80665, 0x3F
    for stamp_ns in range(START_NS, end_ns, 1_000_000_000 // IMU_RATE):
        sample = mavlink2.MAVLink_highres_imu_message(
            stamp_ns // 1000, 0.0, 0.0, gravity, *(0.0,) * 10, all_fields
        )
        yield RawChunk(NAME, Direction.IN, stamp_ns, bytes(sample.pack(packer)))


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
    "replay_real_time_factor_ekf": replay_real_time_factor_ekf,
}
"""Name of the row -> what makes its benchmark."""
