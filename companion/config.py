"""The configuration of a run: site file, defaults and `--set`, checked before any port opens."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field, ValidationError, ValidationInfo, create_model, field_validator

from companion.checked_toml import Table, apply_set, parse_toml, toml_text, validated
from companion.config_tables import (
    AnchorBiasTable,
    BodyTable,
    Coordinate,
    HealthTable,
    PipelineTable,
    RangeBiasTable,
    SensorTable,
    SiteTable,
    StartTable,
    ViewTable,
)
from companion.errors import UserError
from companion.map_table import MapTable
from companion.mavlink_table import MavlinkTable
from companion.text_file import read_text
from drivers import SENSORS
from estimators import ESTIMATORS, estimator_config_class
from estimators.base import Setup
from estimators.lidar.ekf_slam import EkfSlam
from estimators.lidar.loop_closure import LoopCloser
from estimators.lidar.scan_matching import ScanMatcher
from estimators.lidar.scan_preparation import ScanPreparation
from estimators.messages import FloatArray
from estimators.models.range_bias import BearingBias, RangeBias
from estimators.relocation.recovery import Recovering
from estimators.trilateration import AnchorGeometryError, check_anchor_geometry


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
        return toml_text(self.model_dump(mode="json", serialize_as_any=True))


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
    return toml_text(data)


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


@cache
def _estimator_tables() -> type[Table]:
    """A table with one key an estimator, each with the estimator's own keys."""
    configs = {name: estimator_config_class(name) for name in ESTIMATORS}
    fields: Any = {name: (config, Field(default_factory=config)) for name, config in configs.items()}
    return create_model("EstimatorTables", __base__=Table, **fields)
