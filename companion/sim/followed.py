"""The walk of a vehicle that somebody else moves: what was heard of it, and a little beyond."""

import threading
from collections import deque

import numpy as np

from companion.sim.trajectory import Motion
from estimators.geometry import wrap_angle, wrap_angles
from estimators.messages import FloatArray

KEPT = 4000
"""Poses that are remembered: more than a minute at 50 Hz."""
SLOPE_OVER = 0.1
"""Time over which the speed for what comes next is taken [s]: a position comes in steps of a centimetre."""
LONGEST_AHEAD = 0.5
"""A vehicle that is not heard of for longer is taken to stand [s]."""


class FollowedTrajectory:
    """Poses by time, as they are heard; read by the threads of the emulated sensors.

    Args:
        start: (3,) x [m], y [m], yaw [rad] before anything is heard, map frame.
    """

    duration = float("inf")

    def __init__(self, start: FloatArray) -> None:
        self.start = start
        self.legs: list[tuple[float, float]] = []
        self._lock = threading.Lock()
        self._poses: deque[tuple[float, FloatArray]] = deque([(0.0, start)], maxlen=KEPT)

    def hear(self, seconds: float, pose: FloatArray) -> None:
        """Take a pose.

        Args:
            seconds: since the walk began; what is not newer than the last is left out.
            pose: (3,) x [m], y [m], yaw [rad], map frame.
        """
        newest, last = self._poses[-1]
        if seconds <= newest:
            return
        # Unwrapped, so that it can be interpolated.
        turn = wrap_angle(pose[2] - last[2])
        with self._lock:
            self._poses.append((seconds, np.array([pose[0], pose[1], last[2] + turn])))

    def at(self, times: FloatArray) -> Motion:
        """Motion at times (N,) [s]: between the poses heard, and straight on after the newest."""
        with self._lock:
            known = np.array([seconds for seconds, _ in self._poses])
            poses = np.array([pose for _, pose in self._poses])
        times = np.asarray(times, dtype=np.float64)
        pose = np.column_stack([np.interp(times, known, column) for column in poses.T])
        recent = int(np.searchsorted(known, known[-1] - SLOPE_OVER))
        span = known[-1] - known[recent]
        slope = (poses[-1] - poses[recent]) / span if span > 0.0 else np.zeros(3)
        ahead = np.clip(times - known[-1], 0.0, LONGEST_AHEAD)
        pose += ahead[:, None] * slope
        pose[:, 2] = wrap_angles(pose[:, 2])
        return Motion(pose, np.full(len(times), slope[2]), np.zeros(len(times)))
