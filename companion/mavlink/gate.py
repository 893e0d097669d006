"""Which poses are sent: a stream that an autopilot's filter can follow, or none.

Health says whether a pose is good. Here a stream begins only when that has lasted, ends at once when it is
over, stops at a jump that the estimator has not announced, and counts the jumps that an autopilot will see.
"""

from dataclasses import dataclass

import numpy as np

from companion.health import Health
from companion.mavlink_table import GateTable
from estimators.geometry import wrap_angle
from estimators.messages import PoseEstimate

_LONGEST_GAP = 1.0
"""Motion is made allowance for over this time at most [s]: after more, the autopilot has drifted itself."""
_SIGMAS = 4.0  # three of ten thousand distances in the plane are farther


@dataclass(frozen=True, slots=True)
class Decision:
    """What becomes of one pose.

    Attributes:
        sends: whether it goes to the autopilot.
        reset_counter: to send it with.
        held: why a pose of good health is held back; empty when it is not.
    """

    sends: bool
    reset_counter: int
    held: str = ""


class SendGate:
    """Follows the poses of one run.

    Args:
        table: limits.
        uses_heading: whether the heading is sent, so that its jumps matter.
    """

    def __init__(self, table: GateTable, uses_heading: bool) -> None:
        self.table = table
        self._uses_heading = uses_heading
        self._resets = 0
        self._good_since_ns: int | None = None
        self._last: PoseEstimate | None = None
        self._sent: PoseEstimate | None = None
        self._sending = self._has_jumped = False
        self._why_held = ""

    def judge(self, pose: PoseEstimate | None, health: Health, now_ns: int) -> Decision:
        """Decide about the pose of one tick.

        Args:
            pose: newest, None when there is none.
            health: judgement of it.
            now_ns: time of the tick.
        """
        if pose is None or not health.sends:
            self._sending, self._last, self._good_since_ns = False, None, None
            return Decision(False, self._resets)
        if self._last is not None and self._last.reset_counter == pose.reset_counter:
            jump = self._jump(self._last, pose)
            if jump:
                self._sending, self._has_jumped = False, True
                self._good_since_ns, self._why_held = now_ns, f"the pose jumped by {jump}"
        if self._good_since_ns is None:
            self._good_since_ns, self._why_held = now_ns, "waiting whether it stays good"
        self._last = pose
        if now_ns - self._good_since_ns < self.table.resume_after * 1e9:
            return Decision(False, self._resets, self._why_held)
        if self._sent is not None and self._is_reset(self._sent, pose):
            self._resets = (self._resets + 1) % 256
        self._sent, self._sending, self._has_jumped = pose, True, False
        return Decision(True, self._resets)

    def _is_reset(self, sent: PoseEstimate, pose: PoseEstimate) -> bool:
        if self._has_jumped or sent.reset_counter != pose.reset_counter:
            return True
        return not self._sending and bool(self._jump(sent, pose))

    def _jump(self, before: PoseEstimate, after: PoseEstimate) -> str:
        """How far a pose is from where the robot can have come to, in words; empty when it is not."""
        table = self.table
        gap = min((after.stamp_ns - before.stamp_ns) * 1e-9, _LONGEST_GAP)
        moved = float(np.hypot(*(after.xy - before.xy)))
        noise = _SIGMAS * float(np.sqrt(_widest(before) + _widest(after)))
        if moved > table.max_speed * gap + table.max_jump + noise:
            return f"{moved:.1f} m"
        if not self._uses_heading:
            return ""
        turned = abs(float(np.rad2deg(wrap_angle(after.yaw - before.yaw))))
        noise = _SIGMAS * float(np.rad2deg(np.sqrt(before.cov[5, 5] + after.cov[5, 5])))
        if turned > table.max_turn_rate_deg * gap + table.max_jump_deg + noise:
            return f"{turned:.0f} deg"
        return ""


def _widest(pose: PoseEstimate) -> float:
    return float(max(pose.cov[0, 0], pose.cov[1, 1]))
