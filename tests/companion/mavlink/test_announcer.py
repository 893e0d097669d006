"""What the pilot reads: why there is no pose, or a worse one, in a text that is shown whole."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink2

from companion.config_tables import HealthTable
from companion.health import Health, HealthMonitor
from companion.mavlink.announcer import Announcer
from companion.mavlink.gate import Decision
from companion.mavlink.link import NAME
from estimators.base import Report, Verdict
from estimators.messages import PoseEstimate, PoseIncrement, RangeFrame
from tests.companion.mavlink.flight import Flight, planar, site
from tests.companion.mavlink.scripted_autopilot import SYSTEM

LONGEST = 50
"""Characters of a STATUSTEXT; a longer one needs several, which older ground stations do not join."""
STEP_NS = 100_000_000
GOOD, BLOCKED, GATED = Verdict.ACCEPTED, Verdict.WEAK_FIRST_PATH, Verdict.GATED


def text(health: Health) -> str:
    """What is told of a judgement, by pymavlink's own packing."""
    (message,) = Announcer().poll(health, Decision(health.sends, 0), 0)
    parsed = mavlink2.MAVLink(None).parse_buffer(message.pack(mavlink2.MAVLink(None)))
    assert parsed is not None
    assert len(message.text) <= LONGEST
    return str(parsed[0].text)


class Robot:
    """A monitor and what it is told, at 10 Hz."""

    def __init__(self, anchors: int = 4) -> None:
        self.monitor = HealthMonitor(HealthTable.model_validate({}), True, True, range(anchors))
        self.now_ns = 0

    def goes_on(
        self,
        seconds: float,
        verdicts: list[Verdict] | None,
        moves: bool = True,
        residual: float = 1.0,
        note: str = "",
    ) -> "Robot":
        for _ in range(round(seconds * 1e9 / STEP_NS)):
            self.now_ns += STEP_NS
            if verdicts is not None:
                ones = np.ones(len(verdicts))
                frame = RangeFrame(self.now_ns, 1, np.arange(len(verdicts)), ones, ones, ones)
                self.monitor.observe(frame, Report(tuple(verdicts), residual * ones, ones, note))
            if moves:
                step = PoseIncrement(self.now_ns - 1, self.now_ns, np.zeros(3), np.eye(3), False)
                self.monitor.observe(step, Report((GOOD,), note=note))
        return self

    def told(self, pose: PoseEstimate | None) -> str:
        return text(self.monitor.judge(pose, self.now_ns))


def pose(**changes: object) -> PoseEstimate:
    return replace(planar(1.0, 2.0, 10.0), **changes)  # type: ignore[arg-type]


def wide(index: int, variance: float) -> PoseEstimate:
    cov = np.eye(6) * 0.01
    cov[index, index] = variance
    return pose(cov=cov)


ALL_GOOD = [GOOD] * 4
TOO_LONG = [Verdict.TOO_LONG] * 3


@pytest.mark.parametrize(
    ("robot", "at", "expected"),
    [
        (Robot().goes_on(5, ALL_GOOD), pose(), "pose ok"),
        (Robot(), None, "pose starting: waiting for measurements"),
        (Robot().goes_on(1, ALL_GOOD, note="drive a metre"), None, "pose starting: drive a metre"),
        (Robot().goes_on(0.5, ALL_GOOD, moves=False), pose(), "pose starting: waiting for a LiDAR increment"),
        (Robot().goes_on(0.5, None), pose(), "pose starting: waiting for a range"),
        (Robot().goes_on(5, None), pose(), "pose starting: no range to confirm the start"),
        (Robot().goes_on(9, [GOOD, *TOO_LONG]), pose(), "pose starting: on the mark? 25% of ranges agree"),
        (
            Robot().goes_on(9, [GATED] * 4, residual=-1.0),
            pose(),
            "pose starting: on the mark? 99% ranges too short",
        ),
        (Robot().goes_on(9, [GOOD, *TOO_LONG]), pose(reset_counter=1), "pose starting: 0% of ranges agree"),
        (
            Robot().goes_on(5, ALL_GOOD).goes_on(9, [GATED] * 4),
            pose(),
            "pose lost: UWB 0/4: A0 A1 A2 A3 gated",
        ),
        (
            Robot().goes_on(5, ALL_GOOD).goes_on(3, [GOOD, GOOD, GATED, GATED], residual=-1.0),
            pose(),
            "pose lost: 39% ranges too short",
        ),
        (
            Robot().goes_on(5, ALL_GOOD).goes_on(2, [BLOCKED]),
            pose(),
            "pose degraded: UWB 0/4: A0 NLOS, A1 A2 A3 silent",
        ),
        (
            Robot(9).goes_on(5, ALL_GOOD).goes_on(2, [BLOCKED, BLOCKED]),
            pose(),
            "pose degraded: UWB 0/9: 2 NLOS, 7 silent",
        ),
        (
            Robot().goes_on(5, ALL_GOOD).goes_on(2, ALL_GOOD, moves=False),
            pose(),
            "pose degraded: no LiDAR increment",
        ),
        (
            Robot().goes_on(5, ALL_GOOD).goes_on(2, None, moves=False),
            pose(),
            "pose lost: no range and no LiDAR increment",
        ),
        (Robot().goes_on(5, ALL_GOOD), wide(5, np.inf), "pose lost: heading not known"),
        (Robot().goes_on(5, ALL_GOOD, note="drive a metre"), wide(5, np.inf), "pose lost: drive a metre"),
        (Robot().goes_on(5, ALL_GOOD), wide(5, 1.0), "pose lost: heading sigma 57 deg"),
        (Robot().goes_on(5, ALL_GOOD), wide(0, 4.0), "pose lost: position sigma 2.00 m"),
        (Robot().goes_on(5, ALL_GOOD), wide(2, np.nan), "pose lost: pose or covariance is not finite"),
        (Robot().goes_on(5, ALL_GOOD), wide(2, -1.0), "pose lost: covariance is not positive definite"),
    ],
)
def test_every_reason_is_a_text_that_is_shown_whole(
    robot: Robot, at: PoseEstimate | None, expected: str
) -> None:
    assert robot.told(at) == expected


verdicts = st.lists(st.sampled_from(list(Verdict)), max_size=16)


@given(
    anchors=st.integers(3, 100), parts=st.lists(st.tuples(verdicts, st.booleans()), min_size=1, max_size=4)
)
def test_no_mixture_of_troubles_makes_a_text_too_long(
    anchors: int, parts: list[tuple[list[Verdict], bool]]
) -> None:
    robot = Robot(anchors).goes_on(5, ALL_GOOD)
    for given_, moves in parts:
        robot.goes_on(2, given_ or None, moves)
        robot.told(pose())


def test_what_is_said_besides_the_state_is_shown_whole_too() -> None:
    flight = Flight(site(site__origin={"lat": 48.0, "lon": 11.0}))
    flight.autopilot.origin, flight.autopilot.refuses_origin = (-480_000_000, -1_690_000_000), 1000
    flight.fly(2.0)
    ground = mavlink2.MAVLink(None, srcSystem=255, srcComponent=190)
    for name, value in ((b"ALIGN_COMPASS", 1.0), (b"EST_RANGE_SIGMA", 0.2)):
        data = bytes(mavlink2.MAVLink_param_set_message(SYSTEM, 197, name, value, 9).pack(ground))
        flight.session.receive(NAME, data, flight.now_ns, flight.now_ns)
    flight.fly(9.0)
    told = [m.text for m in flight.autopilot.of("STATUSTEXT")]
    for words in ("another origin", "not aligned", "next start"):
        assert any(words in text for text in told)
    # One of full length would be a longer one that was cut.
    assert max(len(text) for text in told) < LONGEST
