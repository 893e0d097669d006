"""Do axes and signs agree: what a walk forward and a walk to the left should look like, and what they did.

A LiDAR that is turned, a map that is mirrored, a heading that is off: each shows in the direction that a
known walk takes. Angles are told as what is to be changed in the site file.
"""

from dataclasses import dataclass
from math import atan2, degrees, hypot

from estimators.geometry import between, wrap_angle
from estimators.messages import FloatArray

LEAST_WALK = 0.5
"""Shorter walks [m] say nothing about directions."""
MAX_ANGLE_DEG = 25.0
"""People and robots do not walk straighter than that."""
MAX_COMPASS_DEG = 20.0
"""Indoors a compass is rarely better."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        agrees: whether it is as it should be; None = it could not be told.
        text: one line for the operator.
    """

    agrees: bool | None
    text: str


def judge_walk(what: str, begin: FloatArray, end: FloatArray) -> Finding:
    """Compare a walk with the direction that it was meant to have.

    Args:
        what: `forward` or `left`, as seen at the beginning; whether the robot turned does not count.
        begin: (3,) x [m], y [m], yaw [rad] before it, map frame.
        end: (3,) after it.
    """
    x, y, _ = between(begin, end).tolist()
    length = hypot(x, y)
    if length < LEAST_WALK:
        return Finding(False, f"{what}: only {length:.2f} m walked, at least {LEAST_WALK:g} m are needed")
    meant = 0.0 if what == "forward" else 90.0
    off = degrees(wrap_angle(atan2(y, x))) - meant
    off = (off + 180.0) % 360.0 - 180.0
    walked = f"{what}: {length:.2f} m"
    if abs(off) <= MAX_ANGLE_DEG:
        return Finding(True, f"{walked}, {off:+.0f} deg off: agrees")
    if what == "left" and abs(abs(off) - 180.0) <= MAX_ANGLE_DEG:
        return Finding(
            False,
            f"{walked} came out to the right: the map is mirrored. Seen from above its y axis is to the "
            "left of x: check the signs of the anchors",
        )
    return Finding(
        False,
        f"{walked} came out {_side(off)}: the pose is turned by {off:+.0f} deg. Check body.lidar_yaw_deg and "
        "start.yaw_deg",
    )


def judge_compass(ours: float, autopilots: float) -> Finding:
    """Compare our heading with the autopilot's.

    Args:
        ours: clockwise from north, by the map's heading [rad].
        autopilots: of its ATTITUDE [rad].
    """
    off = degrees(wrap_angle(autopilots - ours))
    text = f"compass: autopilot {round(degrees(autopilots)) % 360} deg, ours {round(degrees(ours)) % 360} deg"
    if abs(off) <= MAX_COMPASS_DEG:
        return Finding(True, f"{text}: agrees")
    return Finding(False, f"{text}: if the compass is right, add {off:+.0f} deg to site.map_heading_deg")


def judge_autopilot(ours: FloatArray, autopilots: FloatArray | None) -> Finding:
    """Compare a displacement in north and east with the autopilot's own.

    Args:
        ours: (2,) north, east [m].
        autopilots: (2,) of its LOCAL_POSITION_NED [m]; None when it had none at the beginning.
    """
    if autopilots is None:
        return Finding(None, "autopilot: it had no position when the walk began, it did not use our pose yet")
    length = float(hypot(*autopilots))
    if length < LEAST_WALK or hypot(*ours) < LEAST_WALK:
        return Finding(None, "autopilot: its position did not move, it does not use our pose (yet)")
    turn = atan2(autopilots[1], autopilots[0]) - atan2(ours[1], ours[0])
    off = degrees(wrap_angle(turn))
    text = f"autopilot: its position went {length:.2f} m, ours {hypot(*ours):.2f} m, {off:+.0f} deg apart"
    agrees = abs(off) <= MAX_ANGLE_DEG
    return Finding(agrees, text + (": agrees" if agrees else ": check site.map_heading_deg"))


def _side(off: float) -> str:
    if abs(off) > 135.0:
        return "the other way"
    return "to its left" if off > 0.0 else "to its right"
