"""A walk on legs: the body sways and turns about its straight way."""

import numpy as np

from companion.sim.scenario_tables import GaitTable
from companion.sim.trajectory import Motion, Trajectory
from estimators.geometry import transform_each, wrap_angles
from estimators.messages import FloatArray

FADE = 0.5
"""The sway grows and dies for so long at the ends of the walk [s]."""


class GaitTrajectory:
    """A `Trajectory` with the sway of a gait on top; forward acceleration stays that of the straight way.

    Args:
        straight: the way.
        rest: time at rest before and after the walk [s].
        gait: amplitudes and frequency.
        rng: draws the phases.
    """

    def __init__(self, straight: Trajectory, rest: float, gait: GaitTable, rng: np.random.Generator) -> None:
        self._straight = straight
        self._begin, self._end = rest, straight.duration - rest
        self._amplitude = np.array([gait.sway, np.deg2rad(gait.yaw_deg)])
        self._frequency = gait.frequency
        self._phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        self.start = straight.start
        """(3,) pose where the robot should stand at the start, map frame."""
        self.duration = straight.duration
        """Time from the first rest to the end of the last [s]."""
        self.legs = straight.legs
        """Begin and end of every leg [s]."""

    def at(self, times: FloatArray) -> Motion:
        """Motion at times (N,) [s] since the start; before and after it the robot stands still."""
        times = np.asarray(times, dtype=np.float64)
        straight = self._straight.at(times)
        sway, turn = self._sway(times)
        pose = straight.pose.copy()
        pose[:, :2] = transform_each(pose, np.column_stack([np.zeros(len(times)), sway]))
        pose[:, 2] = wrap_angles(pose[:, 2] + turn)
        dt = 1e-3
        turn_rate = (self._sway(times + dt)[1] - self._sway(times - dt)[1]) / (2.0 * dt)
        return Motion(pose, straight.yaw_rate + turn_rate, straight.accel)

    def _sway(self, times: FloatArray) -> FloatArray:
        """Offset to the left [m] and of the heading [rad], (2, N)."""
        since, until = times - self._begin, self._end - times
        envelope = np.clip(since / FADE, 0.0, 1.0) * np.clip(until / FADE, 0.0, 1.0)
        phase = 2.0 * np.pi * self._frequency * since + self._phase[:, None]
        swayed: FloatArray = self._amplitude[:, None] * envelope * np.sin(phase)
        return swayed
