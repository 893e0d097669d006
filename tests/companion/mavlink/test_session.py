"""The MAVLink session: heartbeat, ids, spacing, and silence while the pose is not good."""

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink2

from companion.config import MavlinkTable
from companion.health import Health, State
from companion.mavlink.session import MavlinkSession
from companion.sim.autopilot import SYSTEM_ID, EmulatedAutopilot
from estimators.messages import PoseEstimate

OK = Health(State.OK, "")
PERIOD_NS = 33_333_333


def pose(stamp_ns: int) -> PoseEstimate:
    return PoseEstimate(stamp_ns, np.eye(4), np.eye(6) * 0.01, 0)


@pytest.fixture
def session() -> MavlinkSession:
    return MavlinkSession(MavlinkTable.model_validate({}), 0.0)


def parse(data: bytes) -> list[mavlink2.MAVLink_message]:
    messages: list[mavlink2.MAVLink_message] = mavlink2.MAVLink(None).parse_buffer(data) or []
    return messages


def test_heartbeat_once_a_second_and_pose_at_every_tick(session: MavlinkSession) -> None:
    sent = b"".join(session.tick(pose(i * PERIOD_NS), OK, i * PERIOD_NS) for i in range(300))
    kinds = [message.get_type() for message in parse(sent)]
    assert kinds.count("VISION_POSITION_ESTIMATE") == 300
    assert kinds.count("HEARTBEAT") == 10


def test_heartbeat_is_that_of_a_companion(session: MavlinkSession) -> None:
    beat = parse(session.tick(None, OK, 0))[0]
    assert (beat.get_srcSystem(), beat.get_srcComponent()) == (1, 197)
    assert (beat.type, beat.autopilot) == (18, 8)
    assert beat.system_status == mavlink2.MAV_STATE_ACTIVE


def test_heartbeat_does_not_burst_after_a_pause(session: MavlinkSession) -> None:
    session.tick(None, OK, 0)
    after = [session.tick(None, OK, 60_000_000_000 + i * PERIOD_NS) for i in range(29)]
    assert [bool(data) for data in after] == [True] + [False] * 28


def test_takes_the_autopilots_system_id(session: MavlinkSession) -> None:
    gcs = mavlink2.MAVLink_heartbeat_message(
        mavlink2.MAV_TYPE_GCS, mavlink2.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3
    )
    session.receive(bytes(gcs.pack(mavlink2.MAVLink(None, srcSystem=255, srcComponent=190))))
    assert session.autopilot is None
    beat = EmulatedAutopilot().poll(1)
    session.receive(b"\x00garbage" + beat[:5])
    session.receive(beat[5:])
    assert session.autopilot == SYSTEM_ID
    assert {message.get_srcSystem() for message in parse(session.tick(pose(0), OK, 0))} == {SYSTEM_ID}


@pytest.mark.parametrize("state", [State.STARTING, State.LOST])
def test_no_pose_while_it_is_not_good(session: MavlinkSession, state: State) -> None:
    messages = parse(session.tick(pose(0), Health(state, "why"), 0))
    assert [message.get_type() for message in messages] == ["HEARTBEAT"]
    assert messages[0].system_status != mavlink2.MAV_STATE_ACTIVE


def test_never_two_poses_within_20_ms(session: MavlinkSession) -> None:
    assert session.tick(pose(0), OK, 0)
    assert session.tick(pose(1), OK, 19_999_999) == b""
    assert len(parse(session.tick(pose(2), OK, 20_000_000))) == 1


def test_sequence_numbers_count_up(session: MavlinkSession) -> None:
    sent = b"".join(session.tick(pose(i * PERIOD_NS), OK, i * PERIOD_NS) for i in range(300))
    numbers = [message.get_seq() for message in parse(sent)]
    assert numbers == [i % 256 for i in range(len(numbers))]
