"""Emulated devices and real drivers joined in memory, in simulated time."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from companion.log import Direction, LogWriter, RawChunk, Truth
from companion.pipeline import make_sensors
from companion.sim.devices import make_lines
from companion.sim.robot import OnRanging, Robot
from companion.sim.scenario import Scenario
from drivers.framing import Sensor
from estimators.messages import Scan

START_NS = 1_000_000_000
"""Host's monotonic time at which a simulation begins; not 0, as no real one is."""
STEP_NS = 4_000_000
"""Ports are read this often, about as a USB serial adapter hands bytes over."""
TRUTH_EVERY = 5
"""Steps from one true pose to the next in the log: 50 Hz."""


def converse(
    scenario: Scenario,
    sensors: Mapping[str, Sensor],
    on_ranging: OnRanging = lambda _stamp_ns, _excess: None,
) -> Iterator[RawChunk | Truth]:
    """Everything that crosses the ports while the robot walks, and the truth.

    The caller feeds the incoming chunks to `sensors`, whose dialogue this function carries out.

    Args:
        scenario: to run from `START_NS` until the walk is over.
        sensors: the drivers, by the site's sensor names.
        on_ranging: as `Robot` has it.
    """
    robot = Robot(scenario, on_ranging)
    lines = make_lines(robot, START_NS)
    open_ports: set[str] = set()
    step, now_ns = 0, START_NS
    # A LiDAR that never scans would leave the robot waiting: the walk begins without it.
    if not any(Scan in sensor.MEASURES for sensor in sensors.values()):
        robot.begin(now_ns)
    while not robot.arrived(now_ns):
        for name, line in lines.items():
            if not line.attached(now_ns):
                open_ports.discard(name)
                continue
            if name not in open_ports:
                open_ports.add(name)
                sensors[name].connected(now_ns)
            data = line.poll(now_ns)
            if data:
                yield RawChunk(name, Direction.IN, now_ns, data)
            request = sensors[name].poll(now_ns)
            if request:
                yield RawChunk(name, Direction.OUT, now_ns, request)
                line.feed(request, now_ns)
        if step % TRUTH_EVERY == 0:
            yield Truth(now_ns, robot.motion(now_ns).pose[0])
        step += 1
        now_ns += STEP_NS


def records(scenario: Scenario) -> Iterator[RawChunk | Truth]:
    """What the log of a scenario would hold, without writing one."""
    sensors = make_sensors(scenario.config)
    for item in converse(scenario, sensors):
        if isinstance(item, RawChunk) and item.direction is Direction.IN:
            sensors[item.source].feed(item.data, item.stamp_ns)
        yield item


def record(
    scenario: Scenario, sensors: Mapping[str, Sensor], writer: LogWriter, take: Callable[[RawChunk], None]
) -> Iterator[float]:
    """Carry a conversation out and log it; gives the share that is done, now and then, and closes the log.

    Args:
        scenario: to run.
        sensors: the drivers, by the site's sensor names.
        writer: gets everything before it is worked on.
        take: must feed the incoming chunks to `sensors`.
    """
    try:
        for item in converse(scenario, sensors):
            if isinstance(item, Truth):
                writer.truth(item)
                yield (item.stamp_ns - START_NS) * 1e-9 / scenario.trajectory.duration
            else:
                writer.raw(item)
                take(item)
    finally:
        writer.close()


def simulate(scenario: Scenario, path: Path) -> Iterator[float]:
    """Write the log of a run without estimators; gives the share that is done, now and then.

    Args:
        scenario: to run.
        path: log to write.

    Raises:
        UserError: the log cannot be written.
    """
    sensors = make_sensors(scenario.config)

    def take(chunk: RawChunk) -> None:
        if chunk.direction is Direction.IN:
            sensors[chunk.source].feed(chunk.data, chunk.stamp_ns)

    yield from record(scenario, sensors, LogWriter(path, scenario.config.to_toml(), START_NS), take)
