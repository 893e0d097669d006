"""A run in Rerun, the same live and in review: map, time series, states and text from ticks and MAVLink.

Ticks are drawn in batches: columns of many values cost a small part of what one call a value would.
"""

import numpy as np
import rerun as rr

from companion.config import Config
from companion.events import Event, EventFinder
from companion.log import RawChunk, Truth
from companion.mavlink.link import NAME as MAVLINK
from companion.mavlink.listener import Heard, LinkListener
from companion.pipeline import Tick
from companion.view.batch import Batch
from companion.view.blueprint import Layout
from companion.view.entities import Entities
from companion.view.line import Line
from companion.view.map_scene import MapScene
from companion.view.plots import Plots
from companion.view.states import States

MEMORY_NS = 1_500_000_000
"""Poses so long before a batch are kept: the oldest beam of its first scan was measured there."""


class Scene:
    """Draws one run into a stream.

    Args:
        config: of the site.
        names: estimators, the primary first: of it pose, covariance and verdicts are shown; of the others,
            tracks and errors.
        stream: of Rerun.
        start_ns: of the run; times and frames count from here.
        root: entity below which everything is; empty for a single run.
        title: of the run when there are several.
        ends: whether `close` will be called, which draws whole tracks: they are kept until then.

    Attributes:
        events: found so far, each when it was over or clear.
    """

    def __init__(
        self,
        config: Config,
        names: list[str],
        stream: rr.RecordingStream,
        start_ns: int,
        root: str = "",
        title: str = "",
        ends: bool = True,
    ) -> None:
        self._config, self._names, self._title, self._ends = config, names, title, ends
        self._entities = Entities(stream, start_ns, config.pipeline.rate, root)
        self._map = MapScene(self._entities, config, names, keeps_tracks=ends)
        self._plots = Plots(self._entities, config, self._map.colours)
        self._states = States(self._entities, config)
        self._before: list[Tick] = []
        self._ticks: list[Tick] = []
        self._truths: list[Truth] = []
        self._heard: list[Heard] = []
        self._lines: list[Line] = []
        self._has_truth = self._has_autopilot = False
        self._finder = EventFinder(config, names[0])
        self._listener = LinkListener(config.map_heading())
        self.events: list[Event] = []

    def tick(self, tick: Tick, truth: Truth | None) -> None:
        """Take one tick; fits `on_tick` of `companion.replay.replay`.

        Args:
            tick: as the pipeline gives it.
            truth: newest true pose before it, None without truth.
        """
        self._ticks.append(tick)
        if truth is not None and (not self._truths or truth is not self._truths[-1]):
            self._truths.append(truth)
            self._has_truth = True
        self._mark(self._finder.tick(tick))

    def chunk(self, chunk: RawChunk) -> None:
        """Take bytes that crossed a port; those of the link to the autopilot are read along."""
        if chunk.source == MAVLINK:
            self._heard += self._listener.listen(chunk)

    def say(self, line: Line) -> None:
        """Take a line for the text log."""
        self._lines.append(line)

    def _mark(self, events: list[Event]) -> None:
        self.events += events
        self._lines += [Line(event.stamp_ns, str(event), "WARN") for event in events]

    @property
    def waiting(self) -> int:
        """Ticks that are not drawn yet."""
        return len(self._ticks)

    def send(self) -> None:
        """Draw what was taken but the newest tick, whose scans and truth lie between it and the next."""
        if len(self._ticks) > 1:
            self._draw(self._ticks[:-1], self._ticks[-1])
            self._ticks = self._ticks[-1:]
        self._send_link()

    def close(self) -> None:
        """Draw all that is left, and the whole tracks."""
        if self._ticks:
            self._draw(self._ticks, None)
            self._ticks = []
        self._mark(self._finder.close())
        self._send_link()
        if self._ends:
            self._states.close()
            self._map.close()
            self._plots.close()

    def layout(self) -> Layout:
        """What a blueprint for all that was drawn so far is made from."""
        return Layout(
            config=self._config,
            names=self._names,
            plots=dict(self._entities.plots),
            has_truth=self._has_truth,
            has_autopilot=self._has_autopilot,
            root=self._entities.root,
            title=self._title,
        )

    def _draw(self, ticks: list[Tick], after: Tick | None) -> None:
        batch = Batch(self._names, self._before, ticks, self._truths, after)
        self._map.send(batch)
        self._plots.send(batch)
        self._states.send(batch)
        oldest_ns = ticks[-1].stamp_ns - MEMORY_NS
        self._before = [tick for tick in [*self._before, *ticks] if tick.stamp_ns >= oldest_ns]
        self._truths = [truth for truth in self._truths if truth.stamp_ns >= oldest_ns]

    def _send_link(self) -> None:
        places = [(h.stamp_ns, h.xy) for h in self._heard if h.xy is not None]
        if places:
            self._has_autopilot = True
            self._map.send_autopilot(np.array([ns for ns, _ in places]), np.array([xy for _, xy in places]))
        sent = [(h.stamp_ns, h.latency) for h in self._heard if h.latency is not None]
        if sent:
            stamps_ns, seconds = np.array([ns for ns, _ in sent]), np.array([age for _, age in sent])
            self._plots.send_latency(stamps_ns, seconds)
        lines = [Line(h.stamp_ns, h.text, "WARN" if h.is_urgent else "INFO") for h in self._heard if h.text]
        if lines or self._lines:
            self._states.say(self._lines + lines)
        self._heard, self._lines = [], []
