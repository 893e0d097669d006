"""Whether the pose is good enough to fly on: what the autopilot must never receive is decided here."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import degrees, exp, hypot, inf, sqrt

import numpy as np

from companion.config_tables import HealthTable
from estimators.base import Report, Verdict
from estimators.immutable import immutable
from estimators.messages import (
    FloatArray,
    Measurement,
    PoseEstimate,
    PoseIncrement,
    RangeFrame,
    measurement_stamp_ns,
)

MEMORY = 2.0
"""Time constant [s] over which the shares of accepted and of too short ranges are remembered."""
LONGEST_BRIEF = 35
"""Characters of a reason that fits, behind the state, into the 50 of a text to the pilot."""
REGAIN = 1.5
"""Agreement of ranges and pose must be better by this factor to be reached than to be kept."""
_DISAGREES = frozenset({Verdict.GATED, Verdict.TOO_LONG, Verdict.DOWNWEIGHTED})
"""Verdicts on ranges that do not fit the pose."""


class State(StrEnum):
    """How far the pose can be trusted."""

    STARTING = "starting"
    """No pose yet, or none that ranges have confirmed; not sent."""
    OK = "ok"
    DEGRADED = "degraded"
    """A sensor is missing; the pose is still sent, with the covariance that it then has."""
    LOST = "lost"
    """Not sent."""


@dataclass(frozen=True, slots=True)
class Health:
    """Judgement at one instant.

    Attributes:
        state: see `State`.
        reason: one line for the operator; empty when all is well.
        brief: the same for the pilot, in `LONGEST_BRIEF` characters; empty when `reason` is as short.
    """

    state: State
    reason: str
    brief: str = ""

    @property
    def sends(self) -> bool:
        """True when the pose may go to the autopilot."""
        return self.state in (State.OK, State.DEGRADED)


@immutable
class _Source:
    """How long ago one kind of measurement was last accepted."""

    what: str
    age: float
    is_stale: bool
    first_awaited: bool


@dataclass(frozen=True, slots=True)
class AnchorState:
    """What became of an anchor's ranges lately.

    Attributes:
        anchor_id: whose they are.
        is_used: whether one was used lately.
        reason: why not, the verdict on the newest; empty when they are used, or when none came at all.
    """

    anchor_id: int
    is_used: bool
    reason: str

    @property
    def trouble(self) -> str:
        """Why it is not used, in a word."""
        if self.is_used:
            return ""
        if not self.reason:
            return "silent"
        return "NLOS" if Verdict(self.reason).is_nlos else self.reason


def uwb_line(anchors: Sequence[AnchorState], longest: int | None = None) -> str:
    """One line for the operator: how many anchors are used, and what is wrong with the others.

    Args:
        anchors: of the site.
        longest: characters that it may have; where there is no room for names, anchors are counted.
    """
    others: dict[str, list[str]] = {}
    for anchor in anchors:
        if not anchor.is_used:
            others.setdefault(anchor.trouble, []).append(f"A{anchor.anchor_id}")
    used, count = sum(anchor.is_used for anchor in anchors), len(anchors)
    named = [f"{' '.join(names)} {trouble}" for trouble, names in others.items()]
    counted = [f"{len(names)} {trouble}" for trouble, names in others.items()]
    lines = (
        ", ".join([f"UWB: {used} of {count} anchors", *named]),
        f"UWB {used}/{count}: " + ", ".join(named),
        f"UWB {used}/{count}: " + ", ".join(counted),
        f"UWB: {used} of {count} anchors",
    )
    return next((line for line in lines if longest is None or len(line) <= longest), lines[-1])


class HealthMonitor:
    """Follows the verdicts on the pose that is sent.

    Args:
        table: limits.
        has_ranges: the site has a UWB sensor.
        has_scans: the site has a LiDAR.
        anchor_ids: of the site.
        needs_heading: the autopilot takes the heading from us; a pose without one is no use to it.
    """

    def __init__(
        self,
        table: HealthTable,
        has_ranges: bool,
        has_scans: bool,
        anchor_ids: Iterable[int] = (),
        needs_heading: bool = True,
    ) -> None:
        # Numba loads slowly: only who judges poses waits for it.
        from estimators.kernels import soundness

        self._soundness = soundness
        self._table = table
        self._anchor_ids = tuple(anchor_ids)
        self._heard: dict[int, tuple[int, Verdict]] = {}
        self._used_ns: dict[int, int] = {}
        self._has_ranges = has_ranges
        self._has_scans = has_scans
        self._used = 6 if needs_heading else 5
        self._heading_advice = "" if has_scans else "without LiDAR or odometry set mavlink.heading = false"
        self._resets = 0
        self._accepted_share: float
        self._short_share: float
        self._has_agreed = False
        self._begin_agreement()
        self._share_stamp_ns: int | None = None
        self._range_ns: int | None = None
        self._increment_ns: int | None = None
        self._begin_ns: int | None = None
        self._note = ""

    def set_table(self, table: HealthTable) -> None:
        """Judge by other limits from now on."""
        self._table = table

    def observe(self, measurement: Measurement, report: Report) -> None:
        """Take note of what the estimator made of a measurement."""
        if self._begin_ns is None:
            self._begin_ns = measurement_stamp_ns(measurement)
        if isinstance(measurement, RangeFrame):
            self._observe_ranges(measurement, report)
        elif isinstance(measurement, PoseIncrement):
            self._note = report.note
            if Verdict.ACCEPTED in report.verdicts and measurement.from_stamp_ns < measurement.stamp_ns:
                self._increment_ns = measurement.stamp_ns

    def _observe_ranges(self, frame: RangeFrame, report: Report) -> None:
        self._note = report.note
        self._observe_anchors(frame, report)
        verdicts, stamp_ns = report.verdicts, frame.stamp_ns
        good = verdicts.count(Verdict.ACCEPTED)
        # What else speaks for a blocked range says nothing of the pose.
        judged = good + sum(map(verdicts.count, _DISAGREES))
        contradicting = verdicts.count(Verdict.CONTRADICTS)
        if contradicting > good:  # fewer are the anchors' fault
            judged += contradicting
        if not judged:
            return
        if good:
            self._range_ns = stamp_ns
        too_short = 0
        # An estimator may gate without saying by how much.
        if Verdict.GATED in verdicts and len(report.residuals):
            told = zip(verdicts, report.residuals.tolist(), strict=True)
            too_short = sum(verdict is Verdict.GATED and residual < 0.0 for verdict, residual in told)
        dt = 0.0 if self._share_stamp_ns is None else (stamp_ns - self._share_stamp_ns) * 1e-9
        keep = exp(-dt / MEMORY)
        self._accepted_share = keep * self._accepted_share + (1.0 - keep) * good / judged
        self._short_share = keep * self._short_share + (1.0 - keep) * too_short / judged
        self._share_stamp_ns = stamp_ns
        self._judge_agreement()

    def _begin_agreement(self) -> None:
        """No pose is believed, at the start or after a reset, before ranges agreed with it for a while."""
        self._accepted_share = self._short_share = 0.0
        self._agrees = False

    def _judge_agreement(self) -> None:
        """Whether ranges and pose agree; harder to reach than to keep, so that health does not flicker."""
        table = self._table
        if self._agrees:
            self._agrees = (
                self._accepted_share >= table.min_accepted_share
                and self._short_share <= table.max_short_share
            )
        else:
            self._agrees = (
                self._accepted_share >= REGAIN * table.min_accepted_share
                and self._short_share <= table.max_short_share / REGAIN
            )
        self._has_agreed |= self._agrees

    def anchors(self, now_ns: int) -> list[AnchorState]:
        """What became lately of the ranges of each anchor of the site."""

        def is_recent(stamp_ns: int | None) -> bool:
            return stamp_ns is not None and (now_ns - stamp_ns) * 1e-9 <= self._table.max_range_age

        states = []
        for anchor_id in self._anchor_ids:
            is_used = is_recent(self._used_ns.get(anchor_id))
            heard_ns, verdict = self._heard.get(anchor_id, (None, ""))
            reason = "" if is_used or not is_recent(heard_ns) else str(verdict)
            states.append(AnchorState(anchor_id, is_used, reason))
        return states

    def _observe_anchors(self, frame: RangeFrame, report: Report) -> None:
        for anchor_id, verdict in zip(frame.anchor_ids.tolist(), report.verdicts, strict=True):
            if verdict is not Verdict.NOT_USED:
                self._heard[anchor_id] = frame.stamp_ns, verdict
                if verdict.is_used:
                    self._used_ns[anchor_id] = frame.stamp_ns

    def judge(self, pose: PoseEstimate | None, now_ns: int) -> Health:
        """State at `now_ns` for the pose that would be sent."""
        table = self._table
        if pose is None:
            if self._note:
                return Health(State.STARTING, f"looking for the pose: {self._note}", self._note)
            return Health(State.STARTING, "no pose yet: waiting for measurements", "waiting for measurements")
        if pose.reset_counter != self._resets:
            self._resets = pose.reset_counter
            self._begin_agreement()
        sources = self._sources(now_ns)
        awaited = [s.what for s in sources if s.first_awaited and not s.is_stale]
        if awaited:
            return Health(State.STARTING, f"waiting for a {awaited[0]}")
        variance_yaw = float(pose.cov[5, 5])
        if variance_yaw == inf and self._used == 6:
            what = self._note or self._heading_advice or "start again on the start mark"
            return Health(State.LOST, f"heading not known: {what}", self._note or "heading not known")
        soundness = self._soundness.soundness(
            np.ascontiguousarray(pose.T_map_body), np.ascontiguousarray(pose.cov), self._used
        )
        if soundness == self._soundness.NOT_FINITE:
            return Health(State.LOST, "pose or covariance is not finite")
        if soundness == self._soundness.NOT_DEFINITE:
            return Health(State.LOST, "covariance is not positive definite")
        sigma_xy = _widest(pose.cov[:2, :2])
        if sigma_xy > table.max_sigma_xy:
            what = f"position sigma {sigma_xy:.2f} m"
            return Health(State.LOST, f"{what} above {table.max_sigma_xy:g} m", what)
        if self._used == 6 and (sigma_yaw := degrees(sqrt(variance_yaw))) > table.max_sigma_yaw_deg:
            what = f"heading sigma {sigma_yaw:.0f} deg"
            why = f"{what} above {table.max_sigma_yaw_deg:g} deg"
            return Health(State.LOST, ": ".join(filter(None, (why, self._heading_advice))), what)
        if self._has_ranges and not self._agrees:
            return self._disagreement(now_ns)
        stale = [s for s in sources if s.is_stale]
        if not stale:
            return Health(State.OK, "")
        reason = "; ".join(f"no {s.what} accepted for {s.age:.1f} s" for s in stale)
        brief = f"no {' and no '.join(s.what for s in stale)}"
        if self._has_ranges and stale == sources[:1]:
            brief = self._uwb_brief(now_ns, brief)
        dead_reckoned = (
            self._has_ranges and stale[0] is sources[0] and stale[0].age > table.max_dead_reckoning
        )
        is_lost = len(stale) == len(sources) or dead_reckoned
        return Health(State.LOST if is_lost else State.DEGRADED, reason, brief)

    def _uwb_brief(self, now_ns: int, otherwise: str) -> str:
        """What is wrong with the anchors, for the pilot; something else where none is known."""
        anchors = self.anchors(now_ns)
        return uwb_line(anchors, LONGEST_BRIEF) if anchors else otherwise

    def _disagreement(self, now_ns: int) -> Health:
        if self._share_stamp_ns is None:
            why = "no range yet that could confirm the start pose"
            return Health(State.STARTING, why, "no range to confirm the start")
        shares = (
            f"{self._accepted_share:.0%} of recent ranges agree with the pose, "
            f"{self._short_share:.0%} are too short for it"
        )
        brief = f"{self._accepted_share:.0%} of ranges agree"
        if self._short_share > self._table.max_short_share:
            brief = f"{self._short_share:.0%} ranges too short"
        elif self._has_agreed:
            brief = self._uwb_brief(now_ns, brief)
        if self._has_agreed:
            return Health(State.LOST, shares, brief)
        if self._resets:
            return Health(State.STARTING, shares, brief)
        return Health(State.STARTING, f"{shares}; is the robot on its start mark?", f"on the mark? {brief}")

    def _sources(self, now_ns: int) -> list[_Source]:
        def source(what: str, seen_ns: int | None, limit: float) -> _Source:
            since = seen_ns if seen_ns is not None else self._begin_ns
            age = (now_ns - since) * 1e-9 if since is not None else 0.0
            return _Source(what, age, age > limit, seen_ns is None)

        table = self._table
        sources = []
        if self._has_ranges:
            sources.append(source("range", self._range_ns, table.max_range_age))
        if self._has_scans:
            sources.append(source("LiDAR increment", self._increment_ns, table.max_increment_age))
        return sources


def _widest(cov: FloatArray) -> float:
    """Standard deviation along the longer axis of an ellipse, from its covariance (2, 2)."""
    (xx, xy), (_, yy) = cov.tolist()
    return sqrt(0.5 * (xx + yy) + hypot(0.5 * (xx - yy), xy))
