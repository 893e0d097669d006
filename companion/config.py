"""Everything that can be set: site file, defaults and `--set`, checked before any port opens."""

import tomllib
from collections.abc import Mapping, Sequence
from functools import cache
from ipaddress import IPv4Address
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

import numpy as np
import tomli_w
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    IPvAnyAddress,
    ValidationError,
    ValidationInfo,
    create_model,
    field_validator,
    model_validator,
)

from companion.errors import UserError
from companion.map_table import MapTable
from companion.mavlink_table import MavlinkTable
from companion.text_file import read_text
from drivers import SENSORS, sensor_config_class
from drivers.errors import PortError
from drivers.port import parse_address
from estimators import ESTIMATORS, estimator_config_class
from estimators.base import Setup, Start
from estimators.lidar.ekf_slam import EkfSlam
from estimators.lidar.front_ends import FRONT_ENDS
from estimators.lidar.loop_closure import LoopCloser
from estimators.lidar.scan_matching import ScanMatcher
from estimators.lidar.scan_preparation import ScanPreparation
from estimators.messages import FloatArray
from estimators.models.range_bias import BearingBias, RangeBias
from estimators.relocation.recovery import Recovering
from estimators.trilateration import AnchorGeometryError, check_anchor_geometry

M = TypeVar("M", bound=BaseModel)
Coordinate = Annotated[float, Field(ge=-10_000, le=10_000, allow_inf_nan=False)]
UNKNOWN_START = Start(np.zeros(3), np.array([1e4, 1e4, np.pi]), known=False)
"""As uncertain as coordinates can be, for whoever takes it for a pose all the same."""


class Table(BaseModel):
    """A table of a TOML file: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


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


class Config(Table):
    """A whole configuration, as a run uses it."""

    site: SiteTable = Field(default_factory=SiteTable)
    anchors: dict[int, tuple[Coordinate, Coordinate, Coordinate]]
    body: BodyTable = Field(default_factory=BodyTable)
    start: StartTable
    sensor: dict[str, SensorTable] = Field(min_length=1)
    range_bias: RangeBiasTable = Field(default_factory=RangeBiasTable)
    pipeline: PipelineTable = Field(default_factory=PipelineTable)
    scan_preparation: ScanPreparation.Config = Field(default_factory=ScanPreparation.Config)
    scan_matcher: ScanMatcher.Config = Field(default_factory=ScanMatcher.Config)
    loop_closure: LoopCloser.Config = Field(default_factory=LoopCloser.Config)
    ekf_slam: EkfSlam.Config = Field(default_factory=EkfSlam.Config)
    estimator: Any = Field(
        default_factory=dict, validate_default=True, description="a table for each estimator, by name"
    )
    relocation: Recovering.Config = Field(default_factory=Recovering.Config)
    health: HealthTable = Field(default_factory=HealthTable)
    mavlink: MavlinkTable = Field(default_factory=MavlinkTable)
    view: ViewTable = Field(default_factory=ViewTable)

    @field_validator("anchors")
    @classmethod
    def _usable_anchors(cls, anchors: dict[int, tuple[float, float, float]]) -> Any:
        try:
            check_anchor_geometry(np.array(list(anchors.values())).reshape(-1, 3))
        except AnchorGeometryError as error:
            raise ValueError(str(error)) from error
        return anchors

    @field_validator("mavlink")
    @classmethod
    def _fits_the_site(cls, mavlink: MavlinkTable, info: ValidationInfo) -> MavlinkTable:
        origin = info.data["site"].origin if "site" in info.data else None
        if mavlink.raw_ranges and (origin is None or mavlink.align != "site"):
            raise ValueError(
                'raw_ranges give anchors by latitude and longitude: set site.origin, align = "site"'
            )
        has_lidar = any(table.driver == "rplidar" for table in info.data.get("sensor", {}).values())
        if mavlink.obstacles and not has_lidar:
            raise ValueError("obstacles come from a LiDAR, and the site has none: set obstacles = false")
        is_matched = "pipeline" not in info.data or info.data["pipeline"].front_end == "scan_matcher"
        if (mavlink.inputs.odometry or mavlink.inputs.wheels) and not is_matched:
            raise ValueError(
                'inputs.odometry and inputs.wheels need pipeline.front_end = "scan_matcher": '
                "EKF-SLAM takes scans alone"
            )
        return mavlink

    @field_validator("estimator")
    @classmethod
    def _estimator_settings(cls, settings: Any, info: Any) -> Any:
        tables = _estimator_tables().model_validate(settings)
        site = info.data.get("site")
        has_walls = site is not None and (site.map is not None or any(len(wall) > 1 for wall in site.walls))
        for name in ESTIMATORS:
            if getattr(getattr(tables, name), "scan_likelihood", False) and not has_walls:
                raise ValueError(f"{name}.scan_likelihood needs a wall in site.walls, or site.map")
        return tables

    @field_validator("relocation")
    @classmethod
    def _finds_the_start(cls, relocation: Recovering.Config, info: Any) -> Recovering.Config:
        if not relocation.enabled and "start" in info.data and not info.data["start"].known:
            raise ValueError(
                "enabled must be true to find the start, which start.known = false says is unknown"
            )
        return relocation

    def estimator_config(self, name: str) -> BaseModel:
        """Settings of the named estimator."""
        config = getattr(self.estimator, name)
        assert isinstance(config, BaseModel)
        return config

    def front_end_config(self) -> BaseModel:
        """Settings of the chosen front end."""
        config = getattr(self, self.pipeline.front_end)
        assert isinstance(config, BaseModel)
        return config

    def setup(self) -> Setup:
        """Geometry in the form the estimators take it: metres and radians."""
        body = self.body
        return Setup(
            anchors={i: np.array(position) for i, position in self.anchors.items()},
            tag_in_body=np.array(body.tag),
            start=self.start.to_start(),
            height=body.height,
            height_sigma=body.height_sigma,
            level_sigma=float(np.deg2rad(body.level_sigma_deg)),
            walls=[np.array(wall) for wall in self.site.walls],
            lidar_in_body=self.lidar_mounting(),
            floor_map=self.site.map.floor_map() if self.site.map is not None else None,
            scan_preparation=self.scan_preparation,
            tags={i: np.array(position) for i, position in body.tags.items()},
            bearing_biases={
                i: BearingBias(bias.cosine, bias.sine)
                for i, bias in self.range_bias.tags.items()
                if bias.cosine or bias.sine
            },
        )

    def range_biases(self) -> dict[int, RangeBias]:
        """Bias by anchor id; empty when none is known."""
        table = self.range_bias
        if not table.common and not table.anchors and not table.tags:
            return {}
        single = {i: table.anchors.get(i, AnchorBiasTable()) for i in self.anchors}
        return {
            i: RangeBias(table.common + bias.constant, bias.per_metre, bias.distance)
            for i, bias in single.items()
        }

    def tag_biases(self) -> dict[int, float]:
        """What ranges of a tag have beyond those of the anchors, by tag id [m]."""
        return {i: bias.constant for i, bias in self.range_bias.tags.items()}

    def lidar_mounting(self) -> FloatArray:
        """`T_body_lidar`, (3,): x [m], y [m], yaw [rad] in the body frame."""
        return np.array([*self.body.lidar, np.deg2rad(self.body.lidar_yaw_deg)])

    def map_heading(self) -> float:
        """Compass heading of the map's x axis [rad], clockwise from north."""
        return float(np.deg2rad(self.site.map_heading_deg))

    def to_toml(self) -> str:
        """The configuration as TOML, every key with its value."""
        return tomli_w.dumps(_toml_ready(self.model_dump(mode="json", serialize_as_any=True)))


def load_config(site: Path, sets: Sequence[str] = ()) -> Config:
    """Read a site file over the defaults, then apply `--set` assignments.

    Raises:
        UserError: file missing or not TOML, unknown key, bad value: named with the limit it breaks.
    """
    return config_from_toml(read_text(site), str(site), sets, site.parent)


def config_from_toml(text: str, origin: str, sets: Sequence[str] = (), folder: Path | None = None) -> Config:
    """Check a configuration text.

    Args:
        text: TOML.
        origin: names it in errors.
        sets: `--set` assignments; a map that they name is looked for from the working directory on.
        folder: where a map that the text names is looked for; None: likewise.

    Raises:
        UserError: as `load_config`.
    """
    data = parse_toml(text, origin)
    _read_map(data, origin, folder or Path())
    for assignment in sets:
        apply_set(data, assignment)
    _read_map(data, origin, Path())
    return validated(Config, data, origin)


def default_toml() -> str:
    """Every key that has a default, with it; what only a site file can give is left out."""
    anchors = {0: (0.0, 0.0, 2.0), 1: (0.0, 5.0, 2.0), 2: (5.0, 0.0, 2.0)}
    start = {"x": 0, "y": 0, "yaw_deg": 0}
    sensors = {driver: {"driver": driver, "port": "/dev/ttyUSB0"} for driver in SENSORS}
    full = Config.model_validate({"anchors": anchors, "start": start, "sensor": sensors})
    data = full.model_dump(mode="json", serialize_as_any=True)
    del data["anchors"], data["sensor"]
    data["start"] = {k: v for k, v in data["start"].items() if k not in start}
    return tomli_w.dumps(_toml_ready(data))


def parse_toml(text: str, origin: str) -> dict[str, Any]:
    """TOML to a dictionary.

    Raises:
        UserError: not TOML, with the place of the mistake.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{origin} is not valid TOML: {error}") from error


def apply_set(data: dict[str, Any], assignment: str) -> None:
    """Apply one `--set a.b=value`; the value is read as TOML, or as text when it is none.

    Raises:
        UserError: no `=`, or the path goes through a value that is not a table.
    """
    path, equals, text = assignment.partition("=")
    if not equals or not path.strip():
        raise UserError(f"--set {assignment!r}: write key=value, for example pipeline.rate=20")
    try:
        value: Any = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    *tables, key = path.strip().split(".")
    for name in tables:
        data = data.setdefault(name, {})
        if not isinstance(data, dict):
            raise UserError(f"--set {assignment!r}: {name!r} is a value, not a table")
    data[key] = value


def validated(model: type[M], data: dict[str, Any], origin: str) -> M:
    """Check data against a model.

    Raises:
        UserError: the first thing that is wrong, with key, value and limit.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first, *others = error.errors()
        key = ".".join(str(part) for part in first["loc"])
        reason = first["msg"].removeprefix("Value error, ")
        if first["type"] == "extra_forbidden":
            reason = "unknown key"
        elif first["type"] == "missing":
            reason = "this key is required and missing"
        elif not isinstance(first["input"], dict):
            reason += f", got {first['input']!r}"
        more = f" (and {len(others)} more)" if others else ""
        raise UserError(f"{origin}: {key}: {reason}{more}") from error


def _read_map(data: dict[str, Any], origin: str, folder: Path) -> None:
    """Put the map itself where data names its file."""
    site = data.get("site")
    if not isinstance(site, dict) or not isinstance(site.get("map"), str):
        return
    # Only who has a map waits for what reads pictures.
    from companion.map_file import load_map

    name = site["map"]
    try:
        site["map"] = MapTable.of(load_map(folder / name), name)
    except UserError as error:
        raise UserError(f"{origin}: site.map: {error}") from error
    except ValidationError as error:
        reason = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise UserError(f"{origin}: site.map: {reason}") from error


def params_dir() -> Path:
    """Folder of the files that ship with the project: `params/` of a checkout, or its copy in a wheel."""
    here = Path(__file__).parent
    return next(p for p in (here / "_params", here.parent / "params") if p.is_dir())


def named_file(path: Path, kind: str) -> Path:
    """A file of the user's, or one of ours in `params/KIND` by its bare name.

    Raises:
        UserError: a bare name that neither has; names ours.
    """
    if path.exists() or path.suffix or path.name != str(path):
        return path
    ours = params_dir() / kind / f"{path}.toml"
    if not ours.exists():
        names = ", ".join(sorted(p.stem for p in ours.parent.glob("*.toml")))
        raise UserError(f"no file {path} and none of that name in params/{kind}; there are: {names}")
    return ours


@cache
def _estimator_tables() -> type[Table]:
    """A table with one key an estimator, each with the estimator's own keys."""
    configs = {name: estimator_config_class(name) for name in ESTIMATORS}
    fields: Any = {name: (config, Field(default_factory=config)) for name, config in configs.items()}
    return create_model("EstimatorTables", __base__=Table, **fields)


def known(name: str, table: Mapping[str, Any], what: str) -> str:
    """The name, if the table has it.

    Raises:
        ValueError: it has not; names those there are.
    """
    if name not in table:
        raise ValueError(f"unknown {what} {name!r}, there are: {', '.join(table)}")
    return name


def _toml_ready(value: Any) -> Any:
    """JSON-like data without what TOML lacks (None, integer keys)."""
    if isinstance(value, dict):
        return {str(k): _toml_ready(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [_toml_ready(v) for v in value]
    return value
