"""Colours of a scene, after Okabe and Ito: colour-blind eyes too tell them apart, and a dark ground."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from companion.health import State
from estimators.base import Verdict

SKY, GREEN, VERMILION, PURPLE = 0x56B4E9FF, 0x009E73FF, 0xD55E00FF, 0xCC79A7FF
YELLOW, ORANGE, BLUE = 0xF0E442FF, 0xE69F00FF, 0x4678DCFF
WHITE, LIGHT, GREY, DARK = 0xF0F0F0FF, 0xBEB9AAFF, 0x787878FF, 0x3A3A3AFF
OTHER_ESTIMATORS = (PURPLE, YELLOW, BLUE, ORANGE)
ANCHORS = (SKY, ORANGE, GREEN, PURPLE, YELLOW, VERMILION, BLUE)
SENSORS = (SKY, ORANGE, GREEN, PURPLE)
VERDICTS = {
    Verdict.ACCEPTED: GREEN,
    Verdict.DOWNWEIGHTED: YELLOW,
    Verdict.SUSPECT: ORANGE,
    Verdict.TOO_LONG: VERMILION,
    Verdict.WEAK_FIRST_PATH: PURPLE,
    Verdict.OBSTRUCTED: SKY,
    Verdict.GATED: BLUE,
}
STATES = {State.STARTING: GREY, State.OK: GREEN, State.DEGRADED: ORANGE, State.LOST: VERMILION}
GROUND = 0x101216FF


def rgba(colours: Iterable[int]) -> NDArray[np.uint32]:
    """Colours (N,) as Rerun takes them; a short list of plain integers would be one colour's channels."""
    return np.array(list(colours), dtype=np.uint32)


def screen(points: float) -> float:
    """A radius that stays the same on the screen, whatever the zoom; Rerun takes a negative one so."""
    return -points
