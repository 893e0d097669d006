"""What a scene says in words: the verdict on each anchor's ranges, health, and a text log."""

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
import rerun as rr

from companion.config import Config
from companion.health import Health, State
from companion.view.batch import Batch
from companion.view.entities import Entities
from companion.view.line import Level, Line
from companion.view.palette import DARK, GREY, STATES, VERDICTS, rgba
from estimators.base import Report, Verdict
from estimators.messages import RangeFrame

LANE_NS = 500_000_000
"""A lane shows what became of most ranges in so long: single verdicts alternate too fast to be read."""
SILENT = "no range"
_LEVELS: dict[State, Level] = {State.DEGRADED: "WARN", State.LOST: "ERROR"}


@dataclass(slots=True)
class _Lane:
    """What is shown of one anchor, and what its ranges got since."""

    shown: str = ""
    heard_ns: int = 0
    votes: Counter[Verdict] = field(default_factory=Counter)


class States:
    """Writes lanes of states and lines of text, each only when it changes.

    Args:
        entities: to write to.
        config: of the site.
    """

    def __init__(self, entities: Entities, config: Config) -> None:
        self._entities = entities
        self._patience_ns = round(config.health.max_range_age * 1e9)
        self._lanes = {i: _Lane() for i in config.anchors}
        self._begin_ns = self._end_ns = 0
        self._health: Health | None = None
        verdicts = [*Verdict, SILENT]
        lanes = rr.StateConfiguration(
            values=verdicts,
            labels=verdicts,
            colors=rgba([*(VERDICTS.get(verdict, GREY) for verdict in Verdict), DARK]),
        )
        for i in config.anchors:
            entities.static(f"ranges/verdict/A{i}", lanes)
        states = list(STATES)
        lane = rr.StateConfiguration(values=states, labels=states, colors=rgba(STATES.values()))
        entities.static("health/state", lane)

    def send(self, batch: Batch) -> None:
        """Write a batch."""
        self._send_verdicts(batch)
        changes = []
        for tick in batch.ticks:
            if self._health is None or tick.health.state is not self._health.state:
                self._health = tick.health
                changes.append(tick)
        stamps_ns = np.array([tick.stamp_ns for tick in changes])
        states = rr.StateChange.columns(state=[tick.health.state for tick in changes])
        self._entities.columns("health/state", stamps_ns, states)
        self.say(
            [
                Line(tick.stamp_ns, _health_text(tick.health), _LEVELS.get(tick.health.state, "INFO"))
                for tick in changes
            ]
        )

    def say(self, lines: list[Line]) -> None:
        """Write lines of the text log."""
        stamps_ns = np.array([line.stamp_ns for line in lines])
        columns = rr.TextLog.columns(
            text=[f"{self._entities.seconds(line.stamp_ns):.2f} s  {line.text}" for line in lines],
            level=[line.level for line in lines],
        )
        self._entities.columns("log", stamps_ns, columns)

    def close(self) -> None:
        """Write what the last ranges got."""
        self._send_lanes({i: [(self._begin_ns, s)] for i, s in self._elect(self._end_ns)})

    def _send_verdicts(self, batch: Batch) -> None:
        """A lane for each anchor: the verdict on its ranges, and with it why they were rejected."""
        changes: dict[int, list[tuple[int, str]]] = {}
        for tick in batch.ticks:
            self._begin_ns = self._begin_ns or tick.stamp_ns
            if tick.stamp_ns - self._begin_ns >= LANE_NS:
                for i, state in self._elect(tick.stamp_ns):
                    changes.setdefault(i, []).append((self._begin_ns, state))
                self._begin_ns = tick.stamp_ns
            self._end_ns = tick.stamp_ns
            for outcome in tick.outcomes:
                if isinstance(outcome.measurement, RangeFrame):
                    self._vote(outcome.measurement, outcome.reports[batch.names[0]])
        self._send_lanes(changes)

    def _vote(self, frame: RangeFrame, report: Report) -> None:
        for i, verdict in zip(frame.anchor_ids.tolist(), report.verdicts, strict=False):
            if (lane := self._lanes.get(i)) is not None:
                lane.votes[verdict] += 1
                lane.heard_ns = frame.stamp_ns

    def _elect(self, now_ns: int) -> list[tuple[int, str]]:
        """Anchors whose lane changes, with the new state; most ranges count, then the most common reason."""
        changes = []
        for i, lane in self._lanes.items():
            state = lane.shown
            if lane.votes:
                used = sum(count for verdict, count in lane.votes.items() if verdict.is_used)
                is_used = 2 * used >= lane.votes.total()
                state = max((v for v in lane.votes if v.is_used is is_used), key=lane.votes.__getitem__)
            elif now_ns - lane.heard_ns > self._patience_ns:
                state = SILENT
            if state != lane.shown:
                lane.shown = state
                changes.append((i, state))
            lane.votes.clear()
        return changes

    def _send_lanes(self, changes: dict[int, list[tuple[int, str]]]) -> None:
        for i, lane in changes.items():
            stamps_ns = np.array([stamp_ns for stamp_ns, _ in lane])
            states = rr.StateChange.columns(state=[state for _, state in lane])
            self._entities.columns(f"ranges/verdict/A{i}", stamps_ns, states)


def _health_text(health: Health) -> str:
    return f"health {health.state}: {health.reason}" if health.reason else f"health {health.state}"
