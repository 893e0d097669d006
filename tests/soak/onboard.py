"""A robot's companion in memory, in simulated time: what the soak runs walk with."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from companion.config import Config
from companion.log import RawChunk
from companion.mavlink.link import NAME
from companion.mavlink.session import MavlinkSession
from companion.pipeline import Chain, Tick, make_pipeline
from companion.shipped_files import params_dir
from companion.sim.autopilot import EmulatedAutopilot
from companion.sim.scenario import Scenario
from companion.sim.simulate import START_NS, converse

BASE = params_dir() / "scenarios" / "square_room.toml"


def scenario_text(path: Path) -> str:
    """Text of a scenario that finds its site from any folder."""
    return path.read_text(encoding="utf-8").replace('"../sites/', f'"{params_dir() / "sites"}/')


@dataclass(frozen=True, slots=True, eq=False)
class Sent:
    """What left at a tick.

    Attributes:
        tick: of the estimation chain.
        now_ns: when it was, counted over all walks.
        data: bytes by the name of the link.
    """

    tick: Tick
    now_ns: int
    data: dict[str, bytes]


class Onboard:
    """One session with one emulated autopilot, over as many walks as there are.

    Args:
        config: of the site.
    """

    def __init__(self, config: Config) -> None:
        self._session = MavlinkSession(config)
        self._autopilot = EmulatedAutopilot()

    def walk(self, scenario: Scenario, primary: str, begin_ns: int = START_NS) -> Iterator[RawChunk | Sent]:
        """Walk a scenario with an estimation chain of its own.

        Args:
            scenario: to walk.
            primary: estimator whose poses are sent.
            begin_ns: when the walk begins, counted over all walks.

        Yields:
            Bytes of the ports before they are decoded, and what left at each tick.
        """
        config, session = scenario.config, self._session
        chain = Chain(config, START_NS, make_pipeline(config, [primary]), primary)
        for item in converse(scenario, chain.sensors):
            if not isinstance(item, RawChunk):
                continue
            yield item
            for tick in chain.feed(item):
                now_ns = begin_ns + tick.stamp_ns - START_NS
                if heard := self._autopilot.poll(now_ns):
                    session.receive(NAME, heard, now_ns, now_ns)
                pose = tick.poses[primary]
                session.tick(pose and replace(pose, stamp_ns=now_ns), tick.health, now_ns)
                yield Sent(tick, now_ns, session.take())
