"""Heading of the map from the autopilot's compass: once, when the operator asks for it."""

import numpy as np

from estimators.geometry import wrap_angle

COLLECT_NS = 2_000_000_000
LEAST_SAMPLES = 5
MAX_SPREAD = np.deg2rad(10.0)
"""Standard deviation of the headings that are averaged, above which they are not believed."""


class CompassAlignment:
    """Averages the map's heading over a moment of standing still.

    The autopilot's heading is h - yaw when the map's x axis has the heading h, so h is the sum of both.

    Attributes:
        heading: compass heading of the map's x axis [rad], None until it was found.
        outcome: one line for the operator when an attempt is over; empty until then.
    """

    def __init__(self) -> None:
        self.heading: float | None = None
        self.outcome = ""
        self._begin_ns: int | None = None
        self._sums: list[float] = []

    def begin(self, now_ns: int) -> None:
        """Start an attempt."""
        self._begin_ns, self._sums, self.outcome = now_ns, [], ""

    def add(self, autopilot_yaw: float, map_yaw: float, now_ns: int) -> None:
        """Take a heading of the autopilot, clockwise from north, and ours in the map [rad]."""
        if self._begin_ns is None:
            return
        self._sums.append(autopilot_yaw + map_yaw)
        if now_ns - self._begin_ns < COLLECT_NS or len(self._sums) < LEAST_SAMPLES:
            return
        self._begin_ns = None
        mean = complex(np.mean(np.exp(1j * np.array(self._sums))))
        # Standard deviation of a wrapped normal distribution, from the length of its mean.
        spread = float(np.sqrt(-2.0 * np.log(min(max(abs(mean), 1e-12), 1.0))))
        if spread > MAX_SPREAD:
            self.outcome = f"compass unsteady by {np.rad2deg(spread):.0f} deg: not aligned"
            return
        self.heading = wrap_angle(float(np.angle(mean)))
        self.outcome = f"map heading {np.rad2deg(self.heading) % 360.0:.1f} deg by compass"
