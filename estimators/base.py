"""What every estimator offers, and what it says of each measurement."""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol, runtime_checkable

import numpy as np

from estimators.messages import PLANAR, FloatArray, Measurement, PoseEstimate


class Verdict(StrEnum):
    """What became of one scalar or vector measurement."""

    ACCEPTED = "accepted"
    GATED = "gated"
    """Too far from the prediction (NIS above the gate)."""
    SUSPECT = "suspect"
    """Near the prediction, but its anchor was gated a moment ago: it may still be blocked."""
    UNKNOWN_ANCHOR = "unknown anchor"
    """The site file has no anchor with this id."""
    IMPOSSIBLE = "impossible"
    """Not finite, not positive, or shorter than the height difference to the anchor."""
    TOO_FEW = "too few"
    """Not enough usable ranges in the frame for a position."""
    NO_REFERENCE = "no reference"
    """The increment starts at a pose that the estimator does not hold."""
    LATE = "late"
    """Older than what was already processed."""
    NOT_USED = "not used"
    """This estimator has no use for such a measurement."""


_EMPTY = np.empty(0)


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """What an estimator did with one measurement.

    Attributes:
        verdicts: one per range of a RangeFrame, else one.
        residuals: like `verdicts`; measured minus predicted [m] for ranges, NaN where there is none.
        nis: like `verdicts`; normalised innovation squared, NaN where there is none.
        iterations: steps of an iterative solver; None where none was at work.
    """

    verdicts: tuple[Verdict, ...]
    residuals: FloatArray = field(default_factory=lambda: _EMPTY)
    nis: FloatArray = field(default_factory=lambda: _EMPTY)
    iterations: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Where the robot stands when the process starts, as the operator placed it.

    Attributes:
        pose: (3,) x [m], y [m], yaw [rad] of the body in the map.
        sigma: (3,) standard deviations of the same.
        still_for: the robot stands there until odometry begins, at most this long [s].
    """

    pose: FloatArray
    sigma: FloatArray
    still_for: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """Geometry that the site file states and every estimator needs.

    Attributes:
        anchors: anchor id -> position (3,) [m], map frame.
        tag_in_body: (3,) tag antenna in the body frame [m].
        start: pose at the start.
        height: height of the body origin above the map's floor [m].
        height_sigma: standard deviation of `height` [m].
        level_sigma: standard deviation of roll and pitch [rad] of a robot that walks level.
        landmarks: landmark id -> position (2,) [m], map frame; those that are known beforehand.
    """

    anchors: dict[int, FloatArray]
    tag_in_body: FloatArray
    start: Start
    height: float
    height_sigma: float
    level_sigma: float
    landmarks: dict[int, FloatArray] = field(default_factory=dict)

    def height_to(self, anchor: FloatArray) -> float:
        """Height of an anchor above the tag [m]."""
        return float(anchor[2] - self.height - self.tag_in_body[2])

    def lift_covariance(self, planar: FloatArray) -> FloatArray:
        """Covariance (6, 6) of PoseEstimate from that of (x, y, yaw), (3, 3)."""
        cov = np.zeros((6, 6))
        cov[PLANAR] = planar
        cov[2, 2] = self.height_sigma**2
        cov[3, 3] = cov[4, 4] = self.level_sigma**2
        return cov


class Estimator(Protocol):
    """Turns measurements, given in stamp order, into poses.

    A class beside its nested pydantic `Config`, built as ``Class(config, setup)``. No I/O, no clock.
    Bad data gets a Verdict; it never raises.
    """

    def reset(self) -> None:
        """Forget everything but configuration and setup."""
        ...

    def update(self, measurement: Measurement) -> Report:
        """Take one measurement; older than the newest processed gets `Verdict.LATE`."""
        ...

    def pose_at(self, stamp_ns: int) -> PoseEstimate | None:
        """Pose at a time near the newest measurement, without changing the state; None when unknown."""
        ...


@runtime_checkable
class Settable(Estimator, Protocol):
    """An estimator that can be told where the robot is."""

    def start_at(self, stamp_ns: int, pose: FloatArray, cov: FloatArray) -> None:
        """Forget the past: at this moment the robot is here, and moves freely from then on.

        Args:
            stamp_ns: the moment; it may be earlier than measurements already taken.
            pose: (3,) x [m], y [m], yaw [rad] of the body, map frame.
            cov: (3, 3) covariance of the same.
        """
        ...
