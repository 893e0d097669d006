"""Obstacles round the robot and single ranges, as the autopilot reads them."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config import load_config
from companion.errors import UserError
from companion.mavlink.link import NAME
from companion.mavlink.obstacles import UNKNOWN, obstacle_distance
from companion.mavlink.session import MavlinkSession
from estimators.base import Report, Verdict
from estimators.messages import RangeFrame, Scan
from tests.companion.mavlink.flight import START_NS, messages, site
from tests.companion.mavlink.scripted_autopilot import SYSTEM, ScriptedAutopilot
from tests.conftest import SITE

CENTRED = np.zeros(3)
MS = 1_000_000


def scan(ranges: Callable[[float], float], beams: int = 720, stamp_ns: int = START_NS) -> Scan:
    """A scan whose range depends on the beam's angle [deg], counter-clockwise."""
    angles = np.arange(beams) * 2 * np.pi / beams
    distances = np.array([ranges(float(angle)) for angle in np.rad2deg(angles)])
    return Scan(stamp_ns, angles, distances, np.linspace(0.0, 0.1, beams), np.zeros(beams))


def sectors(message: object) -> list[int]:
    return list(message.distances)  # type: ignore[attr-defined]


def test_left_is_counter_clockwise_and_sectors_go_clockwise() -> None:
    # Something 2 m ahead, 1 m to the left.
    found = sectors(
        obstacle_distance(
            scan(lambda deg: 1.0 if abs(deg - 90) < 2 else 2.0 if deg < 2 else 4.0), CENTRED, 10.0
        )
    )
    assert len(found) == 72
    assert (found[0], found[54], found[18]) == (200, 100, 400)


def test_the_lidars_place_and_turn_on_the_robot_count() -> None:
    behind = np.array([-0.5, 0.0, np.pi])
    message = obstacle_distance(scan(lambda deg: 1.0 if deg < 1 else 0.0), behind, 10.0)
    assert sectors(message)[36] == 150
    assert (message.frame, message.increment, message.increment_f, message.angle_offset) == (12, 0, 5.0, 0.0)


def test_empty_beams_are_free_and_no_beams_are_unknown() -> None:
    half = scan(lambda _: 0.0)
    ahead = np.abs(np.cos(half.angles)) > 0.5
    message = obstacle_distance(
        Scan(0, half.angles[ahead], half.ranges[ahead], half.beam_times[ahead], half.quality[ahead]),
        CENTRED,
        8.0,
    )
    assert message.max_distance == 800
    assert (sectors(message)[0], sectors(message)[18]) == (801, UNKNOWN)


@given(data=st.data())
def test_the_nearest_return_of_a_sector_counts_whatever_the_scan(data: st.DataObject) -> None:
    count = data.draw(st.integers(0, 60))
    angles = np.array(data.draw(st.lists(st.floats(-7, 7), min_size=count, max_size=count)))
    ranges = np.array(data.draw(st.lists(st.floats(0, 40), min_size=count, max_size=count)))
    given_scan = Scan(0, angles, ranges, np.zeros(count), np.zeros(count))
    found = np.array(sectors(obstacle_distance(given_scan, CENTRED, 12.0)))
    hits = (ranges >= 0.05) & (ranges <= 12.0)
    if hits.any():
        assert found.min() == pytest.approx(float(ranges[hits].min()) * 100, abs=0.6)
    assert np.all((found <= 1201) | (found == UNKNOWN))


def session(**settings: object) -> MavlinkSession:
    made = MavlinkSession(site(**settings))
    made.receive(NAME, ScriptedAutopilot(START_NS).poll(START_NS), START_NS, START_NS)
    return made


def test_obstacles_go_out_at_10_hz_whatever_the_rate_of_the_scans() -> None:
    made = session(obstacles=True)
    for i in range(60):
        made.observe(scan(lambda _: 2.0, 90, START_NS + i * 50 * MS), Report((Verdict.NOT_USED,)))
    sent = messages(made.take()[NAME])
    assert {m.get_type() for m in sent} == {"OBSTACLE_DISTANCE"}
    assert len(sent) == 30
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in sent} == {(SYSTEM, 196)}
    silent = session()
    silent.observe(scan(lambda _: 2.0), Report((Verdict.NOT_USED,)))
    assert silent.take() == {}


def test_every_field_of_an_accepted_range() -> None:
    made = session(raw_ranges=True, site__origin={"lat": 48.0, "lon": 11.0, "alt": 500.0})
    frame = RangeFrame(START_NS, 1, np.array([0, 2, 9]), np.array([3.25, 4.5, 1.0]), *(np.zeros(3),) * 2)
    made.observe(frame, Report((Verdict.ACCEPTED, Verdict.GATED, Verdict.UNKNOWN_ANCHOR)))
    (message,) = messages(made.take()[NAME])
    assert message.get_type() == "RANGING_BEACON"
    assert (message.beacon_id, message.range, message.range_accuracy) == (0, 3250, 100)
    assert (message.time_usec, message.target_system) == (START_NS // 1000, SYSTEM)
    # Anchor 0 at (0.15, 0.15, 2.2); the map's x axis points 30 deg east of north.
    c, s = np.cos(np.deg2rad(30)), np.sin(np.deg2rad(30))
    north, east = 0.15 * c + 0.15 * s, 0.15 * s - 0.15 * c
    assert (message.lat / 1e7 - 48.0) * 111_319.5 == pytest.approx(north, abs=0.012)
    assert (message.lon / 1e7 - 11.0) * 111_319.5 * np.cos(np.deg2rad(48)) == pytest.approx(east, abs=0.012)
    assert (message.alt, message.alt_type) == (pytest.approx(502.2), 1)


def test_ranges_without_an_origin_are_refused() -> None:
    with pytest.raises(UserError, match="raw_ranges"):
        load_config(SITE, ["mavlink.raw_ranges=true"])
