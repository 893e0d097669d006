"""Closed loop with a simulated autopilot: its vehicle moves our emulated sensors, our pose its filter.

ArduPilot's SITL tells the truth in SIMSTATE. The world of a scenario is laid round the vehicle so that it
stands on the site's start mark, whatever its place on Earth and its heading.

Source: MAVLink ardupilotmega.xml, SIMSTATE.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from math import cos, degrees, radians
from pathlib import Path

import numpy as np

from companion.autopilot_client import AutopilotClient
from companion.config import Config
from companion.config_tables import OriginTable
from companion.errors import UserError
from companion.follow import RATES, FollowScore
from companion.live import LiveRun
from companion.mavlink.contact import Watch
from companion.mavlink.pose_out import METRES_PER_DEGREE, ned_from_map
from companion.sim.emulate import Emulator
from companion.sim.followed import FollowedTrajectory
from companion.sim.scenario import Scenario
from drivers.mavlink_frames import MavlinkMessage
from estimators.geometry import wrap_angle
from estimators.immutable import immutable
from estimators.messages import FloatArray

TRUTH = "SIMSTATE"
TRUTH_RATE = 50.0


@immutable
class Placement:
    """Where the map lies on Earth.

    Attributes:
        lat: latitude of the map's origin [deg].
        lon: longitude [deg].
        heading: compass heading of the map's x axis [rad].
    """

    lat: float
    lon: float
    heading: float

    def map_pose(self, truth: MavlinkMessage) -> FloatArray:
        """Pose (3,) in the map of a vehicle that is where SIMSTATE says."""
        north = (truth.lat / 1e7 - self.lat) * METRES_PER_DEGREE
        east = (truth.lng / 1e7 - self.lon) * METRES_PER_DEGREE * cos(radians(self.lat))
        xy = ned_from_map(self.heading)[:2, :2].T @ np.array([north, east])
        return np.array([xy[0], xy[1], wrap_angle(self.heading - truth.yaw)])


def place(truth: MavlinkMessage, start: FloatArray) -> Placement:
    """The map laid so that the vehicle stands on the start mark.

    Args:
        truth: SIMSTATE of the vehicle before it moves.
        start: (3,) x [m], y [m], yaw [rad] of the mark, map frame.
    """
    heading = wrap_angle(float(start[2]) + truth.yaw)
    north, east = ned_from_map(heading)[:2, :2] @ start[:2]
    lat = truth.lat / 1e7 - north / METRES_PER_DEGREE
    lon = truth.lng / 1e7 - east / (METRES_PER_DEGREE * cos(radians(lat)))
    return Placement(lat, lon, heading)


class SitlRun:
    """One closed loop; ends when told to.

    Args:
        scenario: world and sensors; its walk does not count.
        url: device string of the simulated autopilot.
        folder: run folder to write.
        say: takes one line for the operator.

    Raises:
        UserError: there is no autopilot, or none that tells where its vehicle truly is.
    """

    def __init__(self, scenario: Scenario, url: str, folder: Path, say: Callable[[str], None]) -> None:
        start = scenario.config.setup().start.pose
        truth = first_truth(url, scenario.config.mavlink.baud)
        self._placement = place(truth, start)
        self._walk = FollowedTrajectory(start)
        config = _placed(scenario.config, self._placement, url)
        self._emulator = Emulator(replace(scenario, config=config, trajectory=self._walk))
        self._folder = folder
        ports = {name: str(port.path) for name, port in self._emulator.ports.items()}
        sensors = {
            name: table.model_copy(update={"port": ports[name]}) for name, table in config.sensor.items()
        }
        self._begin_ns = time.monotonic_ns()
        self._emulator.robot.begin(self._begin_ns)
        self.score = FollowScore(self._expected)
        self.live = LiveRun(
            config.model_copy(update={"sensor": sensors}),
            folder,
            say,
            Watch({**RATES, TRUTH: TRUTH_RATE}, self._hear),
        )

    def run(self, stop: threading.Event) -> None:
        """Work until `stop` is set."""
        devices = threading.Thread(target=self._emulator.run, args=(stop, lambda _: None))
        devices.start()
        try:
            self.live.run(stop)
        finally:
            stop.set()
            devices.join()
            self._emulator.close()

    def our_errors(self) -> FloatArray:
        """Distances of our poses from the truth, (N,) [m], once the run is over."""
        poses = np.loadtxt(self._folder / "poses.tum", ndmin=2)
        if not len(poses):
            return np.empty(0)
        truth = self._walk.at(poses[:, 0] - self._begin_ns * 1e-9).pose
        errors: FloatArray = np.hypot(*(poses[:, 1:3] - truth[:, :2]).T)
        return errors

    def _hear(self, message: MavlinkMessage, stamp_ns: int) -> None:
        if message.get_type() == TRUTH:
            seconds = (stamp_ns - self._begin_ns) * 1e-9
            self._walk.hear(seconds, self._placement.map_pose(message))
        self.score.hear(message, stamp_ns)

    def _expected(self, stamp_ns: int) -> FloatArray:
        pose = self._walk.at(np.array([(stamp_ns - self._begin_ns) * 1e-9])).pose[0]
        expected: FloatArray = ned_from_map(self._placement.heading)[:2, :2] @ pose[:2]
        return expected


def first_truth(url: str, baud: int) -> MavlinkMessage:
    """Where the vehicle is now.

    Raises:
        UserError: no autopilot, or it does not tell.
    """
    client = AutopilotClient(url, baud)
    try:
        truth = client.message(TRUTH, TRUTH_RATE)
    finally:
        client.close()
    if truth is None:
        raise UserError(f"--connect {url}: this autopilot sends no {TRUTH}; is it ArduPilot's SITL?")
    return truth


def _placed(config: Config, placement: Placement, url: str) -> Config:
    origin = OriginTable(lat=placement.lat, lon=placement.lon, alt=0.0)
    site = config.site.model_copy(update={"origin": origin, "map_heading_deg": degrees(placement.heading)})
    mavlink = config.mavlink.model_copy(update={"url": url})
    return config.model_copy(update={"site": site, "mavlink": mavlink})
