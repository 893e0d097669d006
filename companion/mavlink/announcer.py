"""What the pilot is told: STATUSTEXT on every change of what is sent, and why; never a flood.

Source: MAVLink common.xml, STATUSTEXT; QGroundControl speaks what is a NOTICE or more severe.
"""

import re

from pymavlink.dialects.v20 import all as mavlink2

from companion.health import Health, State
from companion.mavlink.gate import Decision
from drivers.mavlink_frames import MavlinkMessage

LEAST_PAUSE_NS = 2_000_000_000
"""Between two texts; the newest state is told when it is over."""
_NUMBERS = re.compile(r"[\d.]+")


class Announcer:
    """Watches what is sent and says it in words."""

    def __init__(self) -> None:
        self._told = ""
        self._due_ns = 0
        self._waiting: list[tuple[int, str]] = []

    def say(self, severity: int, text: str) -> None:
        """Tell something once, besides the state; a text has at most 50 characters."""
        self._waiting.append((severity, text))

    def poll(self, health: Health, decision: Decision, now_ns: int) -> list[MavlinkMessage]:
        """Messages to send at `now_ns`."""
        if now_ns < self._due_ns:
            return []
        if self._waiting:
            severity, text = self._waiting.pop(0)
        else:
            severity, text = _state_text(health, decision)
            # Figures change with every tick, and which anchors are blocked often: a change of the operator's
            # words is a change.
            words = _NUMBERS.sub("", f"{health.state} {health.reason} {decision.held}")
            if words == self._told:
                return []
            self._told = words
        self._due_ns = now_ns + LEAST_PAUSE_NS
        return [mavlink2.MAVLink_statustext_message(severity, text.encode("ascii", "replace"), 0, 0)]


def _state_text(health: Health, decision: Decision) -> tuple[int, str]:
    """Severity and text of what is sent now."""
    if decision.held:
        is_jump = "jump" in decision.held
        severity = mavlink2.MAV_SEVERITY_WARNING if is_jump else mavlink2.MAV_SEVERITY_INFO
        return severity, f"pose held back: {decision.held}"
    severity = {
        State.STARTING: mavlink2.MAV_SEVERITY_INFO,
        State.OK: mavlink2.MAV_SEVERITY_INFO,
        State.DEGRADED: mavlink2.MAV_SEVERITY_WARNING,
        State.LOST: mavlink2.MAV_SEVERITY_ERROR,
    }[health.state]
    why = health.brief or health.reason
    return severity, f"pose {health.state}" + (f": {why}" if why else "")
