"""The autopilot as a partner: who it is, what time it has, and asking it until it does what we need.

Source: MAVLink developer guide, Time Synchronization Protocol v2, MAVLink Id Assignment.
"""

from collections.abc import Callable
from dataclasses import dataclass

from pymavlink.dialects.v20 import all as mavlink2

from companion.config import Config
from companion.mavlink.requests import OriginKeeper, StreamRequests, wanted_rates
from drivers.autopilot_clock import AutopilotClock
from drivers.mavlink_frames import AutopilotIdentity, MavlinkMessage

TIMESYNC_PERIOD_NS = 100_000_000
SILENT_NS = 5_000_000_000
"""An autopilot that was not heard for so long is gone."""
_OLDEST_REQUEST_NS = 10_000_000_000


@dataclass(frozen=True, slots=True)
class Watch:
    """Somebody else who wants to hear the autopilot.

    Attributes:
        rates: message name -> rate that it is asked for [Hz].
        hear: takes every message of the autopilot, and when it arrived [ns].
    """

    rates: dict[str, float]
    hear: Callable[[MavlinkMessage, int], None]


class AutopilotContact:
    """Follows one autopilot through reboots and silence.

    Args:
        config: of the site.
        watch: who else wants to hear it.

    Attributes:
        identity: who it is.
        clock: its clock.
    """

    def __init__(self, config: Config, watch: Watch | None) -> None:
        self._table = config.mavlink
        self._watch = watch
        self.identity = AutopilotIdentity(config.mavlink.autopilot_id)
        self.clock = AutopilotClock()
        self._origin = OriginKeeper(config.site.origin)
        self._streams: StreamRequests | None = None
        self._timesync_due_ns = 0
        self._boots, self._is_silent, self._rival_told = 0, False, False
        self._news: list[str] = []

    def hear(self, message: MavlinkMessage, arrival_ns: int, now_ns: int) -> list[MavlinkMessage]:
        """Answers to a message of the autopilot.

        Args:
            message: of the autopilot itself.
            arrival_ns: when it came.
            now_ns: time now.
        """
        if self._streams is not None:
            self._streams.hear(message)
        if self._watch is not None:
            self._watch.hear(message, arrival_ns)
        match message.get_type():
            case "TIMESYNC" if message.tc1 == 0:
                # Halfway between arrival and answer, so that our own delay falls out.
                return [mavlink2.MAVLink_timesync_message((arrival_ns + now_ns) // 2, message.ts1)]
            case "TIMESYNC" if 0 <= arrival_ns - message.ts1 < _OLDEST_REQUEST_NS:
                self.clock.answered(message.ts1, message.tc1, arrival_ns)
            case "GPS_GLOBAL_ORIGIN":
                was_far = self._origin.is_far
                self._origin.hear(message)
                if self._origin.is_far and not was_far:
                    far = f"{self._origin.distance:.0f} m away"
                    self._news.append(f"autopilot keeps another origin, {far}")
        return []

    def poll(self, now_ns: int) -> list[MavlinkMessage]:
        """What it is to be asked at `now_ns`; all of it again when it was started anew."""
        identity = self.identity
        if identity.rival is not None and not self._rival_told:
            self._rival_told = True
            self._news.append("two autopilots heard: set mavlink.autopilot_id")
        if identity.system is None or identity.heard_ns is None:
            return []
        silent = now_ns - identity.heard_ns > SILENT_NS
        if identity.boots != self._boots or (self._is_silent and not silent):
            self._boots = identity.boots
            self._origin.restart()
            self._streams = None
        self._is_silent = silent
        if silent:
            return []
        if self._streams is None:
            rates = wanted_rates(self._table, identity.kind)
            if self._watch is not None:
                rates = {**rates, **self._watch.rates}
            self._streams = StreamRequests(rates)
        requests = self._streams.poll(identity.system, now_ns) + self._origin.poll(identity.system, now_ns)
        if now_ns >= self._timesync_due_ns:
            self._timesync_due_ns = now_ns + TIMESYNC_PERIOD_NS
            requests.append(mavlink2.MAVLink_timesync_message(0, now_ns))
        return requests

    def take_news(self) -> list[str]:
        """What the operator should know, since the last call."""
        news, self._news = self._news, []
        return news
