"""What a scene says in words: the verdict on each anchor's ranges, health, and a text log."""

import numpy as np
import rerun as rr

from companion.config import Config
from companion.health import Health, State
from companion.view.batch import Batch
from companion.view.entities import Entities
from companion.view.line import Level, Line
from companion.view.palette import GREY, STATES, VERDICTS, rgba
from estimators.base import Verdict

_LEVELS: dict[State, Level] = {State.DEGRADED: "WARN", State.LOST: "ERROR"}


class States:
    """Writes lanes of states and lines of text, each only when it changes.

    Args:
        entities: to write to.
        config: of the site.
    """

    def __init__(self, entities: Entities, config: Config) -> None:
        self._entities = entities
        self._verdicts: dict[int, Verdict | None] = dict.fromkeys(config.anchors)
        self._health: Health | None = None
        lanes = rr.StateConfiguration(
            values=list(Verdict),
            labels=list(Verdict),
            colors=rgba(VERDICTS.get(verdict, GREY) for verdict in Verdict),
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

    def _send_verdicts(self, batch: Batch) -> None:
        """A lane for each anchor: the verdict on its ranges, and with it the reason why one was rejected."""
        changes: dict[int, list[tuple[int, Verdict]]] = {}
        for frame, report in batch.frames:
            for i, verdict in zip(frame.anchor_ids.tolist(), report.verdicts, strict=False):
                if i in self._verdicts and self._verdicts[i] is not verdict:
                    self._verdicts[i] = verdict
                    changes.setdefault(i, []).append((frame.stamp_ns, verdict))
        for i, lane in changes.items():
            stamps_ns = np.array([stamp_ns for stamp_ns, _ in lane])
            states = rr.StateChange.columns(state=[verdict for _, verdict in lane])
            self._entities.columns(f"ranges/verdict/A{i}", stamps_ns, states)


def _health_text(health: Health) -> str:
    return f"health {health.state}: {health.reason}" if health.reason else f"health {health.state}"
