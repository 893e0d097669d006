"""A robot that wanders about a room between anchors; its ranges can be blocked, and it can be carried off."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from estimators.base import Setup, Start
from estimators.geometry import compose
from estimators.messages import FloatArray, Measurement, PoseIncrement, RangeFrame
from tests.estimators.matched_world import tag_of, true_increment
from tests.strategies import range_frame

RATE = 10
"""Increments and range frames a second; every fifth increment is a keyframe."""
RANGE_SIGMA = 0.1
INCREMENT_SIGMA = np.array([0.005, 0.005, 0.003])
SECOND_NS = 10**9
UNKNOWN = Start(np.zeros(3), np.array([100.0, 100.0, np.pi]), known=False)

ROOM = Setup(
    anchors={
        1: np.array([0.2, 0.1, 2.2]),
        2: np.array([7.9, 0.3, 2.0]),
        3: np.array([7.8, 6.8, 2.3]),
        4: np.array([0.1, 6.9, 1.9]),
    },
    tag_in_body=np.array([-0.1, 0.05, 0.2]),
    start=UNKNOWN,
    height=0.3,
    height_sigma=0.02,
    level_sigma=0.02,
)

Excess = Callable[[float, int, np.random.Generator], float]
"""Metres by which a range is too long: of seconds since the start, anchor id, and a source of noise."""


def clear(_: float, __: int, ___: np.random.Generator) -> float:
    """Nothing blocks."""
    return 0.0


def with_anchors(*ids: int) -> Setup:
    """The room with some of its anchors."""
    return replace(ROOM, anchors={i: ROOM.anchors[i] for i in ids})


def known_start(setup: Setup, pose: FloatArray) -> Setup:
    """The same with a start mark."""
    return replace(setup, start=Start(pose, np.array([0.05, 0.05, 0.03])))


@dataclass
class Robot:
    """Walks at 0.5 m/s along bends drawn from the seed and stays in the middle of the room.

    Attributes:
        setup: room.
        seed: of way and noise.
        excess: what blocks its ranges.
    """

    setup: Setup
    seed: int
    excess: Excess = clear
    pose: FloatArray = field(init=False)
    now_ns: int = field(init=False, default=5 * SECOND_NS)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self.pose = self._rng.uniform([2.0, 2.0, -np.pi], [6.0, 5.0, np.pi])
        self._begin_ns = self.now_ns
        self._keyframe_ns = self.now_ns
        self._since_keyframe = np.zeros(3)
        self._founds = True
        self._turn = 0.0

    def carry_to(self, pose: FloatArray, noticed: bool) -> None:
        """Set it down elsewhere."""
        self.pose = pose
        self._founds = noticed

    def walk(self, seconds: float, speed: float = 0.5, bends: bool = True) -> list[Measurement]:
        """What it measures on the way."""
        stream: list[Measurement] = []
        for _ in range(round(seconds * RATE)):
            if bends:
                self._choose_turn()
            step = np.array([speed / RATE, 0.0, self._turn / RATE if speed else 0.0])
            self.pose = compose(self.pose, step)
            self._since_keyframe = compose(self._since_keyframe, step)
            self.now_ns += SECOND_NS // RATE
            stream += [self._increment(), self._ranges()]
        return stream

    def _choose_turn(self) -> None:
        to_middle = np.array([4.0, 3.5]) - self.pose[:2]
        if np.linalg.norm(to_middle) > 1.8:
            away = true_increment(
                np.zeros(3), np.array([0.0, 0.0, np.arctan2(*to_middle[::-1]) - self.pose[2]])
            )
            self._turn = float(np.clip(2.0 * away[2], -1.0, 1.0))
        elif self._rng.random() < 0.1:
            self._turn = self._rng.uniform(-0.6, 0.6)

    def _increment(self) -> PoseIncrement:
        if self._founds:
            self._founds = False
            measured = PoseIncrement(
                self.now_ns, self.now_ns, np.zeros(3), np.zeros((3, 3)), is_keyframe=True
            )
        else:
            value = self._since_keyframe + self._rng.normal(0.0, INCREMENT_SIGMA)
            is_keyframe = (self.now_ns - self._keyframe_ns) >= SECOND_NS // 2
            cov = np.diag(INCREMENT_SIGMA**2)
            measured = PoseIncrement(self._keyframe_ns, self.now_ns, value, cov, is_keyframe)
        if measured.is_keyframe:
            self._keyframe_ns, self._since_keyframe = self.now_ns, np.zeros(3)
        return measured

    def _ranges(self) -> RangeFrame:
        tag, since = tag_of(self.pose, self.setup), (self.now_ns - self._begin_ns) * 1e-9
        slants = [
            float(np.linalg.norm(anchor - tag))
            + self._rng.normal(0.0, RANGE_SIGMA)
            + self.excess(since, anchor_id, self._rng)
            for anchor_id, anchor in self.setup.anchors.items()
        ]
        return range_frame(self.now_ns, list(self.setup.anchors), slants)
