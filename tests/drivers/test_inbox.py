"""The inbox: in order, bounded for each port, and fair."""

import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.inbox import CHUNK_BYTES, TURN, Inbox
from drivers.port import Arrival, PortEvent, PortStatus


def arrival(name: str, stamp_ns: int, data: bytes = b"x") -> Arrival:
    return Arrival(name, stamp_ns, data)


def take_all(inbox: Inbox) -> list[PortEvent]:
    events = []
    while some := inbox.take(0.0):
        events += some
    return events


@given(
    st.lists(st.tuples(st.sampled_from("ab"), st.integers(0, 50), st.booleans()), max_size=80),
    st.integers(0, 20 * CHUNK_BYTES),
)
def test_what_is_not_given_out_is_counted_and_statuses_always_come(
    puts: list[tuple[str, int, bool]], room: int
) -> None:
    inbox = Inbox("ab", room)
    sent: list[PortEvent] = []
    for stamp_ns, (name, size, is_status) in enumerate(puts):
        event = PortStatus(name, stamp_ns, True, "") if is_status else arrival(name, stamp_ns, bytes(size))
        sent.append(event)
        inbox.put(event)
    given_out = take_all(inbox)
    for name in "ab":
        mine = [event for event in given_out if event.name == name]
        assert mine == [event for event in sent if event in mine]
        assert sum(event.name == name for event in sent) == len(mine) + inbox.dropped[name]
        chunks = [event for event in mine if isinstance(event, Arrival)]
        assert sum(CHUNK_BYTES + len(chunk.data) for chunk in chunks) <= room
    assert [e for e in sent if isinstance(e, PortStatus)] == sorted(
        (e for e in given_out if isinstance(e, PortStatus)), key=lambda e: e.stamp_ns
    )


def test_a_port_that_floods_loses_its_own_chunks_only() -> None:
    inbox = Inbox(["flood", "uwb"], room=10 * CHUNK_BYTES)
    for stamp_ns in range(1000):
        inbox.put(arrival("flood", stamp_ns, b""))
    inbox.put(arrival("uwb", 1000))
    assert inbox.dropped == {"flood": 990, "uwb": 0}
    assert arrival("uwb", 1000) in inbox.take(0.0)


def test_a_port_with_much_waiting_does_not_take_the_turn_of_others() -> None:
    inbox = Inbox(["flood", "uwb"])
    for stamp_ns in range(10 * TURN):
        inbox.put(arrival("flood", stamp_ns))
    inbox.put(arrival("uwb", 5))
    first = inbox.take(0.0)
    assert arrival("uwb", 5) in first
    assert len(first) == TURN + 1
    assert [event.stamp_ns for event in first] == sorted(event.stamp_ns for event in first)


def test_room_is_free_again_for_what_was_taken() -> None:
    inbox = Inbox(["uwb"], room=2 * (CHUNK_BYTES + 1))
    for stamp_ns in range(50):
        inbox.put(arrival("uwb", stamp_ns))
        assert inbox.take(0.0) == [arrival("uwb", stamp_ns)]
    assert inbox.dropped == {"uwb": 0}


def test_taking_waits_for_an_event() -> None:
    inbox = Inbox(["uwb"])
    taken: list[PortEvent] = []
    taker = threading.Thread(target=lambda: taken.extend(inbox.take(10.0)))
    taker.start()
    time.sleep(0.05)
    inbox.put(arrival("uwb", 1))
    taker.join(timeout=5.0)
    assert taken == [arrival("uwb", 1)]


def test_a_name_that_is_no_port_is_a_mistake() -> None:
    with pytest.raises(KeyError):
        Inbox(["uwb"]).put(arrival("lidar", 0))
