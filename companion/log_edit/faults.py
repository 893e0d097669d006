"""The faults that can be put into a log: what each does to bytes, frames or scans while it lasts.

On the command line a fault is KIND:key=value,key=value, for example `drop:anchor=3,at=20`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import inf
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from companion.checked_toml import Table, validated
from companion.config import Config
from companion.config_tables import Coordinate
from companion.errors import UserError
from companion.log import RawChunk
from companion.log_edit.ranges import Changed, change_ranges
from drivers.linktrack_types import Frame, Sender, TagState, Vector
from estimators.messages import FloatArray, Scan

_NLOS_RX_LOSS, _NLOS_FP_LOSS = 6.0, 15.0
"""What is blocked is weaker, most of all on its first path [dB]."""
Seconds = Annotated[float, Field(ge=0)]
TagPosition = Callable[[int], FloatArray]
"""Stamp [ns] -> where the tag really was, (3,) [m], map frame."""


class Fault(Table):
    """Something goes wrong for a while."""

    at: Seconds = Field(0.0, description="since the first pose of the log [s]")
    duration: float = Field(inf, gt=0, alias="for", description="[s]")

    def active(self, seconds: float) -> bool:
        """Whether it lasts at a time since the first pose [s]."""
        return self.at <= seconds < self.at + self.duration

    def check(self, config: Config) -> None:
        """Compare the fault with the site that it is for.

        Raises:
            ValueError: the site has no such sensor or anchor.
        """
        for name, known in (("sensor", config.sensor), ("anchor", config.anchors)):
            value = getattr(self, name, None)
            if value is not None and value not in known:
                there = ", ".join(map(str, known))
                raise ValueError(f"{name}={value}: the site has no such {name}, there are: {there}")


class ChunkFault(Fault):
    """Changes when, or whether, bytes arrive."""

    def edit_chunk(self, chunk: RawChunk) -> RawChunk | None:
        """The chunk as it arrives; None when it does not."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class Scene:
    """What there was when a frame arrived.

    Attributes:
        stamp_ns: its arrival.
        tag_at: true position of the tag; asked for by faults that need the truth alone.
        config: of the site.
        rng: source of all that is random.
    """

    stamp_ns: int
    tag_at: TagPosition
    config: Config
    rng: np.random.Generator


class FrameFault(Fault):
    """Changes frames of a LinkTrack module."""

    NEEDS_TRUTH: ClassVar[bool] = False

    def edit_frame(self, frame: Frame, scene: Scene) -> Frame:
        """The frame as it would have been.

        Args:
            frame: as it was.
            scene: in which it was sent.
        """
        raise NotImplementedError


class ScanFault(Fault):
    """Changes scans of a LiDAR."""

    def edit_scan(self, scan: Scan) -> Scan:
        """The scan as it would have been."""
        raise NotImplementedError


class Silent(ChunkFault):
    """A sensor sends nothing."""

    sensor: str

    def edit_chunk(self, chunk: RawChunk) -> RawChunk | None:
        """See `ChunkFault`."""
        return None if chunk.source == self.sensor else chunk


class Late(ChunkFault):
    """Bytes of a sensor arrive later than they did."""

    sensor: str
    by: float = Field(0.2, gt=0, le=60, description="[s]")

    def edit_chunk(self, chunk: RawChunk) -> RawChunk | None:
        """See `ChunkFault`."""
        if chunk.source != self.sensor:
            return chunk
        return replace(chunk, stamp_ns=chunk.stamp_ns + round(self.by * 1e9))


class Drop(FrameFault):
    """An anchor is dead: none of its ranges succeeds."""

    anchor: int

    def edit_frame(self, frame: Frame, scene: Scene) -> Frame:
        """See `FrameFault`."""
        del scene
        return change_ranges(frame, lambda anchor, dis: None if anchor == self.anchor else Changed(dis))


class Spike(FrameFault):
    """Single ranges err by much, either way."""

    anchor: int | None = Field(None, description="of one anchor; default: of all")
    size: float = Field(3.0, gt=0, le=1000, description="standard deviation [m]")
    share: float = Field(0.1, gt=0, le=1, description="of ranges that are hit")

    def edit_frame(self, frame: Frame, scene: Scene) -> Frame:
        """See `FrameFault`."""

        def change(anchor: int, dis: float) -> Changed:
            hit = self.anchor in (None, anchor) and scene.rng.random() < self.share
            return Changed(dis + self.size * scene.rng.standard_normal() if hit else dis)

        return change_ranges(frame, change)


class Nlos(FrameFault):
    """Something stands between tag and anchor: ranges too long, signals weaker."""

    anchor: int | None = Field(None, description="one anchor; default: all")
    least: float = Field(0.2, ge=0, le=100, description="least bias [m]")
    mean: float = Field(0.3, ge=0, le=100, description="mean of the exponential bias on top of that [m]")

    def edit_frame(self, frame: Frame, scene: Scene) -> Frame:
        """See `FrameFault`."""

        def change(anchor: int, dis: float) -> Changed:
            if self.anchor not in (None, anchor):
                return Changed(dis)
            return Changed(dis + self.least + scene.rng.exponential(self.mean), _NLOS_RX_LOSS, _NLOS_FP_LOSS)

        return change_ranges(frame, change)


class Moved(FrameFault):
    """An anchor stands elsewhere than the site file says; needs the truth."""

    NEEDS_TRUTH = True
    anchor: int
    x: Coordinate = Field(0.0, description="by so much along the map's x axis [m]")
    y: Coordinate = Field(0.0, description="along y [m]")
    z: Coordinate = Field(0.0, description="upwards [m]")

    def edit_frame(self, frame: Frame, scene: Scene) -> Frame:
        """See `FrameFault`."""
        offset = np.array(scene.config.anchors[self.anchor]) - scene.tag_at(scene.stamp_ns)
        longer = float(np.linalg.norm(offset + np.array([self.x, self.y, self.z])) - np.linalg.norm(offset))
        return change_ranges(
            frame, lambda anchor, dis: Changed(dis + longer if anchor == self.anchor else dis)
        )


class Clock(FrameFault):
    """The module's clock jumps."""

    by: float = Field(ge=-86400, le=86400, description="[s]")

    def edit_frame(self, frame: Frame, scene: Scene) -> Frame:
        """See `FrameFault`."""
        del scene
        if not isinstance(frame, Sender):
            return frame
        return replace(frame, local_time_ms=(frame.local_time_ms + round(self.by * 1000)) % 2**32)


class Rotated(FrameFault):
    """The tag has turned in its mount about the vertical: inertial axes and attitude with it."""

    yaw_deg: float = Field(90.0, ge=-360, le=360, description="counter-clockwise [deg]")

    def edit_frame(self, frame: Frame, scene: Scene) -> Frame:
        """See `FrameFault`."""
        del scene
        if not isinstance(frame, TagState):
            return frame
        yaw = float(np.deg2rad(self.yaw_deg))
        c, s = float(np.cos(yaw)), float(np.sin(yaw))

        def turned(vector: Vector) -> Vector:
            x, y, z = vector
            return c * x + s * y, c * y - s * x, z

        half_c, half_s = float(np.cos(yaw / 2.0)), float(np.sin(yaw / 2.0))
        w, x, y, z = frame.quat_wxyz
        quat_wxyz = (
            w * half_c - z * half_s,
            x * half_c + y * half_s,
            y * half_c - x * half_s,
            z * half_c + w * half_s,
        )
        return replace(frame, gyro=turned(frame.gyro), acc=turned(frame.acc), quat_wxyz=quat_wxyz)


class Blocked(ScanFault):
    """Something hides a sector of the LiDAR's view."""

    from_deg: float = Field(-60.0, ge=-180, le=180, description="counter-clockwise from forward [deg]")
    to_deg: float = Field(
        60.0, ge=-180, le=180, description="the sector goes counter-clockwise to here [deg]"
    )
    distance: float = Field(0.0, ge=0, le=100, description="what is seen instead [m]; 0: nothing")

    def edit_scan(self, scan: Scan) -> Scan:
        """See `ScanFault`."""
        into = (np.rad2deg(scan.angles) - self.from_deg) % 360.0
        hidden = into <= (self.to_deg - self.from_deg) % 360.0
        return replace(scan, ranges=np.where(hidden, self.distance, scan.ranges))


class Gone(ScanFault):
    """The LiDAR turns, and nothing comes back: smoke, glass, open air."""

    share: float = Field(1.0, gt=0, le=1, description="of the beams, spread evenly")

    def edit_scan(self, scan: Scan) -> Scan:
        """See `ScanFault`."""
        number = np.arange(len(scan.ranges))
        lost = np.floor((number + 1) * self.share) > np.floor(number * self.share)
        return replace(scan, ranges=np.where(lost, 0.0, scan.ranges))


KINDS: Mapping[str, type[Fault]] = {
    "silent": Silent,
    "late": Late,
    "drop": Drop,
    "spike": Spike,
    "nlos": Nlos,
    "moved": Moved,
    "clock": Clock,
    "rotated": Rotated,
    "blocked": Blocked,
    "gone": Gone,
}
"""Name on the command line -> fault."""


def parse_fault(text: str, config: Config) -> Fault:
    """A fault as the command line writes it.

    Args:
        text: KIND:key=value,key=value.
        config: of the site that it is for.

    Raises:
        UserError: unknown kind, key, sensor or anchor, or a bad value.
    """
    kind, _, rest = text.partition(":")
    if kind not in KINDS:
        raise UserError(f"--fault {text}: unknown kind {kind!r}, there are: {', '.join(KINDS)}")
    pairs = [item.partition("=") for item in rest.split(",") if item]
    for key, equals, _ in pairs:
        if not equals:
            raise UserError(f"--fault {text}: {key!r} is no key=value")
    fault = validated(KINDS[kind], {key: value for key, _, value in pairs}, f"--fault {text}")
    try:
        fault.check(config)
    except ValueError as error:
        raise UserError(f"--fault {text}: {error}") from error
    return fault


def library(config: Config) -> list[str]:
    """One fault of every sort, as texts for a site: what an estimator should survive."""
    first, *_ = config.anchors
    uwb = [name for name, table in config.sensor.items() if table.driver == "linktrack"]
    lidar = [name for name, table in config.sensor.items() if table.driver == "rplidar"]
    faults = []
    for name in uwb:
        faults += [
            f"silent:sensor={name},at=15,for=5",
            f"late:sensor={name},by=0.2,at=15,for=5",
            f"drop:anchor={first},at=15",
            "spike:at=15,for=10",
            "nlos:at=15,for=5",
            f"nlos:anchor={first},at=15",
            f"moved:anchor={first},x=0.5,at=15",
            "clock:by=-3600,at=15",
            "clock:by=0.5,at=15",
            "rotated:at=15",
        ]
    for name in lidar:
        faults += [
            f"silent:sensor={name},at=15,for=0.25",
            f"silent:sensor={name},at=15,for=5",
            f"late:sensor={name},by=0.2,at=15,for=5",
            "blocked:at=15,for=10",
            "blocked:distance=0.3,at=15,for=10",
            "gone:at=15,for=5",
        ]
    return faults
