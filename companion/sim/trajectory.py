"""A robot that walks from corner to corner: straight legs, turns on the spot, gentle starts and stops."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from estimators.geometry import compose, rotation, wrap_angle, wrap_angles
from estimators.messages import FloatArray


@dataclass(frozen=True, slots=True)
class Motion:
    """What the robot does at given times.

    Attributes:
        pose: (N, 3) x [m], y [m], yaw [rad], map frame.
        yaw_rate: (N,) [rad/s].
        accel: (N,) forward acceleration [m/s^2].
    """

    pose: FloatArray
    yaw_rate: FloatArray
    accel: FloatArray


@dataclass(frozen=True, slots=True)
class _Leg:
    """One straight leg or one turn, along a trapezoid of speed."""

    begin: float
    start: FloatArray
    length: float  # metres, or radians of a turn
    top_speed: float
    accel: float
    is_turn: bool

    @property
    def _ramp(self) -> float:
        return min(self.top_speed / self.accel, float(np.sqrt(abs(self.length) / self.accel)))

    @property
    def duration(self) -> float:
        return abs(self.length) / (self.accel * self._ramp) + self._ramp if self.length else 0.0

    def profile(self, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Distance, speed and acceleration at times since the leg began."""
        ramp, total, sign = self._ramp, self.duration, np.sign(self.length)
        up = np.clip(t, 0.0, ramp)
        down = np.clip(t - (total - ramp), 0.0, ramp)
        cruise = np.clip(t - ramp, 0.0, max(total - 2.0 * ramp, 0.0))
        top = self.accel * ramp
        distance = 0.5 * self.accel * up**2 + top * cruise + top * down - 0.5 * self.accel * down**2
        speed = self.accel * (up - down)
        moving = (t > 0.0) & (t < total)
        accel = self.accel * (((t < ramp) & moving) * 1.0 - ((t > total - ramp) & moving) * 1.0)
        return sign * distance, sign * speed, sign * accel


class Trajectory:
    """Poses over time of a robot that rests, walks through waypoints, and rests again.

    Args:
        waypoints: corners (x, y) [m], map frame.
        laps: how often the closed path is walked; 0 leaves it open.
        speed: walking speed [m/s].
        accel: acceleration [m/s^2].
        turn_rate: turning rate [rad/s]; its ramp takes half a second.
        rest: time at rest before and after [s].
        placement: (3,) where the start pose really is, seen from where it should be.
    """

    def __init__(
        self,
        waypoints: list[tuple[float, float]],
        laps: int,
        speed: float,
        accel: float,
        turn_rate: float,
        rest: float,
        placement: FloatArray,
    ) -> None:
        corners = np.array(waypoints, dtype=np.float64)
        path = np.vstack([*([corners] * laps), corners[:1]]) if laps else corners
        headings = [float(np.arctan2(b[1] - a[1], b[0] - a[0])) for a, b in pairwise(path)]
        self.start = np.array([*path[0], headings[0]])
        """(3,) pose where the robot should stand at the start, map frame."""
        self._placement = placement
        self._legs: list[_Leg] = []
        clock = rest
        for i, heading in enumerate(headings):
            if i:
                turn = wrap_angle(heading - headings[i - 1])
                start = np.array([*path[i], headings[i - 1]])
                clock = self._append(_Leg(clock, start, turn, turn_rate, 2.0 * turn_rate, True))
            length = float(np.hypot(*(path[i + 1] - path[i])))
            start = np.array([*path[i], heading])
            clock = self._append(_Leg(clock, start, length, speed, accel, False))
        self._begins = np.array([leg.begin for leg in self._legs])
        self.duration = clock + rest
        """Time from the first rest to the end of the last [s]."""

    @property
    def legs(self) -> list[tuple[float, float]]:
        """Begin and end of every straight leg [s]."""
        return [(leg.begin, leg.begin + leg.duration) for leg in self._legs if not leg.is_turn]

    def _append(self, leg: _Leg) -> float:
        self._legs.append(leg)
        return leg.begin + leg.duration

    def at(self, times: FloatArray) -> Motion:
        """Motion at times (N,) [s] since the start; before and after it the robot stands still."""
        times = np.asarray(times, dtype=np.float64)
        pose = np.broadcast_to(self.start, (len(times), 3)).copy()
        yaw_rate, accel = np.zeros(len(times)), np.zeros(len(times))
        leg_index = np.searchsorted(self._begins, times, side="right") - 1
        for index in np.unique(leg_index[leg_index >= 0]):
            here = leg_index == index
            leg = self._legs[int(index)]
            distance, rate, change = leg.profile(times[here] - leg.begin)
            if leg.is_turn:
                pose[here] = leg.start
                pose[here, 2] += distance
                yaw_rate[here] = rate
            else:
                heading = leg.start[2]
                pose[here, 0] = leg.start[0] + distance * np.cos(heading)
                pose[here, 1] = leg.start[1] + distance * np.sin(heading)
                pose[here, 2] = heading
                accel[here] = change
        return Motion(self._displace(pose), yaw_rate, accel)

    def _displace(self, pose: FloatArray) -> FloatArray:
        """Move the whole path with the start, as a robot does that was set down not quite right."""
        real_start = compose(self.start, self._placement)
        turn = self._placement[2]
        moved = np.empty_like(pose)
        moved[:, :2] = (pose[:, :2] - self.start[:2]) @ rotation(turn).T + real_start[:2]
        moved[:, 2] = wrap_angles(pose[:, 2] + turn)
        return moved
