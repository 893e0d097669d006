"""The process beside the autopilot: ports and the MAVLink link in threads, everything else in one loop.

The loop logs every chunk before it is decoded and works in the order of the log, so that a replay of
the log goes through the same steps.
"""

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from companion.config import Config
from companion.config_tables import SensorTable
from companion.errors import UserError
from companion.health import Health, uwb_line
from companion.log import Direction, LogWriter, RawChunk
from companion.mavlink.budget import budget_warning
from companion.mavlink.contact import Watch
from companion.mavlink.link import GROUND, wire_opener
from companion.mavlink.link import NAME as MAVLINK
from companion.mavlink.parameters import save_setting, setting_line
from companion.mavlink.session import MavlinkSession
from companion.mavlink.signing import SigningClock, read_key
from companion.pipeline import Chain, Tick, make_pipeline
from companion.range_log import HEADER, range_lines
from companion.replay import tum_line
from companion.run_folder import RAW_LOG
from companion.view.drawing import Item
from companion.view.line import Line
from companion.view.live_view import LiveView
from companion.view.viewer import Shown, check_viewer
from drivers import dtr_stops
from drivers.discovery import Finder
from drivers.inbox import Inbox
from drivers.port import AutoAddress, Port, PortEvent, PortStatus, parse_address
from drivers.serial_line import SerialWire
from estimators.messages import PoseEstimate, RangeFrame

LONGEST_WAIT = 0.02
"""The loop looks at the dialogues of its devices at least this often [s]."""
CLOSING_PAUSE = 0.01
"""After each of the last words to a device [s]."""
DROPS_PERIOD_NS = 5_000_000_000
"""The operator hears of dropped chunks at most this often."""
ANCHORS_PERIOD_NS = 2_000_000_000
"""The operator hears at most this often which anchors are used."""


@dataclass(slots=True)
class LiveStatus:
    """What a run shows of itself.

    Attributes:
        pose: newest pose, or None.
        health: its judgement, or None before the first tick.
        poses_sent: poses given to the link.
        autopilot: system id of the autopilot, None until it was heard.
        dropped: chunks lost because the loop could not keep up, by port.
        stale_ticks: poses not sent because they were computed too late.
    """

    pose: PoseEstimate | None = None
    health: Health | None = None
    poses_sent: int = 0
    autopilot: int | None = None
    dropped: dict[str, int] = field(default_factory=dict)
    stale_ticks: int = 0

    @property
    def dropped_chunks(self) -> int:
        """Chunks lost on all ports together."""
        return sum(self.dropped.values())


class LiveRun:
    """One run: opens everything, loops until told to stop, leaves a run folder.

    Args:
        config: of the site.
        folder: gets `raw.mcap`, `config.toml`, `poses.tum` and `ranges.csv`.
        say: takes one line for the operator when a port or the health changes.
        watch: who else wants to hear the autopilot.
        view: where the run is shown while it runs.

    Raises:
        UserError: the folder cannot be written, the MAVLink device string makes no sense, or the view
            cannot be opened.
    """

    def __init__(
        self,
        config: Config,
        folder: Path,
        say: Callable[[str], None],
        watch: Watch | None = None,
        view: Shown = "off",
    ) -> None:
        self._inbox = Inbox([*config.sensor, MAVLINK, GROUND])
        self.status = LiveStatus(dropped=self._inbox.dropped)
        self._operator = say
        self._view: LiveView | None = None
        self._drops_said, self._drops_due_ns = 0, 0
        self._anchors_said = ""
        # First what may refuse its settings, so that a wrong call leaves no folder behind.
        urls = {MAVLINK: config.mavlink.url, GROUND: config.mavlink.ground_url}
        keys = {MAVLINK: "mavlink.url", GROUND: "mavlink.ground_url"}
        self._links = {
            name: Port(name, url, wire_opener(url, config.mavlink.baud, keys[name]), self._inbox.put)
            for name, url in urls.items()
            if url
        }
        self._parameter_file = config.mavlink.parameter_file
        key_file = config.mavlink.signing_key
        self._signing_clock = SigningClock(Path(key_file)) if key_file else None
        key = read_key(Path(key_file)) if key_file else None
        self._session = MavlinkSession(config, key, self._signing_clock, watch)
        self._config, self._start_ns = config, time.monotonic_ns()
        self._anchors_due_ns = self._start_ns + ANCHORS_PERIOD_NS
        if view != "off":
            check_viewer(view, config.view)
        self._log = LogWriter(folder / RAW_LOG, config.to_toml(), self._start_ns)
        try:
            (folder / "config.toml").write_text(config.to_toml(), encoding="utf-8")
            self._poses = (folder / "poses.tum").open("w", encoding="utf-8", buffering=1)
            self._ranges = (folder / "ranges.csv").open("w", encoding="utf-8", buffering=1)
            self._ranges.write(HEADER)
        except OSError as error:
            raise UserError(f"cannot write to {folder}: {error.strerror}") from error
        self._primary = config.pipeline.estimator
        self._period_ns = round(1e9 / config.pipeline.rate)
        if view != "off" or config.view.record:
            files = folder / "view.rrd" if config.view.record else None
            self._view = LiveView(config, [self._primary], self._start_ns, view, files, say)
        self._ports = {name: self._make_port(name, table) for name, table in config.sensor.items()}
        self._open_sensors: set[str] = set()
        if warning := budget_warning(config):
            say(warning)

    def run(self, stop: threading.Event) -> None:
        """Work until `stop` is set, then leave the devices quiet and close everything."""
        for port in (*self._ports.values(), *self._links.values()):
            port.start()
        try:
            # Estimators take a second to load; what arrives meanwhile waits.
            pipeline = make_pipeline(self._config, [self._primary])
            self._chain = Chain(
                self._config, self._start_ns, pipeline, self._primary, watched=self._view is not None
            )
            self._ready_ns = time.monotonic_ns()
            self._loop(stop)
        finally:
            self._close()

    def _loop(self, stop: threading.Event) -> None:
        try:
            # What came while all was loading, before any tick that is later.
            while not stop.is_set() and self._take_waiting(0.0):
                pass
            while not stop.is_set():
                until_tick = (self._chain.next_tick_ns - time.monotonic_ns()) * 1e-9
                self._take_waiting(min(max(until_tick, 0.0), LONGEST_WAIT))
                self._work(self._chain.advance(time.monotonic_ns()))
                self._talk_to_devices()
                self._say_drops()
        finally:
            self._leave_devices()

    def _make_port(self, name: str, table: SensorTable) -> Port:
        address = parse_address(table.port)
        if isinstance(address, AutoAddress):
            closing = threading.Event()
            finder = Finder(address, table.driver, closing)
            return Port(name, finder, finder, self._inbox.put, closing)
        return Port(name, address, lambda: SerialWire(address, dtr_stops(table.driver)), self._inbox.put)

    def _take_waiting(self, timeout: float) -> bool:
        """Wait so long [s] for events, then take a turn of every port; whether there were any."""
        events = self._inbox.take(timeout)
        for event in events:
            self._take(event)
        return bool(events)

    def _take(self, event: PortEvent) -> None:
        if isinstance(event, PortStatus):
            self._say(f"{event.name}: {event.message}")
            if event.name in self._chain.sensors:
                self._set_open(event)
            return
        stamp_ns = self._chain.stamp_to_log(event.stamp_ns)
        chunk = RawChunk(event.name, Direction.IN, stamp_ns, event.data)
        self._log.raw(chunk)
        if event.name in self._links:
            self._show(chunk)
            self._session.receive(event.name, event.data, event.stamp_ns, time.monotonic_ns())
            self.status.autopilot = self._session.autopilot
            self._take_over_parameters()
            self._send_mavlink()
        self._work(self._chain.feed(chunk))

    def _set_open(self, status: PortStatus) -> None:
        if status.is_open:
            self._open_sensors.add(status.name)
            self._chain.sensors[status.name].connected(status.stamp_ns)
        else:
            self._open_sensors.discard(status.name)

    def _work(self, ticks: Iterable[Tick]) -> None:
        for tick in ticks:
            self._give_out(tick)

    def _give_out(self, tick: Tick) -> None:
        pose = tick.poses[self._primary]
        self._show(tick)
        if pose is not None:
            self._poses.write(tum_line(pose))
        for outcome in tick.outcomes:
            if isinstance(outcome.measurement, RangeFrame):
                self._ranges.write(range_lines(outcome.measurement, outcome.reports[self._primary]))
        self._say_anchors(tick.stamp_ns)
        if self.status.health is None or tick.health.state != self.status.health.state:
            self._operator(
                f"health: {tick.health.state}" + (f" ({tick.health.reason})" * bool(tick.health.reason))
            )
        self.status.pose, self.status.health = pose, tick.health
        now_ns = time.monotonic_ns()
        # The loop fell behind: an autopilot is better off with a gap than with a burst of old poses.
        is_late = now_ns - tick.stamp_ns > self._period_ns
        self.status.stale_ticks += is_late and tick.stamp_ns > self._ready_ns
        packed = self._session.poses_packed
        for outcome in tick.outcomes:
            self._session.observe(outcome.measurement, outcome.reports[self._primary])
        self._session.tick(pose, tick.health, now_ns, is_late)
        if MAVLINK in self._send_mavlink():
            self.status.poses_sent += self._session.poses_packed - packed
        if self._signing_clock is not None:
            self._signing_clock.save(now_ns)

    def _send_mavlink(self) -> set[str]:
        """Write what the session has to say; gives the links that took it."""
        sent = set()
        for name, data in self._session.take().items():
            if name in self._links and self._links[name].write(data):
                chunk = RawChunk(name, Direction.OUT, time.monotonic_ns(), data)
                self._log.raw(chunk)
                self._show(chunk)
                sent.add(name)
        return sent

    def _take_over_parameters(self) -> None:
        """Use and keep what a ground station has set."""
        for parameter, config in self._session.take_changes():
            line = setting_line(parameter, config)
            when = "" if parameter.applies_at_once else ", from the next start on"
            self._say(f"{parameter.name} set by the ground station: {line}{when}")
            if parameter.applies_at_once:
                self._chain.set_health(config.health)
            if self._parameter_file:
                try:
                    save_setting(Path(self._parameter_file), line)
                except UserError as error:
                    self._say(str(error))

    def _say(self, line: str) -> None:
        self._operator(line)
        self._show(Line(time.monotonic_ns(), line))

    def _show(self, item: Item) -> None:
        if self._view is not None:
            self._view.put(item)

    def _talk_to_devices(self) -> None:
        for name, sensor in self._chain.sensors.items():
            if name in self._open_sensors:
                self._send(name, sensor.poll(time.monotonic_ns()))

    def _send(self, name: str, data: bytes) -> None:
        if data and self._ports[name].write(data):
            self._log.raw(RawChunk(name, Direction.OUT, time.monotonic_ns(), data))

    def _say_drops(self) -> None:
        now_ns = time.monotonic_ns()
        if self.status.dropped_chunks > self._drops_said and now_ns >= self._drops_due_ns:
            self._drops_said, self._drops_due_ns = self.status.dropped_chunks, now_ns + DROPS_PERIOD_NS
            names = ", ".join(f"{name} {count}" for name, count in self.status.dropped.items() if count)
            self._say(f"chunks dropped, they come faster than they can be used: {names}")

    def _say_anchors(self, now_ns: int) -> None:
        if now_ns >= self._anchors_due_ns:
            line = uwb_line(self._chain.anchors(now_ns))
            if line != self._anchors_said:
                self._anchors_said, self._anchors_due_ns = line, now_ns + ANCHORS_PERIOD_NS
                self._say(line)

    def _leave_devices(self) -> None:
        # So far a replay gives ticks, though nothing arrived after the last of them.
        self._log.raw(RawChunk(MAVLINK, Direction.IN, self._chain.stamp_to_log(0), b""))
        for name, sensor in self._chain.sensors.items():
            for data in sensor.closing():
                self._send(name, data)
                time.sleep(CLOSING_PAUSE)

    def _close(self) -> None:
        for port in (*self._ports.values(), *self._links.values()):
            port.close()
        self._poses.close()
        self._ranges.close()
        self._log.close()
        if self._view is not None:
            self._view.close()
