"""What happened in a run, with its time and its likely cause: found from the ticks, as they come."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import cos, isfinite, sin

import numpy as np

from companion.anchor_shift import RangeMisses
from companion.config import Config
from companion.evaluate import Errors
from companion.health import Health, State
from companion.pipeline import Tick
from estimators.base import Report, Verdict
from estimators.messages import PoseEstimate, RangeFrame, Scan

GAP_NS = 1_000_000_000
"""Refusals further apart than this are two stories."""
LEAST_LENGTH_NS, LEAST_SHARE = 300_000_000, 0.5
"""An anchor is in trouble when for so long at least so many of its ranges were refused."""


@dataclass(frozen=True, slots=True)
class Event:
    """Something worth jumping to.

    Attributes:
        stamp_ns: when it began.
        title: what happened, in a few words.
        text: how it shows, and what the cause may be.
    """

    stamp_ns: int
    title: str
    text: str

    def __str__(self) -> str:
        return f"{self.title}: {self.text}"


@dataclass(slots=True)
class _Refusals:
    """A time in which ranges of one anchor, or whole frames, were refused again and again."""

    begin_ns: int
    last_ns: int
    refused: int = 0
    seen: int = 0
    worst: float = 0.0
    verdicts: Counter[Verdict] = field(default_factory=Counter)

    def counts(self) -> bool:
        """Whether it is more than a few outliers."""
        return self.last_ns - self.begin_ns >= LEAST_LENGTH_NS and self.refused >= LEAST_SHARE * self.seen

    @property
    def length(self) -> str:
        """From the first to the last refusal."""
        return f"{(self.last_ns - self.begin_ns) * 1e-9:.1f} s"


class EventFinder:
    """Follows a run tick by tick.

    Args:
        config: of the site.
        primary: estimator whose verdicts and poses tell the story.
    """

    def __init__(self, config: Config, primary: str) -> None:
        self._config, self._primary = config, primary
        self._blocked: dict[int, _Refusals] = {}
        self._contradiction: _Refusals | None = None
        self._misses = RangeMisses()
        self._heard_ns: dict[str, int] = {}
        self._silent: set[str] = set()
        self._health: Health | None = None
        self._lost_ns: int | None = None
        self._pose: PoseEstimate | None = None
        self._has_blocked = False
        self._stamp_ns = self._begin_ns = 0
        self._found: list[Event] = []

    def tick(self, tick: Tick) -> list[Event]:
        """Take a tick; gives the events that are over, or clear, with it."""
        self._begin_ns = self._begin_ns or tick.stamp_ns
        self._stamp_ns = tick.stamp_ns
        pose = tick.poses[self._primary]
        for outcome in tick.outcomes:
            if isinstance(outcome.measurement, RangeFrame):
                self._take_ranges(outcome.measurement, outcome.reports[self._primary], pose)
            elif isinstance(outcome.measurement, Scan):
                self._take_sign("scans", outcome.measurement.end_stamp_ns)
        self._close_stories(tick.stamp_ns - GAP_NS)
        self._look_for_silence(tick.stamp_ns)
        self._take_health(tick.health)
        self._take_pose(pose)
        found, self._found = self._found, []
        return found

    def close(self) -> list[Event]:
        """Events that only the end makes clear."""
        self._close_stories(self._stamp_ns)
        for name in sorted(self._silent):
            self._tell_silence(name, self._stamp_ns, "until the end")
        if self._lost_ns is not None:
            self._tell_lost("until the end")
        shift = self._misses.shift()
        if shift is not None:
            x, y = shift.shift
            biased = "" if shift.bias is None else f"; or all its ranges err by {shift.bias:+.2f} m"
            self._tell(
                shift.stamp_ns,
                f"A{shift.anchor_id} moved" + " or biased" * bool(biased),
                f"the ranges fit a place of it {np.hypot(x, y):.2f} m from the site file's, x {x:+.2f} "
                f"y {y:+.2f} m: they miss by {shift.after:.2f} m with it there, {shift.before:.2f} m as it is"
                + biased,
            )
        for i in self._config.anchors:
            if f"A{i}" not in self._heard_ns and self._heard_ns:
                self._tell(
                    self._begin_ns, f"A{i} never heard", "not one range: its power, its id in the site file?"
                )
        found, self._found = self._found, []
        return found

    def _tell(self, stamp_ns: int, title: str, text: str) -> None:
        self._found.append(Event(stamp_ns, title, text))

    def _take_ranges(self, frame: RangeFrame, report: Report, pose: PoseEstimate | None) -> None:
        known = [
            (k, i, report.verdicts[k])
            for k, i in enumerate(frame.anchor_ids[: len(report.verdicts)].tolist())
            if i in self._config.anchors and report.verdicts[k] is not Verdict.NOT_USED
        ]
        tag = None if pose is None else _tag(pose, self._config.body.tag)
        refused = 0
        for k, i, verdict in known:
            self._take_sign(f"A{i}", frame.stamp_ns)
            residual = float(report.residuals[k]) if len(report.residuals) else np.nan
            is_refused = verdict.is_nlos or verdict in (Verdict.GATED, Verdict.CONTRADICTS)
            refused += is_refused
            if is_refused:
                story = self._blocked.setdefault(i, _Refusals(frame.stamp_ns, frame.stamp_ns))
                story.last_ns = frame.stamp_ns
                story.verdicts[verdict] += 1
                if abs(residual) > abs(story.worst):
                    story.worst = residual
            if i in self._blocked:
                self._blocked[i].seen += 1
                self._blocked[i].refused += is_refused
            if tag is not None:
                x, y, _ = self._config.anchors[i]
                self._misses.add(frame.stamp_ns, i, residual, tag[0] - x, tag[1] - y)
        self._take_contradiction(frame.stamp_ns, refused, len(known))

    def _take_contradiction(self, stamp_ns: int, refused: int, known: int) -> None:
        """More than half of a frame's ranges refused: the pose is wrong, or most anchors are blocked."""
        contradicts = known > 2 and 2 * refused > known
        if contradicts and self._contradiction is None:
            self._contradiction = _Refusals(stamp_ns, stamp_ns)
        if self._contradiction is not None:
            self._contradiction.seen += 1
            if contradicts:
                self._contradiction.last_ns = stamp_ns
                self._contradiction.refused += 1

    def _close_stories(self, until_ns: int) -> None:
        """Tell the stories that have had no refusal since then."""
        over = [i for i, story in self._blocked.items() if story.last_ns <= until_ns]
        for i in over:
            story = self._blocked.pop(i)
            if story.counts():
                self._tell_blocked(i, story)
        if self._contradiction is not None and self._contradiction.last_ns <= until_ns:
            story, self._contradiction = self._contradiction, None
            if story.counts():
                self._tell(
                    story.begin_ns,
                    "most ranges contradict the pose",
                    f"for {story.length}: carried off, led astray, or most anchors blocked",
                )

    def _tell_blocked(self, i: int, story: _Refusals) -> None:
        reason, _ = story.verdicts.most_common(1)[0]
        is_nlos = sum(n for verdict, n in story.verdicts.items() if verdict.is_nlos) > story.refused / 2
        first = " (first NLOS)" if is_nlos and not self._has_blocked else ""
        self._has_blocked |= is_nlos
        self._tell(
            story.begin_ns,
            f"A{i} {'blocked' if is_nlos else 'refused'}{first}",
            f"{reason}; {story.refused} of {story.seen} ranges in {story.length}, worst {story.worst:+.2f} m",
        )

    def _take_sign(self, name: str, stamp_ns: int) -> None:
        """Something was heard of a sensor or an anchor."""
        if name in self._silent:
            self._silent.discard(name)
            self._tell_silence(name, stamp_ns, "")
        self._heard_ns[name] = stamp_ns

    def _look_for_silence(self, now_ns: int) -> None:
        health = self._config.health
        for name, heard_ns in self._heard_ns.items():
            limit = health.max_increment_age if name == "scans" else health.max_range_age
            if now_ns - heard_ns > limit * 1e9:
                self._silent.add(name)

    def _tell_silence(self, name: str, until_ns: int, ending: str) -> None:
        heard_ns = self._heard_ns[name]
        span = f"for {(until_ns - heard_ns) * 1e-9:.1f} s {ending}".rstrip()
        if name == "scans":
            self._tell(heard_ns, "LiDAR blackout", f"no scan {span}: cable, motor, power?")
        else:
            self._tell(heard_ns, f"{name} lost", f"no range {span}: out of reach, or without power?")

    def _take_health(self, health: Health) -> None:
        if self._lost_ns is None:
            if health.state is State.LOST:
                self._lost_ns, self._health = self._stamp_ns, health
        elif health.state is not State.LOST:
            self._tell_lost(f"then {health.state}")
            self._lost_ns = None

    def _tell_lost(self, ending: str) -> None:
        assert self._lost_ns is not None
        assert self._health is not None
        length = (self._stamp_ns - self._lost_ns) * 1e-9
        self._tell(
            self._lost_ns, "pose lost", f"{self._health.reason}; nothing sent for {length:.1f} s, {ending}"
        )

    def _take_pose(self, pose: PoseEstimate | None) -> None:
        if pose is None:
            return
        last, self._pose = self._pose, pose
        if last is not None and pose.reset_counter != last.reset_counter:
            jump = float(np.hypot(*(pose.xy - last.xy)))
            self._tell(
                pose.stamp_ns, f"reset {pose.reset_counter}", f"the pose was found anew {jump:.2f} m away"
            )


def worst_error(errors: Errors, begin_ns: int) -> Event | None:
    """Where a track was farthest from the truth since `begin_ns`; None without truth."""
    late_enough = errors.stamps_ns >= begin_ns
    if not late_enough.any():
        return None
    worst = int(np.argmax(np.where(late_enough, errors.distance, -1.0)))
    sigma = float(np.sqrt(np.linalg.eigvalsh(errors.cov[worst, :2, :2])[1]))
    return Event(
        int(errors.stamps_ns[worst]),
        "worst error",
        f"{errors.distance[worst]:.3f} m from the truth, with a claimed sigma of {sigma:.3f} m",
    )


def _tag(pose: PoseEstimate, tag_in_body: Sequence[float]) -> tuple[float, float]:
    """Where the tag is, x and y [m], map frame; where the heading is not known its lever arm is left out."""
    x, y = pose.xy.tolist()
    if isfinite(pose.cov[5, 5]):
        c, s = cos(pose.yaw), sin(pose.yaw)
        ahead, left = tag_in_body[:2]
        x, y = x + c * ahead - s * left, y + s * ahead + c * left
    return x, y
