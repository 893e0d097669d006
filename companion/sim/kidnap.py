"""A walk that goes on elsewhere: the robot is carried off."""

from typing import Protocol

import numpy as np

from companion.sim.scenario_tables import KidnapTable
from companion.sim.trajectory import Motion
from estimators.geometry import compose, inverse, rotation, wrap_angles
from estimators.messages import FloatArray

PLACES_TRIED = 10_000
STEP = 0.1
"""The rest of the walk is looked at so often [s]."""


class Walk(Protocol):
    """Where a robot is over time."""

    start: FloatArray
    """(3,) pose where it should stand at the start, map frame."""
    duration: float
    """[s]."""

    @property
    def legs(self) -> list[tuple[float, float]]:
        """Begin and end of every straight leg [s]."""
        ...

    def at(self, times: FloatArray) -> Motion:
        """Motion at times (N,) [s] since the start."""
        ...


class Kidnapped:
    """A walk whose robot is set down elsewhere at one moment, and then walks on from there.

    Args:
        walk: as it would have been.
        table: when and where to.
        rng: draws the place if the table names none.

    Raises:
        ValueError: no place was found from which the rest of the walk stays within the table's limits.
    """

    def __init__(self, walk: Walk, table: KidnapTable, rng: np.random.Generator) -> None:
        self._walk = walk
        self._at = table.at
        self.start = walk.start
        self.duration = walk.duration
        self.legs = walk.legs
        taken = walk.at(np.array([table.at])).pose[0]
        self._T_new_old = np.zeros(3)
        if table.to is not None:
            there = np.array([*table.to[:2], np.deg2rad(table.to[2])])
            self._T_new_old = compose(there, inverse(taken))
            return
        assert table.x is not None
        assert table.y is not None
        rest = walk.at(np.arange(table.at, walk.duration, STEP)).pose
        least, greatest = np.transpose([table.x, table.y])
        for _ in range(PLACES_TRIED):
            there = rng.uniform([*least, -np.pi], [*greatest, np.pi])
            self._T_new_old = compose(there, inverse(taken))
            moved = self._moved(rest)[:, :2]
            if (moved >= least).all() and (moved <= greatest).all():
                return
        raise ValueError(f"x, y: the rest of the walk fits nowhere, tried {PLACES_TRIED} places")

    def at(self, times: FloatArray) -> Motion:
        """Motion at times (N,) [s] since the start."""
        motion = self._walk.at(times)
        pose = motion.pose.copy()
        later = times >= self._at
        pose[later] = self._moved(pose[later])
        return Motion(pose, motion.yaw_rate, motion.accel)

    def _moved(self, poses: FloatArray) -> FloatArray:
        moved = np.empty_like(poses)
        moved[:, :2] = poses[:, :2] @ rotation(self._T_new_old[2]).T + self._T_new_old[:2]
        moved[:, 2] = wrap_angles(poses[:, 2] + self._T_new_old[2])
        return moved
