"""How well an autopilot follows us: its own position against what it should be, and its filter's flags."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from drivers.mavlink_frames import MavlinkMessage
from estimators.messages import FloatArray

RATES = {"LOCAL_POSITION_NED": 10.0, "EKF_STATUS_REPORT": 2.0, "ESTIMATOR_STATUS": 2.0}
"""What it is asked for [Hz]; ArduPilot knows the second, PX4 the third."""
_FLAGS = (
    "attitude",
    "horizontal velocity",
    "vertical velocity",
    "relative position",
    "absolute position",
    "height",
    "height above ground",
    "constant position",
    "predicted relative position",
    "predicted absolute position",
)
_POSITION = 0b1_1000
"""Flags of a horizontal position, relative or absolute."""


@dataclass
class FollowScore:
    """Listens to one autopilot.

    Args:
        expected: where it should be at a host time, (2,) north and east [m]; None when that is not known.

    Attributes:
        errors: distances of its position from that [m].
        flags: of its filter, newest; None before they were heard.
        reports: how often flags came.
        with_position: how often they had a horizontal position.
        texts: its STATUSTEXTs.
    """

    expected: Callable[[int], FloatArray | None]
    errors: list[float] = field(default_factory=list)
    flags: int | None = None
    reports: int = 0
    with_position: int = 0
    texts: list[str] = field(default_factory=list)

    def hear(self, message: MavlinkMessage, stamp_ns: int) -> None:
        """Take a message that arrived at `stamp_ns`."""
        match message.get_type():
            case "LOCAL_POSITION_NED":
                expected = self.expected(stamp_ns)
                if expected is not None:
                    self.errors.append(float(np.hypot(message.x - expected[0], message.y - expected[1])))
            case "EKF_STATUS_REPORT" | "ESTIMATOR_STATUS":
                self.flags = message.flags
                self.reports += 1
                self.with_position += bool(message.flags & _POSITION)
            case "STATUSTEXT":
                self.texts.append(message.text)

    def lines(self) -> list[str]:
        """The result in words, and the last things that the autopilot said."""
        if self.errors:
            rmse = float(np.sqrt(np.mean(np.square(self.errors))))
            first = (
                f"autopilot: {len(self.errors)} positions, RMSE {rmse:.3f} m, median "
                f"{np.median(self.errors):.3f} m, max {max(self.errors):.3f} m"
            )
        else:
            first = "autopilot: no LOCAL_POSITION_NED heard: its filter has no position"
        if self.flags is None:
            return [first, "filter: no flags heard"]
        names = [name for bit, name in enumerate(_FLAGS) if self.flags >> bit & 1]
        share = self.with_position / self.reports
        second = f"filter: flags {self.flags} ({', '.join(names)}); a position {share:.0%} of the time"
        return [first, second, *(f"said: {text}" for text in self.texts[-5:])]
