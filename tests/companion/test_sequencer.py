"""The sequencer: stamp order out, whatever order in; late data counted."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from companion.sequencer import Sequencer
from estimators.messages import ImuSample, Scan, measurement_stamp_ns

HOLD_NS = 30


def imu(stamp_ns: int) -> ImuSample:
    return ImuSample(stamp_ns, np.zeros(3), np.zeros(3))


@given(st.lists(st.integers(0, 1000), max_size=50))
def test_released_in_stamp_order_and_none_lost(stamps: list[int]) -> None:
    sequencer = Sequencer(HOLD_NS)
    for stamp in stamps:
        sequencer.push(imu(stamp))
    released = [measurement_stamp_ns(m) for m in sequencer.release(2000)]
    assert released == sorted(stamps)


@given(st.lists(st.tuples(st.integers(0, 200), st.integers(0, 60)), max_size=60))
def test_never_out_of_order_over_time_and_every_measurement_accounted_for(
    arrivals: list[tuple[int, int]],
) -> None:
    sequencer = Sequencer(HOLD_NS)
    out: list[int] = []
    now = 0
    for advance, age in arrivals:
        now += advance
        sequencer.push(imu(now - age))
        out += [measurement_stamp_ns(m) for m in sequencer.release(now)]
    out += [measurement_stamp_ns(m) for m in sequencer.release(now + HOLD_NS)]
    assert out == sorted(out)
    assert len(out) + sequencer.late == len(arrivals)


def test_waits_for_the_hold_time() -> None:
    sequencer = Sequencer(HOLD_NS)
    sequencer.push(imu(100))
    assert sequencer.release(129) == []
    assert len(sequencer.release(130)) == 1


def test_a_scan_counts_from_its_last_beam() -> None:
    sequencer = Sequencer(0)
    scan = Scan(0, np.zeros(2), np.zeros(2), np.array([0.0, 1e-7]), np.zeros(2))
    sequencer.push(scan)
    sequencer.push(imu(50))
    assert [type(m) for m in sequencer.release(100)] == [ImuSample, Scan]


def test_late_measurement_is_dropped_and_counted() -> None:
    sequencer = Sequencer(0)
    sequencer.push(imu(100))
    sequencer.release(100)
    sequencer.push(imu(99))
    assert sequencer.release(1000) == []
    assert sequencer.late == 1
