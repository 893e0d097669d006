"""Which landmarks of a look can be used at all: shared by all filters that know them beforehand."""

from math import isfinite

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from estimators import chi2
from estimators.base import Setup, Verdict
from estimators.messages import FloatArray, LandmarkFrame

_LEAST_SIGMA, _MOST = 1e-6, 1e6
"""What is nearer to nothing or larger [m, rad] is a fault of the sensor."""


class LandmarkGate:
    """Known landmarks, and the NIS that a range or bearing to one may have."""

    class Config(BaseModel):
        """Settings of every filter on landmarks."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        landmark_gate: float = Field(
            0.99999, gt=0.5, lt=1, description="share of good landmark ranges and bearings that pass"
        )

    def __init__(self, config: Config, setup: Setup) -> None:
        self.limit = float(chi2.ppf(config.landmark_gate, 1))
        self._positions = {i: tuple(position.tolist()) for i, position in setup.landmarks.items()}

    def usable(self, frame: LandmarkFrame) -> FloatArray | Verdict:
        """Rows (L, 6) of (x, y, range, bearing, their sigmas), map frame, or what is wrong with the look."""
        seen = zip(frame.landmark_ids.tolist(), frame.ranges.tolist(), frame.bearings.tolist(), strict=True)
        known = [
            (*self._positions[i], r, b, frame.range_sigma, frame.bearing_sigma)
            for i, r, b in seen
            if i in self._positions
        ]
        if not known:
            return Verdict.NOT_USED
        rows = [row for row in known if _is_possible(*row[2:])]
        return np.array(rows) if rows else Verdict.IMPOSSIBLE


def _is_possible(distance: float, bearing: float, range_sigma: float, bearing_sigma: float) -> bool:
    """Whether a landmark's numbers are numbers of this world."""
    return (
        0.0 < distance < _MOST
        and isfinite(bearing)
        and _LEAST_SIGMA < range_sigma < _MOST
        and _LEAST_SIGMA < bearing_sigma < _MOST
    )
