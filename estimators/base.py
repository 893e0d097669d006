"""What every estimator offers, and what it says of each measurement."""

from dataclasses import field
from enum import StrEnum
from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np

from estimators.immutable import immutable
from estimators.lidar.floor_map import FloorMap
from estimators.lidar.scan_preparation import ScanPreparation
from estimators.messages import FloatArray, Measurement, PoseEstimate
from estimators.models.range_bias import BearingBias


class Verdict(StrEnum):
    """What became of one scalar or vector measurement."""

    ACCEPTED = "accepted"
    GATED = "gated"
    """Too far from the prediction (NIS above the gate)."""
    CONTRADICTS = "contradicts"
    """Its anchor's ranges have erred on average while those of others agreed: it may have been moved."""
    SUSPECT = "suspect"
    """Near the prediction, but its anchor was blocked a moment ago and probably still is."""
    TOO_LONG = "NLOS: longer than predicted"
    """Its anchor is probably blocked, and this range is too long for the pose."""
    WEAK_FIRST_PATH = "NLOS: weak first path"
    """Its anchor is probably blocked, and its first path is much weaker than all that was received."""
    OBSTRUCTED = "NLOS: obstacle in the line of sight"
    """Its anchor is probably blocked, and the LiDAR sees an obstacle on the way to it."""
    DOWNWEIGHTED = "down-weighted"
    """Used, though with a larger sigma: it is more likely too long than not."""
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
    WAITING = "waiting"
    """The pose is not known yet; the measurement is kept for finding it."""
    AMBIGUOUS = "ambiguous"
    """The usable anchors of the frame are too few or in line, and two positions fit alike."""
    NOT_USED = "not used"
    """This estimator has no use for such a measurement."""

    __hash__ = str.__hash__  # that of enumerations is slow, and unequal for equal strings

    @property
    def is_nlos(self) -> bool:
        """Whether a range was rejected because something probably blocks it."""
        return self in _NLOS

    @property
    def is_used(self) -> bool:
        """Whether the measurement changed the estimate."""
        return self in _USED


_NLOS = frozenset({Verdict.SUSPECT, Verdict.TOO_LONG, Verdict.WEAK_FIRST_PATH, Verdict.OBSTRUCTED})
_USED = frozenset({Verdict.ACCEPTED, Verdict.DOWNWEIGHTED})

_EMPTY = np.empty(0)
_NO_POSES = np.empty((0, 3))


@immutable
class Report:
    """What an estimator did with one measurement.

    Attributes:
        verdicts: one per range of a RangeFrame, else one.
        residuals: like `verdicts`; measured minus predicted [m] for ranges, NaN where there is none.
        nis: like `verdicts`; normalised innovation squared, NaN where there is none.
        note: what the estimator lacks for a pose, for operator and pilot: at most 35 characters, the room
            in a text to the pilot; empty when it has one.
        iterations: steps of an iterative solver; None where none was at work.
    """

    verdicts: tuple[Verdict, ...]
    residuals: FloatArray = field(default_factory=lambda: _EMPTY)
    nis: FloatArray = field(default_factory=lambda: _EMPTY)
    note: str = ""
    iterations: int | None = None


@immutable
class Start:
    """Where the robot stands when the process starts, as the operator placed it.

    Attributes:
        pose: (3,) x [m], y [m], yaw [rad] of the body in the map.
        sigma: (3,) standard deviations of the same.
        still_for: the robot stands there until odometry begins, at most this long [s].
        known: False when the robot may stand anywhere and the pose must be found; `pose` means nothing then.
    """

    pose: FloatArray
    sigma: FloatArray
    still_for: float = 0.0
    known: bool = True


@immutable
class Setup:
    """Geometry that the site file states and every estimator needs.

    Attributes:
        anchors: anchor id -> position (3,) [m], map frame.
        tag_in_body: (3,) tag antenna in the body frame [m], of every tag that `tags` does not name.
        start: pose at the start.
        height: height of the body origin above the map's floor [m].
        height_sigma: standard deviation of `height` [m].
        level_sigma: standard deviation of roll and pitch [rad] of a robot that walks level.
        landmarks: landmark id -> position (2,) [m], map frame; those that are known beforehand.
        walls: polylines (N, 2) [m], map frame.
        lidar_in_body: (3,) x [m], y [m], yaw [rad] of the LiDAR in the body frame.
        floor_map: made on an earlier visit, with at least one obstacle; None without.
        scan_preparation: what is done with scans beforehand.
        tags: tag id -> antenna (3,) in the body frame [m], of further tags on the same robot.
        bearing_biases: tag id -> bias of its ranges by direction, for those who know a heading to take off.
    """

    anchors: dict[int, FloatArray]
    tag_in_body: FloatArray
    start: Start
    height: float
    height_sigma: float
    level_sigma: float
    landmarks: dict[int, FloatArray] = field(default_factory=dict)
    walls: list[FloatArray] = field(default_factory=list)
    lidar_in_body: FloatArray = field(default_factory=lambda: np.zeros(3))
    floor_map: FloorMap | None = None
    scan_preparation: ScanPreparation.Config = field(default_factory=ScanPreparation.Config)
    tags: dict[int, FloatArray] = field(default_factory=dict)
    bearing_biases: dict[int, BearingBias] = field(default_factory=dict)

    def arm(self, tag_id: int) -> FloatArray:
        """Antenna of a tag in the body frame, (3,) [m]."""
        return self.tags.get(tag_id, self.tag_in_body)

    def height_to(self, anchor: FloatArray) -> float:
        """Height of an anchor above the tag [m]."""
        return float(anchor[2] - self.height - self.tag_in_body[2])

    def lift_covariance(self, planar: FloatArray) -> FloatArray:
        """Covariance (6, 6) of PoseEstimate from that of (x, y, yaw), (3, 3)."""
        cov = np.zeros((6, 6))
        cov[:2, :2], cov[5, 5] = planar[:2, :2], planar[2, 2]
        cov[:2, 5], cov[5, :2] = planar[:2, 2], planar[2, :2]
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


Taken: TypeAlias = frozenset[type[Measurement]] | None
"""Types of measurements; None stands for all."""


@runtime_checkable
class Selective(Estimator, Protocol):
    """An estimator that says what it has a use for: it need not be given anything else."""

    @property
    def takes(self) -> Taken:
        """What may change what it says, ranges always among them."""
        ...


def taken_by(estimator: Estimator) -> Taken:
    """What an estimator has a use for, as far as it says so."""
    return estimator.takes if isinstance(estimator, Selective) else None


@immutable
class Sketch:
    """What an estimator holds besides its pose, for pictures.

    Attributes:
        particles: (N, 3) x [m], y [m], yaw [rad] in the map; empty for an estimator without.
        window: (M, 3) the same of the poses that are still being estimated.
        keyframes: (K, 3) the same of those to which later scans are matched.
    """

    particles: FloatArray = field(default_factory=lambda: _NO_POSES)
    window: FloatArray = field(default_factory=lambda: _NO_POSES)
    keyframes: FloatArray = field(default_factory=lambda: _NO_POSES)


@runtime_checkable
class Sketched(Protocol):
    """An estimator that can show what it holds."""

    def sketch(self) -> Sketch | None:
        """Copies of what it holds now; None when there is nothing to show."""
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
