"""Further tables of scenario files: random obstacles, gait, measurements without bytes, published figures."""

from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from companion.config import Coordinate, Table
from estimators.messages import FloatArray

Box = tuple[float, float, float, float, float, float]
Interval = tuple[Coordinate, Coordinate]
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
