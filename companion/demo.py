"""The whole chain in memory: devices, drivers, estimator, MAVLink, log, replay, comparison with truth."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from companion.log import Direction, Log, LogWriter, RawChunk
from companion.mavlink.link import NAME as MAVLINK
from companion.mavlink.pose_out import to_ned
from companion.mavlink.session import MavlinkSession
from companion.pipeline import Chain, Tick, make_pipeline
from companion.plots import figure
from companion.replay import Replay, config_of, replay, write_outputs
from companion.run_folder import RAW_LOG
from companion.sim.autopilot import EmulatedAutopilot
from companion.sim.scenario import Scenario
from companion.sim.simulate import START_NS, record
from companion.view.files import RerunFiles
from estimators.immutable import immutable

ESTIMATORS_COMPARED = ("ekf", "least_squares", "lidar_odometry")

Progress = Callable[[str, float], None]
"""Takes the name of a stage and the share of it that is done."""


@immutable
class Received:
    """What arrived at the emulated autopilot.

    Attributes:
        poses: VISION_POSITION_ESTIMATE messages.
        rate: of them [Hz].
        heartbeats: of our component.
        replay_difference: largest distance [m] between a received pose and the replay's at its time.
        all_positive_definite: whether every received covariance was.
    """

    poses: int
    rate: float
    heartbeats: int
    replay_difference: float
    all_positive_definite: bool


def run_demo(scenario: Scenario, folder: Path, progress: Progress) -> tuple[Replay, Received]:
    """Run a scenario through everything and leave a run folder.

    Args:
        scenario: to run.
        folder: gets `raw.mcap`, `poses*.tum`, `summary.json`, `config.toml`, `replay.rrd`, `demo.png`.
        progress: told how far each stage is.

    Raises:
        UserError: the folder cannot be written.
    """
    autopilot = EmulatedAutopilot()
    path = folder / RAW_LOG
    for share in _fly(scenario, path, autopilot):
        progress("walk", share)
    progress("walk", 1.0)

    log = Log(path)
    config = config_of(log, [])
    names = [config.pipeline.estimator]
    names += [name for name in ESTIMATORS_COMPARED if name not in names]
    view = RerunFiles(config, names, folder / "replay.rrd", log.start_ns)
    result = replay(log, config, names, view.tick, lambda share: progress("replay", share), view.chunk)
    progress("replay", 1.0)
    progress("pictures", 0.0)
    view.close()
    write_outputs(result, folder)
    title = f"{config.site.name}: {scenario.name}, seed {scenario.seed}"
    figure(result, folder / "demo.png", title, scenario.world.segments)
    progress("pictures", 1.0)
    return result, _received(autopilot, result)


def _fly(scenario: Scenario, path: Path, autopilot: EmulatedAutopilot) -> Iterator[float]:
    """The live loop in simulated time; gives the share of the walk that is done."""
    config = scenario.config
    primary = config.pipeline.estimator
    chain = Chain(config, START_NS, make_pipeline(config, [primary]), primary)
    session = MavlinkSession(config)
    writer = LogWriter(path, config.to_toml(), START_NS)

    def give_out(tick: Tick) -> None:
        heard = autopilot.poll(tick.stamp_ns)
        if heard:
            writer.raw(RawChunk(MAVLINK, Direction.IN, tick.stamp_ns, heard))
            session.receive(MAVLINK, heard, tick.stamp_ns, tick.stamp_ns)
        session.tick(tick.poses[primary], tick.health, tick.stamp_ns)
        if data := session.take().get(MAVLINK):
            writer.raw(RawChunk(MAVLINK, Direction.OUT, tick.stamp_ns, data))
            autopilot.feed(data)

    def take(chunk: RawChunk) -> None:
        for tick in chain.feed(chunk):
            give_out(tick)

    return record(scenario, chain.sensors, writer, take)


def _received(autopilot: EmulatedAutopilot, result: Replay) -> Received:
    heading = result.config.map_heading()
    replayed = {pose.stamp_ns // 1000: pose for pose in result.poses[result.names[0]]}
    differences = [
        np.linalg.norm(ned.position - to_ned(replayed[usec], heading).position)
        for usec, ned in autopilot.poses
    ]
    usecs = [usec for usec, _ in autopilot.poses]
    span = (usecs[-1] - usecs[0]) * 1e-6 if len(usecs) > 1 else 0.0
    return Received(
        poses=len(usecs),
        rate=(len(usecs) - 1) / span if span else 0.0,
        heartbeats=autopilot.heartbeats,
        replay_difference=float(max(differences, default=np.nan)),
        all_positive_definite=all(np.linalg.eigvalsh(ned.cov)[0] > 0.0 for _, ned in autopilot.poses),
    )
