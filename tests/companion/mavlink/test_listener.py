"""Reading along on the link: positions brought back to the map, texts, ages of poses."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink2

from companion.log import Direction, RawChunk
from companion.mavlink.listener import Heard, LinkListener
from companion.mavlink.pose_out import to_ned
from estimators.geometry import lift
from estimators.messages import PoseEstimate

SECOND = 1_000_000_000
PACKER = mavlink2.MAVLink(None, srcSystem=1, srcComponent=1)


def said(listener: LinkListener, stamp_ns: int, *messages: mavlink2.MAVLink_message) -> list[Heard]:
    data = b"".join(bytes(message.pack(PACKER)) for message in messages)
    return listener.listen(RawChunk("mavlink", Direction.IN, stamp_ns, data))


@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(-np.pi, np.pi))
def test_a_position_comes_back_to_the_map_place_that_was_sent(x: float, y: float, heading: float) -> None:
    ned = to_ned(PoseEstimate(0, lift(np.array([x, y, 0.3]), 0.0), np.eye(6), 0), heading).position
    message = mavlink2.MAVLink_local_position_ned_message(0, *ned.tolist(), 0.0, 0.0, 0.0)
    ((heard),) = said(LinkListener(heading), SECOND, message)
    assert heard.xy == pytest.approx(np.array([x, y]), abs=1e-4)


def test_what_is_not_finite_is_no_position() -> None:
    message = mavlink2.MAVLink_local_position_ned_message(0, np.nan, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert said(LinkListener(0.0), SECOND, message) == []


def test_texts_come_whole_and_with_their_urgency() -> None:
    listener = LinkListener(0.0)
    long = "EKF3 IMU0 stopped aiding because of external navigation timeout"
    pieces = [
        mavlink2.MAVLink_statustext_message(4, long[k : k + 50].encode(), 7, i)
        for i, k in enumerate(range(0, len(long), 50))
    ]
    heard = said(listener, SECOND, *pieces, mavlink2.MAVLink_statustext_message(6, b"Armed", 0, 0))
    assert [(h.text, h.is_urgent) for h in heard] == [
        (f"autopilot: {long}", True),
        ("autopilot: Armed", False),
    ]


def test_the_autopilot_is_heard_and_comes_back() -> None:
    listener = LinkListener(0.0)
    beat = mavlink2.MAVLink_heartbeat_message(2, mavlink2.MAV_AUTOPILOT_ARDUPILOTMEGA, 0, 0, 3, 3)
    texts = [[h.text for h in said(listener, s * SECOND, beat)] for s in (1, 2, 9)]
    assert texts == [["autopilot 1 heard"], [], ["autopilot back after 7.0 s"]]


@pytest.mark.parametrize(("age_us", "found"), [(12_000, [0.012]), (-5, []), (10_000_000, [])])
def test_the_age_of_a_sent_pose_needs_one_clock(age_us: int, found: list[float]) -> None:
    message = mavlink2.MAVLink_vision_position_estimate_message(20_000_000 - age_us, 0, 0, 0, 0, 0, 0)
    chunk = RawChunk("mavlink", Direction.OUT, 20 * SECOND, bytes(message.pack(PACKER)))
    assert [heard.latency for heard in LinkListener(0.0).listen(chunk)] == pytest.approx(found)


@given(st.binary(max_size=400))
def test_no_bytes_make_it_raise(data: bytes) -> None:
    for direction in Direction:
        LinkListener(0.0).listen(RawChunk("mavlink", direction, SECOND, data))
