"""Scenario files: a world, a walk and sensors with their faults, all from one seed."""

from pathlib import Path
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationInfo, field_validator, model_validator

from companion.checked_toml import Table, known, parse_toml, validated
from companion.config import Config, load_config
from companion.config_tables import Coordinate
from companion.errors import UserError
from companion.sim.gait import GaitTrajectory
from companion.sim.kidnap import Kidnapped, Walk
from companion.sim.lidar_models import LIDAR_MODELS
from companion.sim.scenario_tables import (
    Blockade,
    GaitTable,
    IncrementsTable,
    InertialTable,
    KidnapTable,
    LandmarksTable,
    NlosTable,
    PaperTable,
    RandomBoxesTable,
    RandomWaypointsTable,
)
from companion.sim.trajectory import Trajectory
from companion.sim.world import World
from companion.text_file import read_text
from estimators.immutable import immutable
from estimators.messages import FloatArray


class BoxTable(Table):
    """An obstacle that a LiDAR sees and that blocks ranges passing below its top."""

    centre: tuple[Coordinate, Coordinate]
    size: tuple[float, float] = Field(description="lengths along its own axes [m]")
    yaw_deg: float = 0.0
    height: float = Field(2.5, gt=0, le=10, description="[m]")


class WorldTable(Table):
    """Obstacles; the walls are those of the site file."""

    boxes: list[BoxTable] = Field(default_factory=list)
    random_boxes: list[RandomBoxesTable] = Field(default_factory=list)


class TrajectoryTable(Table):
    """Where the robot walks."""

    waypoints: list[tuple[Coordinate, Coordinate]] = Field([], description="corners [m], map frame")
    random: RandomWaypointsTable | None = Field(None, description="corners of each trial, in place of these")
    laps: int = Field(1, ge=0, le=1000, description="times round the closed path; 0: open path")
    speed: float = Field(0.5, gt=0, le=10, description="[m/s]")
    accel: float = Field(0.5, gt=0, le=20, description="[m/s^2]")
    turn_rate_deg: float = Field(60.0, gt=0, le=360, description="[deg/s]")
    rest: float = Field(2.0, ge=0, le=600, description="standing still before and after [s]")
    leg_names: list[str] = Field(
        [], description="names of the legs, in order, to have figures for each; none: for the whole alone"
    )

    @field_validator("leg_names")
    @classmethod
    def _one_name_a_leg(cls, names: list[str], info: ValidationInfo) -> list[str]:
        corners, laps = len(info.data.get("waypoints", [])), info.data.get("laps", 0)
        legs = corners * laps if laps else max(0, corners - 1)
        if names and (len(names) != legs or len(set(names)) < legs):
            raise ValueError(f"{legs} different names are needed, one for each leg")
        return names

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if self.random is None and len(self.waypoints) < 2:
            raise ValueError(f"waypoints: at least 2 are needed, got {len(self.waypoints)}")
        if self.random is not None and self.waypoints:
            raise ValueError("random: waypoints are given, too; leave one out")
        return self


class UwbTable(Table):
    """The LinkTrack tag and how its ranges err."""

    frame: Literal[
        "node_frame2",
        "node_frame3",
        "tag_frame0",
        "node_frame4",
        "node_frame5",
        "aoa_node_frame0",
        "anchor_frame0",
    ] = Field(
        "node_frame2", description="what carries the ranges; node_frame4 and anchor_frame0: a console's"
    )
    other_traffic: bool = Field(False, description="user data, text and complaints on the same port")
    rate: float = Field(25.0, ge=1, le=200, description="frames a second [Hz]")
    sigma: float = Field(0.10, ge=0, le=5, description="standard deviation of a range [m]")
    delay_sigma_ns: float = Field(
        0.0, ge=0, le=100, description="how little each anchor's answering delay is known; 1 ns is 15 cm [ns]"
    )
    nlos_least: float = Field(0.2, ge=0, le=10, description="least bias of a blocked range [m]")
    nlos_mean: float = Field(0.3, ge=0, le=10, description="mean of the exponential bias on top of that [m]")
    dropout: float = Field(0.02, ge=0, lt=1, description="share of ranges that fail")
    power_difference: float = Field(
        3.0, ge=0, le=60, description="mean by which the first path is weaker than everything received [dB]"
    )
    nlos_power_difference: float = Field(11.0, ge=0, le=60, description="the same of a blocked range [dB]")
    power_sigma: float = Field(2.0, ge=0, le=20, description="standard deviation of both [dB]")


class LidarTable(Table):
    """The RPLIDAR and how its ranges err."""

    model: str = Field("A2", description="one of " + ", ".join(LIDAR_MODELS))
    rotation_hz: float = Field(10.0, ge=2, le=20, description="revolutions a second [Hz]")
    sigma: float = Field(0.015, ge=0, le=1, description="standard deviation of a distance [m]")
    dropout: float = Field(0.02, ge=0, lt=1, description="share of beams that return nothing")
    min_range: float = Field(0.15, ge=0, le=10, description="[m]")
    max_range: float = Field(12.0, gt=0, le=100, description="[m]")
    height: float = Field(0.1, ge=0, le=5, description="scan plane above the body origin [m]")

    @field_validator("model")
    @classmethod
    def _known_model(cls, model: str) -> str:
        return known(model, LIDAR_MODELS, "model")


class ImuTable(Table):
    """The tag's inertial sensor and how it errs."""

    gyro_sigma: float = Field(0.01, ge=0, le=1, description="[rad/s]")
    gyro_bias: float = Field(0.005, ge=0, le=1, description="standard deviation of the bias [rad/s]")
    accel_sigma: float = Field(0.05, ge=0, le=10, description="[m/s^2]")


class FaultTable(Table):
    """Something goes wrong with a sensor or its cable for a while."""

    sensor: str = Field(description="name of the sensor in the site file")
    kind: Literal[
        "garbage", "truncation", "bit_flips", "stall", "silence", "disconnect", "protection_stop"
    ] = Field(
        description="random bytes between the device's own; the rest of a read lost; bits flipped; bytes "
        "held back until the end; bytes lost; the plug pulled; the LiDAR stops itself with an error"
    )
    at: float = Field(gt=0, description="since the walk began [s]")
    duration: float = Field(gt=0, le=3600, description="[s]")
    share: float = Field(
        0.1, gt=0, le=1, description="of bytes that are hit (bit_flips) or of reads (garbage, truncation)"
    )


class ScenarioFile(Table):
    """A scenario file as written."""

    description: str = ""
    site: str = Field(description="site file, relative to the scenario file")
    seed: int = Field(1, ge=0)
    trajectory: TrajectoryTable
    world: WorldTable = Field(default_factory=WorldTable)
    uwb: UwbTable = Field(default_factory=UwbTable)
    lidar: LidarTable = Field(default_factory=LidarTable)
    imu: ImuTable = Field(default_factory=ImuTable)
    faults: list[FaultTable] = Field(default_factory=list)
    kidnap: list[KidnapTable] = Field(default_factory=list)
    nlos: list[NlosTable] = Field(default_factory=list)
    gait: GaitTable | None = None
    increments: IncrementsTable | None = None
    landmarks: LandmarksTable | None = None
    inertial: InertialTable | None = None
    paper: PaperTable | None = None

    @field_validator("landmarks")
    @classmethod
    def _without_bytes(cls, landmarks: LandmarksTable, info: ValidationInfo) -> LandmarksTable:
        if info.data.get("increments") is None:
            raise ValueError("no emulated device sends landmarks, they need a table [increments]")
        return landmarks

    @field_validator("inertial")
    @classmethod
    def _at_a_tag_without_bytes(cls, inertial: InertialTable, info: ValidationInfo) -> InertialTable:
        if info.data.get("increments") is None:
            raise ValueError("the emulated tag has its own sensor [imu], this one needs a table [increments]")
        return inertial


@immutable
class Scenario:
    """A scenario with its seed drawn: ready to run.

    Attributes:
        name: the file's name without ending.
        file: the settings as written.
        config: the site's configuration.
        seed: of everything random in it.
        world: walls and boxes.
        trajectory: the true walk; its start is displaced as the site's start sigma says, if it is known.
        blockades: anchors that are not seen for a while, whatever stands where.
        rng: where the sensors draw their noise from.
    """

    name: str
    file: ScenarioFile
    config: Config
    seed: int
    world: World
    trajectory: Walk
    blockades: list[Blockade]
    rng: np.random.Generator

    def sees(self, tag: FloatArray, seconds: float) -> NDArray[np.bool_]:
        """Which anchors (A,), in the order of the site file, are in line of sight.

        Args:
            tag: (3,) [m], map frame.
            seconds: since the walk began.
        """
        clear = self.world.line_of_sight(tag, np.array(list(self.config.anchors.values())))
        for blockade in self.blockades:
            if blockade.begin <= seconds < blockade.end:
                clear &= ~blockade.blocked
        return clear


def load_scenario(path: Path, seed: int | None, sets: list[str]) -> Scenario:
    """Read a scenario and its site.

    Args:
        path: scenario file.
        seed: instead of the file's own.
        sets: `--set` assignments on the site's configuration.

    Raises:
        UserError: a file is missing or wrong.
    """
    file = validated(ScenarioFile, parse_toml(read_text(path), str(path)), str(path))
    config = load_config(path.parent / file.site, sets)
    if not (config.site.walls or file.world.boxes or file.world.random_boxes):
        raise UserError(f"{path}: the site has no walls and the scenario no boxes, the LiDAR sees nothing")
    for i, fault in enumerate(file.faults):
        sensor = config.sensor.get(fault.sensor)
        if sensor is None:
            raise UserError(
                f"{path}: faults.{i}.sensor: no sensor {fault.sensor!r} in the site, there are: "
                + ", ".join(config.sensor)
            )
        if fault.kind == "protection_stop" and sensor.driver != "rplidar":
            raise UserError(f"{path}: faults.{i}.kind: only an rplidar has a protection_stop")
    walk = file.trajectory
    start = config.setup().start
    seed = file.seed if seed is None else seed
    rng = np.random.default_rng(seed)
    boxes = [(*b.centre, *b.size, float(np.deg2rad(b.yaw_deg)), b.height) for b in file.world.boxes]
    # The operator sets the robot down on its mark as well as the site file says, not better.
    placement = rng.standard_normal(3) * start.sigma if start.known else np.zeros(3)
    straight = Trajectory(
        walk.random.draw(rng) if walk.random else walk.waypoints,
        walk.laps,
        walk.speed,
        walk.accel,
        float(np.deg2rad(walk.turn_rate_deg)),
        walk.rest,
        placement,
    )
    for table in file.world.random_boxes:
        boxes += table.draw(rng)
    for i, blocked in enumerate(file.nlos):
        if blocked.anchors > len(config.anchors):
            raise UserError(
                f"{path}: nlos.{i}.anchors: the site has {len(config.anchors)} anchors, got {blocked.anchors}"
            )
    blockades = [table.draw(len(config.anchors), rng) for table in file.nlos]
    trajectory: Walk = GaitTrajectory(straight, walk.rest, file.gait, rng) if file.gait else straight
    if start.known and walk.random:
        raise UserError(
            f"{path}: random waypoints start anywhere: the site needs start.known = false (--set)"
        )
    if start.known and not np.allclose(trajectory.start, start.pose, atol=1e-3):
        x, y, yaw = trajectory.start
        raise UserError(
            f"{path}: the walk begins at ({x:g}, {y:g}) facing {np.rad2deg(yaw):g} deg, but the site's "
            f"[start] is ({start.pose[0]:g}, {start.pose[1]:g}), {np.rad2deg(start.pose[2]):g} deg"
        )
    for i, kidnap in enumerate(file.kidnap):
        try:
            trajectory = Kidnapped(trajectory, kidnap, rng)
        except ValueError as error:
            raise UserError(f"{path}: kidnap.{i}: {error}") from error
    return Scenario(
        name=path.stem,
        file=file,
        config=config,
        seed=seed,
        world=World([list(wall) for wall in config.site.walls], boxes),
        trajectory=trajectory,
        blockades=blockades,
        rng=rng,
    )
