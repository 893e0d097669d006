"""A log's poses to an autopilot in real time, as if the run happened now."""

import queue
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from companion.config import Config
from companion.follow import RATES, FollowScore
from companion.health import Health, State
from companion.log import Log, RawChunk
from companion.mavlink.contact import Watch
from companion.mavlink.link import NAME, wire_opener
from companion.mavlink.pose_out import to_ned
from companion.mavlink.session import MavlinkSession
from companion.pipeline import Chain, Tick, make_pipeline
from drivers.port import Arrival, Port, PortEvent
from estimators.messages import FloatArray, PoseEstimate

PATIENCE = 10.0
"""How long an autopilot is waited for before the first pose [s]."""


class Player:
    """Plays one log.

    Args:
        log: to play.
        config: with the link.
        primary: name of the estimator whose pose is sent.
        speed: 2 = twice as fast as it was.
        say: takes one line for the operator when the link changes.
    """

    def __init__(
        self, log: Log, config: Config, primary: str, speed: float, say: Callable[[str], None]
    ) -> None:
        self._log, self._config, self._speed, self._say = log, config, speed, say
        self._primary = primary
        self._pose: PoseEstimate | None = None
        self.score = FollowScore(self._expected)
        self._session = MavlinkSession(config, watch=Watch(RATES, self.score.hear))
        self._events: queue.Queue[PortEvent] = queue.Queue()
        url = config.mavlink.url
        self._link = Port(NAME, url, wire_opener(url, config.mavlink.baud, "mavlink.url"), self._events.put)

    @property
    def poses_sent(self) -> int:
        """Poses given to the link."""
        return self._session.poses_packed

    def play(self) -> None:
        """Send every pose when it is due."""
        primary = self._primary
        chain = Chain(self._config, self._log.start_ns, make_pipeline(self._config, [primary]), primary)
        self._link.start()
        try:
            begin_ns = self._meet()
            for record in self._log:
                if isinstance(record, RawChunk):
                    for tick in chain.feed(record):
                        due_ns = begin_ns + round((tick.stamp_ns - self._log.start_ns) / self._speed)
                        self._serve_until(due_ns)
                        self._send(tick, tick.poses[primary], due_ns)
            self._serve_until(time.monotonic_ns() + 500_000_000)
        finally:
            self._link.close()

    def _meet(self) -> int:
        """Wait for the autopilot, for a while; gives the time at which the log begins."""
        end = time.monotonic() + PATIENCE
        health = Health(State.STARTING, "the log has not begun")
        while self._session.autopilot is None and time.monotonic() < end:
            self._session.tick(None, health, time.monotonic_ns())
            self._serve_until(time.monotonic_ns() + 20_000_000)
        if self._session.autopilot is None:
            self._say("no autopilot heard: playing all the same")
        return time.monotonic_ns()

    def _send(self, tick: Tick, pose: PoseEstimate | None, due_ns: int) -> None:
        self._pose = None if pose is None else replace(pose, stamp_ns=due_ns)
        for outcome in tick.outcomes:
            self._session.observe(outcome.measurement, outcome.reports[self._primary])
        self._session.tick(self._pose, tick.health, time.monotonic_ns())
        self._flush()

    def _serve_until(self, due_ns: int) -> None:
        """Talk to the autopilot until something is due."""
        while True:
            wait = (due_ns - time.monotonic_ns()) * 1e-9
            try:
                event = self._events.get(timeout=max(wait, 0.0)) if wait > 0.0 else self._events.get_nowait()
            except queue.Empty:
                self._flush()
                return
            if isinstance(event, Arrival):
                self._session.receive(NAME, event.data, event.stamp_ns, time.monotonic_ns())
                self._flush()
            else:
                self._say(event.message)

    def _flush(self) -> None:
        for data in self._session.take().values():
            self._link.write(data)

    def _expected(self, _: int) -> FloatArray | None:
        heading = self._session.map_heading
        if self._pose is None or heading is None:
            return None
        return np.asarray(to_ned(self._pose, heading).position[:2])
