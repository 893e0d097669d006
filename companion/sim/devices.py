"""An emulated device for every sensor of a site, each on its line.

Like the drivers they are free of I/O and clocks: requests go in through `feed`, `poll` gives the bytes that
have reached the host by now. One object serves a pseudo-terminal in real time and a simulation in memory.
"""

from companion.sim.lidar_device import RplidarDevice
from companion.sim.line import Device, Line
from companion.sim.robot import Robot
from companion.sim.uwb_device import LinkTrackDevice


def make_lines(robot: Robot, now_ns: int) -> dict[str, Line]:
    """Sensor name -> line.

    Args:
        robot: that carries the devices.
        now_ns: when they are switched on.
    """
    sensors = robot.scenario.config.sensor
    sensor_rngs = robot.scenario.rng.spawn(len(sensors))
    fault_rngs = robot.scenario.rng.spawn(len(sensors))
    lines: dict[str, Line] = {}
    for (name, table), sensor_rng, fault_rng in zip(sensors.items(), sensor_rngs, fault_rngs, strict=True):
        device: Device = (
            LinkTrackDevice(robot, sensor_rng)
            if table.driver == "linktrack"
            else RplidarDevice(robot, sensor_rng)
        )
        faults = [fault for fault in robot.scenario.file.faults if fault.sensor == name]
        lines[name] = Line(device, robot, faults, fault_rng, now_ns)
    return lines
