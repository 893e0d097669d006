"""The tables of a site file, each with its keys, defaults and limits."""

from ipaddress import IPv4Address
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, IPvAnyAddress, field_validator, model_validator

from companion.checked_toml import Table, known
from companion.map_table import MapTable
from drivers import SENSORS, sensor_config_class
from drivers.errors import PortError
from drivers.port import parse_address
from estimators import ESTIMATORS
from estimators.base import Start
from estimators.lidar.front_ends import FRONT_ENDS

Coordinate = Annotated[float, Field(ge=-10_000, le=10_000, allow_inf_nan=False)]
UNKNOWN_START = Start(np.zeros(3), np.array([1e4, 1e4, np.pi]), known=False)
"""As uncertain as coordinates can be, for whoever takes it for a pose all the same."""


class OriginTable(Table):
    """Where on Earth the map's origin is: an autopilot without GPS takes it from here."""

    lat: float = Field(ge=-90, le=90, description="latitude, WGS 84, north is positive [deg]")
    lon: float = Field(ge=-180, le=180, description="longitude, WGS 84, east is positive [deg]")
    alt: float = Field(0.0, ge=-1000, le=10_000, description="above mean sea level [m]")


class SiteTable(Table):
    """The place."""

    name: str = Field("unnamed", description="shown in titles and summaries")
    map_heading_deg: float = Field(
        0.0, ge=-360, le=360, description="compass heading of the map's +x axis, clockwise from north [deg]"
    )
    walls: list[list[tuple[Coordinate, Coordinate]]] = Field(
        [],
        description="polylines of walls, for views and for particle filters with scan_likelihood, which hold "
        "scans against them [m]",
    )
    origin: OriginTable | None = Field(None, description="where the map's origin is on Earth")
    map: MapTable | None = Field(
        None,
        description="in a site file the name of a map's YAML file, seen from the site file: it tells blocked "
        "ranges, serves scan_likelihood, and up to 250000 cells finds a standing robot",
    )


class BodyTable(Table):
    """The robot: where its sensors sit. Body frame: x forward, y left, z up."""

    height: Coordinate = Field(0.0, description="body origin above the map's z = 0 [m]")
    height_sigma: float = Field(0.05, gt=0, le=10, description="standard deviation of the height [m]")
    level_sigma_deg: float = Field(3.0, gt=0, le=90, description="standard deviation of roll and pitch [deg]")
    tag: tuple[Coordinate, Coordinate, Coordinate] = Field(
        (0.0, 0.0, 0.0), description="UWB tag antenna in the body frame [m]"
    )
    tags: dict[int, tuple[Coordinate, Coordinate, Coordinate]] = Field(
        {}, description="likewise of further tags on the robot, by the id of the tag [m]"
    )
    lidar: tuple[Coordinate, Coordinate] = Field(
        (0.0, 0.0), description="LiDAR's rotation centre in the body frame [m]"
    )
    lidar_yaw_deg: float = Field(
        0.0, ge=-360, le=360, description="LiDAR's 0 deg beam, counter-clockwise from body x [deg]"
    )


class StartTable(Table):
    """Where the robot stands when the process starts, and how well that is known."""

    known: bool = Field(
        True,
        description="false: the robot may stand anywhere, its pose is found once it has moved a metre, or "
        "with site.map where it stands",
    )
    x: Coordinate | None = Field(None, description="[m], map frame; needed when the start is known")
    y: Coordinate | None = Field(None, description="likewise")
    yaw_deg: float | None = Field(None, ge=-360, le=360, description="likewise [deg]")
    sigma_xy: float = Field(0.10, gt=0, le=100, description="[m], each axis")
    sigma_yaw_deg: float = Field(5.0, gt=0, le=180, description="[deg]")
    still_for: float = Field(
        5.0, ge=0, le=600, description="it stands there until LiDAR odometry begins, at most so long [s]"
    )

    @model_validator(mode="after")
    def _whole(self) -> Self:
        for name in ("x", "y", "yaw_deg"):
            if self.known and getattr(self, name) is None:
                raise ValueError(f"{name} is required and missing (or set known = false)")
        return self

    def to_start(self) -> Start:
        """The start in the form the estimators take it: metres and radians."""
        if self.x is None or self.y is None or self.yaw_deg is None or not self.known:
            return UNKNOWN_START
        yaw, yaw_sigma = np.deg2rad([self.yaw_deg, self.sigma_yaw_deg])
        pose = np.array([self.x, self.y, yaw])
        return Start(pose, np.array([self.sigma_xy, self.sigma_xy, yaw_sigma]), self.still_for)


class AnchorBiasTable(Table):
    """How much longer than the common bias one anchor's ranges are, as `companion calibrate ranges` found."""

    constant: float = Field(0.0, ge=-10, le=10, description="beyond the common bias, at `distance` [m]")
    constant_sigma: float = Field(0.0, ge=0, le=10, description="standard deviation of it [m]")
    per_metre: float = Field(0.0, ge=-0.2, le=0.2, description="growth with the distance [m/m]")
    per_metre_sigma: float = Field(0.0, ge=0, le=1, description="standard deviation of it [m/m]")
    distance: float = Field(0.0, ge=0, le=1000, description="where `constant` holds [m]")


class TagBiasTable(Table):
    """How much longer than the others' one tag's ranges are, as `companion calibrate ranges` found."""

    constant: float = Field(0.0, ge=-10, le=10, description="to every anchor [m]")
    constant_sigma: float = Field(0.0, ge=0, le=10, description="standard deviation of it [m]")
    cosine: float = Field(
        0.0,
        ge=-1,
        le=1,
        description="and cos 2b times this, at bearing b of the anchor in the body frame [m]",
    )
    cosine_sigma: float = Field(0.0, ge=0, le=1, description="standard deviation of it [m]")
    sine: float = Field(0.0, ge=-1, le=1, description="likewise sin 2b times this [m]")
    sine_sigma: float = Field(0.0, ge=0, le=1, description="standard deviation of it [m]")


class RangeBiasTable(Table):
    """What is taken off every range before anything else uses it."""

    common: float = Field(0.0, ge=-10, le=10, description="of all anchors: c times the time bias [m]")
    common_sigma: float = Field(0.0, ge=0, le=10, description="standard deviation of it [m]")
    anchors: dict[int, AnchorBiasTable] = Field({}, description="by the id of the anchor")
    tags: dict[int, TagBiasTable] = Field({}, description="by the id of the tag, where the robot has several")


class SensorTable(Table):
    """A sensor on a port."""

    driver: str = Field(description="one of " + ", ".join(SENSORS))
    port: str = Field(
        description="serial device (/dev/ttyUSB0?baud=921600), any pyserial URL (socket://host:port), or "
        "auto: the USB serial adapter on which the sensor speaks (auto:/dev/ttyUSB*: one of these)"
    )
    settings: Any = Field(
        default_factory=dict, validate_default=True, description="the driver's own settings"
    )

    @field_validator("driver")
    @classmethod
    def _known_driver(cls, driver: str) -> str:
        return known(driver, SENSORS, "driver")

    @field_validator("port")
    @classmethod
    def _readable_port(cls, port: str) -> str:
        try:
            parse_address(port)
        except PortError as error:
            raise ValueError(str(error)) from error
        return port

    @field_validator("settings")
    @classmethod
    def _driver_settings(cls, settings: Any, info: Any) -> Any:
        if "driver" not in info.data:
            return settings
        return sensor_config_class(info.data["driver"]).model_validate(settings)


class PipelineTable(Table):
    """How measurements are ordered and poses given out."""

    estimator: str = Field("ekf", description="whose pose goes to the autopilot")
    front_end: str = Field("scan_matcher", description="what makes increments of scans")
    rate: float = Field(30.0, ge=4, le=50, description="poses a second [Hz]")
    hold_ms: float = Field(
        30.0, ge=0, le=1000, description="wait this long for slower sensors, to keep stamp order [ms]"
    )

    @field_validator("estimator")
    @classmethod
    def _known_estimator(cls, name: str) -> str:
        return known(name, ESTIMATORS, "estimator")

    @field_validator("front_end")
    @classmethod
    def _known_front_end(cls, name: str) -> str:
        return known(name, FRONT_ENDS, "front end")


class HealthTable(Table):
    """When the pose is good enough to send."""

    max_sigma_xy: float = Field(
        0.5, gt=0, le=100, description="position sigma above which no pose is sent [m]"
    )
    max_sigma_yaw_deg: float = Field(20.0, gt=0, le=180, description="the same for heading [deg]")
    max_range_age: float = Field(
        1.0, gt=0, le=60, description="degraded when no range was accepted for so long [s]"
    )
    max_increment_age: float = Field(
        1.0, gt=0, le=60, description="degraded when no LiDAR increment was accepted for so long [s]"
    )
    max_dead_reckoning: float = Field(
        20.0, gt=0, le=3600, description="lost when no range was accepted for so long, whatever the sigma [s]"
    )
    min_accepted_share: float = Field(
        0.3, ge=0, le=0.6, description="lost when a smaller share of recent ranges agrees with the pose"
    )
    max_short_share: float = Field(
        0.03,
        gt=0,
        le=1,
        description="lost when a larger share of recent ranges is gated as too short: what blocks a range "
        "only lengthens it, so the pose must be wrong",
    )


class ViewTable(Table):
    """What Rerun shows and keeps of a run."""

    bind: IPvAnyAddress = Field(
        IPv4Address("127.0.0.1"),
        description="address at which --view web is served; 0.0.0.0 = to whoever can reach this computer",
    )
    web_port: int = Field(9090, ge=1, le=65535, description="port of the page")
    data_port: int = Field(9876, ge=1, le=65535, description="port from which the page gets its data")
    memory_mb: int = Field(
        256, ge=16, le=65536, description="kept for pages opened late, the newest first to stay [MB]"
    )
    scan_points: int = Field(
        400, ge=0, le=100_000, description="at most so many points of a scan are shown; the log has all"
    )
    record: bool = Field(False, description="whether a run writes .rrd files into its folder, too")
    file_mb: float = Field(
        100.0, gt=0, le=100_000, description="another .rrd file is begun when one is so large [MB]"
    )
    file_minutes: float = Field(30.0, gt=0, le=10_000, description="or holds so much of a run [min]")
