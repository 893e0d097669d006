"""Settings that every user of a motion model has."""

from pydantic import BaseModel, ConfigDict, Field


class WhiteAcceleration(BaseModel):
    """How the robot's velocity wanders, see `estimators.models.motion.constant_velocity`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    accel_noise: float = Field(
        0.5,
        gt=0,
        le=100,
        description="density of white acceleration [m/s^2/sqrt(Hz)]: about the robot's acceleration "
        "times the square root of how long it lasts",
    )
    yaw_accel_noise: float = Field(
        1.5,
        gt=0,
        le=100,
        description="density of white angular acceleration [rad/s^2/sqrt(Hz)], likewise",
    )


class MotionInScans(WhiteAcceleration):
    """Of what makes increments of scans, see `estimators.models.motion.smooth_motion`."""

    bandwidth: float = Field(
        2.0,
        gt=0,
        le=50,
        description="the fastest swaying, as of a gait, that scans are deskewed for [Hz]",
    )
    range_sigma: float = Field(0.015, gt=0, le=1, description="least standard deviation of a LiDAR range [m]")
    min_points: int = Field(40, ge=10, le=10000, description="scans with fewer returns are skipped")
