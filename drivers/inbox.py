"""Where the events of all ports wait for the one loop that works on them.

Each port has its own room: one that floods loses its own chunks, which are counted, and costs the others
neither room nor their turn.
"""

import threading
from collections import deque
from collections.abc import Iterable

from drivers.port import Arrival, PortEvent

ROOM = 2_000_000
"""Memory that the waiting chunks of one port may take [bytes]: some ten seconds of a busy serial line."""
CHUNK_BYTES = 150
"""What a chunk takes besides its data [bytes]; so that a million chunks of one byte are bounded too."""
TURN = 16
"""Events of one port that are given out before the others have their turn."""


class Inbox:
    """Events of several ports, put by their threads and taken by one.

    Args:
        names: of the ports.
        room: for the waiting chunks of each of them [bytes].

    Attributes:
        dropped: chunks that found no room, by port.
    """

    def __init__(self, names: Iterable[str], room: int = ROOM) -> None:
        self._waiting: dict[str, deque[PortEvent]] = {name: deque() for name in names}
        self._room = dict.fromkeys(self._waiting, room)
        self._changed = threading.Condition()
        self.dropped = dict.fromkeys(self._waiting, 0)

    def put(self, event: PortEvent) -> None:
        """Take an event of a port; a chunk without room is dropped, a change of status never."""
        with self._changed:
            cost = _cost(event)
            if cost > self._room[event.name]:
                self.dropped[event.name] += 1
                return
            self._room[event.name] -= cost
            self._waiting[event.name].append(event)
            self._changed.notify()

    def take(self, timeout: float) -> list[PortEvent]:
        """Wait for events; then the oldest few of every port, in order of their stamps.

        Args:
            timeout: longest wait [s].
        """
        with self._changed:
            self._changed.wait_for(lambda: any(self._waiting.values()), timeout)
            events: list[PortEvent] = []
            for name, waiting in self._waiting.items():
                turn = [waiting.popleft() for _ in range(min(len(waiting), TURN))]
                self._room[name] += sum(map(_cost, turn))
                events += turn
        return sorted(events, key=lambda event: event.stamp_ns)


def _cost(event: PortEvent) -> int:
    return CHUNK_BYTES + len(event.data) if isinstance(event, Arrival) else 0
