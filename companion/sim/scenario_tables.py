"""Further tables of scenario files: random obstacles, gait, measurements without bytes, published figures."""

from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from companion.checked_toml import Table
from companion.config_tables import Coordinate
from estimators.immutable import immutable
from estimators.messages import FloatArray

Box = tuple[float, float, float, float, float, float]
Interval = tuple[Coordinate, Coordinate]
Seconds = Annotated[float, Field(ge=0, le=86_400)]
Figure = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class RandomBoxesTable(Table):
    """Obstacles that stand somewhere else in every trial."""

    count: int = Field(ge=1, le=100)
    x: Interval = Field(description="least and greatest x of a centre [m], map frame")
    y: Interval = Field(description="the same for y [m]")
    side: Interval = Field((0.3, 0.6), description="least and greatest length of a side [m]")
    height: float = Field(2.5, gt=0, le=10, description="[m]")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name in ("x", "y", "side"):
            least, greatest = getattr(self, name)
            if least > greatest:
                raise ValueError(f"{name}: least {least:g} is above greatest {greatest:g}")
        if self.side[0] <= 0.0:
            raise ValueError(f"side: a length must be above 0, got {self.side[0]:g}")
        return self

    def draw(self, rng: np.random.Generator) -> list[Box]:
        """Boxes (centre x, centre y, length x, length y [m], yaw [rad], height [m]) of one trial."""
        return [
            (
                rng.uniform(*self.x),
                rng.uniform(*self.y),
                rng.uniform(*self.side),
                rng.uniform(*self.side),
                rng.uniform(0.0, np.pi),
                self.height,
            )
            for _ in range(self.count)
        ]


class RandomWaypointsTable(Table):
    """Corners that lie somewhere else in every trial, and with them the start and its heading."""

    count: int = Field(ge=2, le=1000)
    x: Interval = Field(description="least and greatest x of a corner [m], map frame")
    y: Interval = Field(description="the same for y [m]")
    least_leg: float = Field(1.0, ge=0, le=100, description="least length of a leg [m]")

    @model_validator(mode="after")
    def _room_for_a_leg(self) -> Self:
        room = float(np.hypot(self.x[1] - self.x[0], self.y[1] - self.y[0]))
        if self.x[0] > self.x[1] or self.y[0] > self.y[1] or room < 2.0 * self.least_leg:
            raise ValueError(
                f"least_leg: x and y must leave room for legs twice as long as {self.least_leg:g} m, "
                f"their diagonal is {room:g} m"
            )
        return self

    def draw(self, rng: np.random.Generator) -> list[tuple[float, float]]:
        """Corners (x, y) [m] of one trial."""
        corners: list[tuple[float, float]] = []
        while len(corners) < self.count:
            corner = rng.uniform(*self.x), rng.uniform(*self.y)
            if not corners or np.hypot(*np.subtract(corner, corners[-1])) >= self.least_leg:
                corners.append(corner)
        return corners


class KidnapTable(Table):
    """The robot is picked up and set down elsewhere, in an instant; then it walks on as if nothing had been.

    Scans show it. In a scenario with `[increments]` the odometry either notices and begins anew, or not.
    """

    at: float = Field(gt=0, description="since the walk began [s]")
    to: tuple[Coordinate, Coordinate, float] | None = Field(
        None, description="x [m], y [m], yaw [deg] where it is set down; without: anywhere"
    )
    x: Interval | None = Field(None, description="without `to`: the rest of the walk stays between [m]")
    y: Interval | None = Field(None, description="the same for y [m]")
    noticed: bool = Field(True, description="whether an odometry of `[increments]` begins anew")

    @model_validator(mode="after")
    def _somewhere(self) -> Self:
        if self.to is None and (self.x is None or self.y is None):
            raise ValueError("to: give a pose, or x and y between which to draw one")
        return self


@immutable
class Blockade:
    """Anchors that are not seen for a while.

    Attributes:
        blocked: (A,) True for these, in the order of the site file.
        begin: since the walk began [s].
        end: likewise.
    """

    blocked: NDArray[np.bool_]
    begin: float
    end: float


class NlosTable(Table):
    """Something that no LiDAR sees stands before some anchors for a while; others in every trial."""

    anchors: int = Field(ge=1, description="how many at once")
    at: tuple[Seconds, Seconds] = Field(description="begins between these times since the walk began [s]")
    duration: float = Field(10.0, gt=0, le=3600, description="[s]")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.at[0] > self.at[1]:
            raise ValueError(f"at: earliest {self.at[0]:g} is above latest {self.at[1]:g}")
        return self

    def draw(self, anchors: int, rng: np.random.Generator) -> Blockade:
        """What is blocked, of so many anchors, in one trial."""
        begin = rng.uniform(*self.at)
        blocked = np.isin(np.arange(anchors), rng.permutation(anchors)[: self.anchors])
        return Blockade(blocked, begin, begin + self.duration)


class GaitTable(Table):
    """How a legged robot's body moves about its straight way while it walks; its phase is random."""

    frequency: float = Field(2.0, gt=0, le=20, description="strides a second [Hz]")
    sway: float = Field(0.01, ge=0, le=0.5, description="amplitude to the left and right [m]")
    yaw_deg: float = Field(1.0, ge=0, le=45, description="amplitude of the heading [deg]")


class DivergenceTable(Table):
    """A part of the floor where the odometry slips, as a matcher does that finds no structure."""

    x: Interval = Field(description="least and greatest x [m], map frame")
    y: Interval = Field(description="the same for y [m]")
    slip_sigma: float = Field(
        gt=0, le=1, description="false shift along each axis of the map for every metre walked, a trial's"
    )

    def holds(self, pose: FloatArray) -> bool:
        """Whether a pose (3,) is in it."""
        return bool(self.x[0] <= pose[0] <= self.x[1] and self.y[0] <= pose[1] <= self.y[1])


class IncrementsTable(Table):
    """Odometry increments in place of a LiDAR. A scenario with this table has no bytes and no scans.

    Noise is drawn anew at every step, along the axes of the map: what a scan matcher lacks is structure of
    the room. Drift is drawn once a trial.
    """

    rate: float = Field(10.0, ge=1, le=200, description="increments (steps) a second [Hz]")
    sigma_x: float = Field(0.01, gt=0, le=1, description="noise of a step along the map's x axis [m]")
    sigma_y: float = Field(0.01, gt=0, le=1, description="noise of a step along the map's y axis [m]")
    sigma_yaw_deg: float = Field(0.1, gt=0, le=45, description="noise of a step's turn [deg]")
    scale_sigma: float = Field(0.0, ge=0, le=0.5, description="relative error of every length, a trial's")
    yaw_drift_deg: float = Field(
        0.0, ge=0, le=45, description="false turn for every metre walked, a trial's [deg/m]"
    )
    diverging: list[DivergenceTable] = Field([], description="where it slips")


class InertialTable(Table):
    """Inertial sensor at the tag, with an attitude filter of its own, in a scenario with `[increments]`.

    Bias and tilt are drawn once a trial. Its heading counts from where it was switched on, and wanders.
    """

    rate: float = Field(50.0, ge=1, le=1000, description="samples and attitudes a second [Hz]")
    accel_sigma: float = Field(0.05, ge=0, le=10, description="noise of an acceleration [m/s^2]")
    accel_bias: float = Field(0.05, ge=0, le=10, description="standard deviation of the bias [m/s^2]")
    gyro_sigma: float = Field(0.01, ge=0, le=10, description="noise of a turn rate [rad/s]")
    tilt_sigma_deg: float = Field(0.3, ge=0, le=45, description="error of roll and of pitch [deg]")
    heading_walk_deg: float = Field(0.1, ge=0, le=45, description="walk of the heading [deg/sqrt(s)]")


class LandmarksTable(Table):
    """Known landmarks, seen whole or not at all, in a scenario with `[increments]`."""

    positions: list[tuple[Coordinate, Coordinate]] = Field(min_length=1, description="[m], map frame")
    rate: float = Field(10.0, ge=1, le=200, description="looks a second [Hz]")
    range_sigma: float = Field(0.03, gt=0, le=10, description="[m]")
    bearing_sigma_deg: float = Field(0.7, gt=0, le=90, description="[deg]")
    max_range: float = Field(8.0, gt=0, le=1000, description="[m]")


class PaperLeg(Table):
    """What a publication states of one estimator on one leg."""

    rmse_m: Figure | None = None
    max_m: Figure | None = None


class PaperFigures(Table):
    """What a publication states of one estimator, under the names of our own figures."""

    rmse_m: Figure | None = None
    max_m: Figure | None = None
    rmse_x_m: Figure | None = None
    rmse_y_m: Figure | None = None
    max_x_m: Figure | None = None
    max_y_m: Figure | None = None
    legs: dict[str, PaperLeg] = Field({}, description="by the name of the leg")


class PaperTable(Table):
    """Published figures, shown beside ours."""

    source: str
    estimators: dict[str, PaperFigures] = Field({}, description="by the name of our estimator that is meant")
