"""A session and a scripted autopilot joined in memory, in simulated time, with a latency if wanted."""

import heapq
from collections.abc import Callable

import numpy as np
from pymavlink.dialects.v20 import all as mavlink2

from companion.config import Config, load_config
from companion.health import Health, State
from companion.mavlink.link import NAME
from companion.mavlink.session import MavlinkSession
from estimators.geometry import lift
from estimators.messages import PoseEstimate
from tests.companion.mavlink.scripted_autopilot import ScriptedAutopilot
from tests.conftest import SITE

OK = Health(State.OK, "")
LOST = Health(State.LOST, "2 of 4 anchors")
START_NS = 50_000_000_000
TICK_NS = 33_333_333
STEP_NS = 1_000_000


def site(**mavlink: object) -> Config:
    """The demo room with settings of `[mavlink]`, or of other tables as `table__key`."""
    sets = []
    for key, value in mavlink.items():
        path = key.replace("__", ".") if "__" in key else f"mavlink.{key}"
        sets.append(f"{path}={_toml(value)}")
    return load_config(SITE, sets)


def planar(x: float, y: float, yaw_deg: float, stamp_ns: int = 0, resets: int = 0) -> PoseEstimate:
    T = lift(np.array([x, y, np.deg2rad(yaw_deg)]), 0.3)
    cov = np.diag([0.01, 0.02, 0.0025, 0.003, 0.003, 0.004])
    return PoseEstimate(stamp_ns, T, cov, resets, np.array([0.3, 0.1, 0.0]), 0.01 * np.eye(3))


def messages(data: bytes) -> list[mavlink2.MAVLink_message]:
    """What pymavlink's own parser makes of bytes."""
    parser = mavlink2.MAVLink(None)
    parser.robust_parsing = True
    return parser.parse_buffer(data) or []


class Flight:
    """Both sides; each step lasts a millisecond.

    Args:
        config: of the site.
        autopilot: the far side.
        delay: draws how long a chunk travels [s].
        session: instead of a plain one.
    """

    def __init__(
        self,
        config: Config,
        autopilot: ScriptedAutopilot | None = None,
        delay: Callable[[], float] = lambda: 0.0,
        session: MavlinkSession | None = None,
    ) -> None:
        self.now_ns = START_NS
        self.session = session or MavlinkSession(config)
        self.autopilot = autopilot or ScriptedAutopilot(self.now_ns)
        self.health = OK
        self.pose: Callable[[int], PoseEstimate | None] = lambda stamp_ns: planar(1.0, 2.0, 10.0, stamp_ns)
        self.link_is_up = True
        self._delay = delay
        self._travelling: list[tuple[int, int, str, bytes]] = []
        self._sent = 0
        self._next_tick_ns = START_NS

    def fly(self, seconds: float) -> None:
        """Go on for some time."""
        end_ns = self.now_ns + round(seconds * 1e9)
        while self.now_ns < end_ns:
            self._step()
            self.now_ns += STEP_NS

    def _step(self) -> None:
        if self.now_ns >= self._next_tick_ns:
            self._next_tick_ns += TICK_NS
            self.session.tick(self.pose(self.now_ns), self.health, self.now_ns)
        self._send("autopilot", self.session.take().get(NAME, b""))
        self._send("companion", self.autopilot.poll(self.now_ns))
        while self._travelling and self._travelling[0][0] <= self.now_ns:
            _, _, to, data = heapq.heappop(self._travelling)
            if to == "autopilot":
                self.autopilot.feed(data, self.now_ns)
            else:
                self.session.receive(NAME, data, self.now_ns, self.now_ns)

    def _send(self, to: str, data: bytes) -> None:
        if data and self.link_is_up:
            self._sent += 1
            at_ns = self.now_ns + round(self._delay() * 1e9)
            heapq.heappush(self._travelling, (at_ns, self._sent, to, data))


def _toml(value: object) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + "}"
    return str(value).lower() if isinstance(value, bool) else repr(value)
