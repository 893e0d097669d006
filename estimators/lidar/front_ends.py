"""What can turn scans into increments, by name."""

from typing import Any, Protocol, cast

from pydantic import BaseModel

from estimators.lidar.ekf_slam import EkfSlam
from estimators.lidar.scan_matching import ScanMatcher
from estimators.lidar.scan_preparation import ScanPreparation
from estimators.messages import FloatArray, Measurement, PoseIncrement


class ScanFrontEnd(Protocol):
    """Turns scans into increments, and leaves the newest scan as it was seen from the end of it.

    Attributes:
        points: (N, 2) [m] of the newest scan, in the body frame at its end.
        points_cov: (3, 3) where among points the body was: x, y [m], yaw [rad].
        refused: scans that fitted nothing known, so that tracking began anew.
    """

    points: FloatArray
    points_cov: FloatArray
    refused: int

    def update(self, measurement: Measurement) -> PoseIncrement | None:
        """Increment up to the end of a scan; None when it gives none."""
        ...


FRONT_ENDS: dict[str, type[EkfSlam] | type[ScanMatcher]] = {"ekf_slam": EkfSlam, "scan_matcher": ScanMatcher}
"""Name of the front end, and of the table with its settings -> class with a nested pydantic `Config`."""


def make_scan_front_end(
    name: str, config: BaseModel, T_body_lidar: FloatArray, preparation: ScanPreparation.Config
) -> ScanFrontEnd:
    """New front end of the given name.

    Args:
        name: a key of `FRONT_ENDS`.
        config: instance of its `Config`.
        T_body_lidar: (3,) mounting of the lidar in the body: x [m], y [m], yaw [rad].
        preparation: what is done with the points beforehand.
    """
    make: Any = FRONT_ENDS[name]
    return cast("ScanFrontEnd", make(config, T_body_lidar, preparation))
