"""Where the simulated robot is at any instant."""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from companion.sim.scenario import Scenario
from companion.sim.trajectory import Motion

OnRanging: TypeAlias = Callable[[int, dict[int, float]], None]


class Robot:
    """Where the simulated robot is; it stands still until it is told to begin.

    Args:
        scenario: walk and world.
        on_ranging: is told of every UWB frame, whether or not it arrives: its time, and by how much what
            stands between makes the range of each anchor too long [m].
    """

    def __init__(self, scenario: Scenario, on_ranging: OnRanging = lambda _stamp_ns, _excess: None) -> None:
        self.scenario = scenario
        self.on_ranging = on_ranging
        self._begin_ns: int | None = None

    def begin(self, now_ns: int) -> None:
        """Start the walk, once."""
        if self._begin_ns is None:
            self._begin_ns = now_ns

    def arrived(self, now_ns: int) -> bool:
        """Whether the walk is over."""
        return self.seconds(now_ns) >= self.scenario.trajectory.duration

    def seconds(self, now_ns: int) -> float:
        """Time since the walk began [s]; 0 before."""
        return 0.0 if self._begin_ns is None else (now_ns - self._begin_ns) * 1e-9

    def motion(self, now_ns: int) -> Motion:
        """True motion at one instant (N = 1)."""
        return self.scenario.trajectory.at(np.array([self.seconds(now_ns)]))
