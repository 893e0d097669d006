"""When poses are sent: after a while of good health, stopped at once, jumps counted; and what is said."""

from dataclasses import replace

import numpy as np
import pytest

from companion.health import Health, State
from companion.mavlink.announcer import Announcer
from companion.mavlink.gate import Decision, SendGate
from companion.mavlink_table import GateTable
from tests.companion.mavlink.flight import LOST, OK, TICK_NS, Flight, planar, site

SHARP = np.diag([1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-4])


class Stream:
    """A gate and the time."""

    def __init__(self, **settings: float) -> None:
        self.gate = SendGate(GateTable.model_validate(settings), uses_heading=True)
        self.now_ns = 0
        self.resets = 0

    def go(self, seconds: float, x: float = 0.0, yaw_deg: float = 0.0, health: Health = OK) -> list[Decision]:
        """Decisions while a pose stands still."""
        decisions = []
        for _ in range(round(seconds * 1e9 / TICK_NS)):
            self.now_ns += TICK_NS
            pose = replace(planar(x, 0.0, yaw_deg, self.now_ns, self.resets), cov=SHARP)
            decisions.append(self.gate.judge(pose, health, self.now_ns))
        return decisions


def test_a_stream_begins_when_health_has_lasted_and_ends_at_once() -> None:
    stream = Stream(resume_after=0.5)
    first = stream.go(1.0)
    began = next(i for i, decision in enumerate(first) if decision.sends)
    assert began * TICK_NS == pytest.approx(0.5e9, abs=2 * TICK_NS)
    assert all(decision.sends for decision in first[began:])
    assert not any(decision.sends for decision in stream.go(1.0, health=LOST))
    again = stream.go(1.0)
    assert [decision.sends for decision in again] == [decision.sends for decision in first]


def test_health_that_flickers_gives_no_stream() -> None:
    stream = Stream(resume_after=0.5)
    decisions = []
    for _ in range(10):
        decisions += stream.go(0.3) + stream.go(0.1, health=LOST)
    assert not any(decision.sends for decision in decisions)


def test_a_pause_without_a_jump_is_no_reset_and_one_with_it_is() -> None:
    stream = Stream()
    before = stream.go(2.0)[-1].reset_counter
    stream.go(2.0, health=LOST)
    assert stream.go(2.0, x=1.0)[-1].reset_counter == before
    stream.go(2.0, health=LOST)
    # Farther than it can have walked in the second that allowance is made for.
    assert stream.go(2.0, x=6.0)[-1] == Decision(True, before + 1)


def test_a_jump_that_nobody_announced_is_held_back_and_then_counted() -> None:
    stream = Stream(resume_after=0.5)
    stream.go(1.0)
    after = stream.go(1.0, x=0.8)
    assert not after[0].sends
    assert after[0].held == "the pose jumped by 0.8 m"
    assert next(decision.reset_counter for decision in after if decision.sends) == 1
    began = next(i for i, decision in enumerate(after) if decision.sends)
    assert began * TICK_NS == pytest.approx(0.5e9, abs=2 * TICK_NS)


def test_a_heading_that_jumps_is_held_back_too() -> None:
    stream = Stream()
    stream.go(2.0)
    assert stream.go(0.1, yaw_deg=45.0)[0].held == "the pose jumped by 45 deg"
    deaf = SendGate(GateTable.model_validate({}), uses_heading=False)
    for i in range(100):
        decision = deaf.judge(planar(0, 0, 120.0 * (i % 2), i * TICK_NS), OK, i * TICK_NS)
    assert decision.sends


def test_a_jump_that_the_estimator_announces_goes_through_with_a_new_count() -> None:
    stream = Stream()
    stream.go(2.0)
    stream.resets = 5
    assert stream.go(0.1, x=3.0)[0] == Decision(True, 1)


def test_the_reset_counter_wraps() -> None:
    stream = Stream()
    stream.go(2.0)
    counts = []
    for i in range(1, 300):
        stream.resets = i
        counts.append(stream.go(0.034)[0].reset_counter)
    assert counts == [i % 256 for i in range(1, 300)]


def test_a_walk_is_no_jump() -> None:
    gate = SendGate(GateTable.model_validate({}), uses_heading=True)
    sent = []
    for i in range(300):
        t = i * TICK_NS
        pose = replace(planar(2.0e-9 * t, 0.0, 100e-9 * t, t), cov=SHARP)
        sent.append(gate.judge(pose, OK, t))
    assert all(decision.sends for decision in sent[40:])
    assert sent[-1].reset_counter == 0


def test_noise_that_the_covariance_tells_of_is_no_jump() -> None:
    rng = np.random.default_rng(1)
    gate = SendGate(GateTable.model_validate({}), uses_heading=True)
    sent = 0
    for i in range(1000):
        x, y = rng.normal(0.0, 0.4, 2).tolist()
        pose = planar(x, y, 0.0, i * TICK_NS)
        wide = np.diag([0.16, 0.16, 0.01, 0.01, 0.01, 0.01])
        sent += gate.judge(replace(pose, cov=wide), OK, i * TICK_NS).sends
    assert sent > 950


def test_poses_stop_within_0_3_s_on_the_wire_and_come_back_with_the_jump_counted() -> None:
    flight = Flight(site())
    flight.fly(3.0)
    lost_ns = flight.now_ns
    flight.health = LOST
    flight.fly(2.0)
    last_ns = max(at for at, m in flight.autopilot.heard if m.get_type() == "VISION_POSITION_ESTIMATE")
    assert last_ns - lost_ns < 0.3e9
    before = flight.autopilot.of("VISION_POSITION_ESTIMATE")[-1].reset_counter
    flight.health = OK
    flight.pose = lambda now_ns: planar(7.0, 2.0, 10.0, now_ns)
    flight.autopilot.heard.clear()
    flight.fly(2.0)
    again = flight.autopilot.of("VISION_POSITION_ESTIMATE")
    assert len(again) == pytest.approx(30, abs=2)
    assert {m.reset_counter for m in again} == {before + 1}


@pytest.mark.parametrize(
    ("state", "status"), [(State.STARTING, 1), (State.OK, 4), (State.DEGRADED, 4), (State.LOST, 5)]
)
def test_the_heartbeat_tells_the_state(state: State, status: int) -> None:
    flight = Flight(site())
    flight.health = Health(state, "why")
    flight.fly(2.5)
    assert flight.autopilot.of("HEARTBEAT")[-1].system_status == status


def texts(flight: Flight) -> list[str]:
    return [m.text for m in flight.autopilot.of("STATUSTEXT") if m.id == 0]


def test_the_pilot_is_told_of_changes_and_why_but_not_flooded() -> None:
    flight = Flight(site())
    flight.fly(5.0)
    flight.health = Health(State.DEGRADED, "UWB: 2 of 4 anchors, A3 NLOS")
    flight.fly(5.0)
    flight.health = LOST
    flight.fly(5.0)
    assert texts(flight) == [
        "pose held back: waiting whether it stays good",
        "pose ok",
        "pose degraded: UWB: 2 of 4 anchors, A3 NLOS",
        "pose lost: 2 of 4 anchors",
    ]
    severities = [m.severity for m in flight.autopilot.of("STATUSTEXT")]
    assert severities == [6, 6, 4, 3]
    flight.autopilot.heard.clear()
    for i in range(100):
        flight.health = (OK, LOST)[i % 2]
        flight.fly(0.1)
    assert len(flight.autopilot.of("STATUSTEXT")) <= 5


def test_figures_that_change_are_no_news() -> None:
    announcer = Announcer()
    told = []
    for i in range(300):
        health = Health(State.DEGRADED, f"no range accepted for {i / 30:.1f} s")
        told += announcer.poll(health, Decision(True, 0), i * TICK_NS)
    assert len(told) == 1


def test_a_pose_that_comes_late_is_left_out_and_does_not_stop_the_stream() -> None:
    flight = Flight(site())
    flight.fly(3.0)
    before = flight.session.poses_packed
    for i in range(1, 31):
        now_ns = flight.now_ns + i * TICK_NS
        flight.session.tick(planar(1.0, 2.0, 10.0, now_ns), OK, now_ns, is_late=i % 3 == 0)
    assert flight.session.poses_packed - before == 20
