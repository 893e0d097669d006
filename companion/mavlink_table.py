"""The table `[mavlink]` of a site file: links, ids, and what is said to the autopilot."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from companion.checked_toml import Table
from drivers.autopilot import Autopilot


class GateTable(Table):
    """When poses are sent: on top of `[health]`, what an autopilot needs of a stream."""

    resume_after: float = Field(
        1.0,
        ge=0,
        le=60,
        description="health must have been good for so long before poses are sent (again) [s]",
    )
    max_speed: float = Field(3.0, gt=0, le=100, description="the robot moves no faster than this [m/s]")
    max_turn_rate_deg: float = Field(360.0, gt=0, le=3600, description="and turns no faster [deg/s]")
    max_jump: float = Field(
        0.3, gt=0, le=10, description="a pose that is farther than that from where it can be has jumped [m]"
    )
    max_jump_deg: float = Field(15.0, gt=0, le=180, description="the same of the heading [deg]")


class MavlinkTable(Table):
    """Links to the autopilot and a ground station, and what is said there."""

    url: str = Field(
        "udpout:127.0.0.1:14550",
        description="the autopilot: udpout:HOST:PORT, udpin:, tcp:, tcpin:, a serial device; empty: none",
    )
    baud: int = Field(921600, ge=1200, le=4_000_000, description="baud of a serial link")
    ground_url: str = Field(
        "",
        description="a ground station's own link: it gets no poses; empty = it is reached by the autopilot",
    )
    ground_ids: tuple[Annotated[int, Field(ge=1, le=255)], ...] = Field(
        (255,), description="system ids of ground stations that are obeyed"
    )
    forward: bool = Field(False, description="pass messages on between autopilot and ground station")
    system_id: int = Field(
        1, ge=1, le=255, description="system id until the autopilot's own HEARTBEAT is heard"
    )
    component_id: int = Field(
        197, ge=2, le=255, description="197 is MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY; 1 is the autopilot's"
    )
    autopilot_id: int = Field(
        0, ge=0, le=255, description="system id of the autopilot; 0 = the first one that is heard"
    )
    profile: Literal["auto", "ardupilot", "px4"] = Field(
        "auto", description="auto: as its HEARTBEAT says; no pose is sent before"
    )
    message: Literal["vision_position_estimate", "odometry"] = Field(
        "vision_position_estimate", description="what carries the pose; odometry has the velocity too"
    )
    speed: bool = Field(False, description="VISION_SPEED_ESTIMATE beside the pose; ArduPilot only")
    heading: bool = Field(
        True, description="false: position only, for an autopilot that has its heading from a compass"
    )
    height: bool = Field(
        False, description="the autopilot uses the pose's height; false: its variance says nothing of x and y"
    )
    covariance: Literal["full", "unknown"] = Field(
        "full", description="unknown: the autopilot uses the noise of its own parameters"
    )
    align: Literal["site", "compass"] = Field(
        "site",
        description="the map's heading: site.map_heading_deg, or the autopilot's compass at the moment in "
        "which the operator sets the parameter ALIGN_COMPASS to 1; no pose is sent before",
    )
    signing_key: str = Field("", description="file with the key of 32 bytes, raw or as 64 hex digits")
    obstacles: bool = Field(False, description="OBSTACLE_DISTANCE from the LiDAR's scans")
    obstacle_range: float = Field(
        12.0, gt=1, le=600, description="the LiDAR sees no farther: free sectors are free up to there [m]"
    )
    raw_ranges: bool = Field(False, description="RANGING_BEACON for every accepted range; needs site.origin")
    parameter_file: str = Field(
        "", description="parameters changed by a ground station are kept there; empty = until the next start"
    )
    gate: GateTable = Field(default_factory=GateTable)
    inputs: Autopilot.Config = Field(default_factory=Autopilot.Config)

    @model_validator(mode="after")
    def _makes_sense(self) -> Self:
        if self.speed and self.message == "odometry":
            raise ValueError("odometry carries the velocity already, set speed = false")
        if self.speed and self.profile == "px4":
            raise ValueError('PX4 reads no VISION_SPEED_ESTIMATE, set speed = false or message = "odometry"')
        if self.forward and not self.ground_url:
            raise ValueError("forward needs a second link to pass messages on to, set ground_url")
        if self.ground_url and self.ground_url == self.url:
            raise ValueError(f"url and ground_url are the same link, {self.url!r}")
        if self.autopilot_id in self.ground_ids:
            raise ValueError(f"autopilot_id {self.autopilot_id} is one of ground_ids, too")
        return self
