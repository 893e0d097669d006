"""The anchors on the map: where they are, whose colour is whose, and what is the matter with each."""

from itertools import cycle

import numpy as np
import rerun as rr

from companion.config import Config
from companion.health import AnchorState, HealthMonitor
from companion.view.batch import Batch
from companion.view.entities import Entities
from companion.view.palette import ANCHORS, GREEN, GREY, VERMILION, rgba, screen
from estimators.messages import IntArray


class AnchorMarks:
    """Draws every anchor with its name, and a ring: green when used lately, else with the reason.

    Args:
        entities: to write to.
        config: of the site.
    """

    def __init__(self, entities: Entities, config: Config) -> None:
        self._entities = entities
        self._monitor = HealthMonitor(config.health, False, False, anchor_ids=config.anchors)
        self._shown: list[AnchorState] = []
        positions = np.array(list(config.anchors.values()))[:, :2]
        colours = anchor_colours(config)
        marks = rr.Points2D(positions, colors=rgba(colours.values()), radii=screen(5.0), draw_order=46.0)
        entities.static("map/anchors", marks)
        rings = rr.Points2D.from_fields(positions=positions, radii=screen(9.0), draw_order=45.0)
        entities.static("map/anchor_state", rings)

    def send(self, batch: Batch) -> None:
        """Draw the changes within a batch."""
        changes: list[tuple[int, list[AnchorState]]] = []
        frames = iter(batch.frames)
        frame = next(frames, None)
        for stamp_ns in batch.stamps_ns.tolist():
            while frame is not None and frame[0].stamp_ns <= stamp_ns:
                self._monitor.observe(*frame)
                frame = next(frames, None)
            states = self._monitor.anchors(stamp_ns)
            if states != self._shown:
                self._shown = states
                changes.append((stamp_ns, states))
        if changes:
            self._send_changes(np.array([stamp_ns for stamp_ns, _ in changes]), [c for _, c in changes])

    def _send_changes(self, stamps_ns: IntArray, changes: list[list[AnchorState]]) -> None:
        count = len(changes[0])
        labels = [f"A{s.anchor_id} {s.trouble}".rstrip() for states in changes for s in states]
        columns = rr.Points2D.columns(labels=labels).partition([count] * len(changes))
        self._entities.columns("map/anchors", stamps_ns, columns)
        rings = rgba(_colour(state) for states in changes for state in states)
        columns = rr.Points2D.columns(colors=rings).partition([count] * len(changes))
        self._entities.columns("map/anchor_state", stamps_ns, columns)


def anchor_colours(config: Config) -> dict[int, int]:
    """The colour of each anchor, on the map and in plots."""
    return dict(zip(config.anchors, cycle(ANCHORS), strict=False))


def _colour(state: AnchorState) -> int:
    if state.is_used:
        return GREEN
    return VERMILION if state.reason else GREY
