"""Samples of a revolution until it is a scan."""

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from drivers.clock import ClockLine
from drivers.rplidar_nodes import Columns
from drivers.rplidar_protocol import AnswerType, Samples
from drivers.rplidar_revolution import PackedLine, Revolution
from estimators.messages import Scan

LINE = ClockLine(zero_ns=0, tick_ns=1_000_000, at_ns=0, delay_ns=7_000_000_000, drift=0.0)


def part(batch: Columns, at: int, count: int, first: int) -> Samples:
    return Samples(AnswerType.DENSE_SCAN, batch, at, count, [], gap=False, first=first, end=0)


def columns(count: int) -> Columns:
    number = np.arange(count)
    return Columns(number * 65536 // count, number * 40, number % 256)


def finished(revolution: Revolution, min_range: float = 0.0) -> Scan:
    scan = revolution.scan(min_range, 40.0)
    assert scan is not None
    return scan


@given(before_ns=st.integers(0, 10**18), samples=st.integers(1, 200), span_ns=st.integers(-(10**9), 10**9))
def test_packed_samples_ascend_evenly_and_end_where_they_should(
    before_ns: int, samples: int, span_ns: int
) -> None:
    line = PackedLine(before_ns, 1000, samples, span_ns)
    times_ns = line.host_times(np.arange(1001, 1001 + samples))
    assert times_ns.tolist() == [line.host_ns(ticks) for ticks in range(1001, 1001 + samples)]
    steps_ns = np.diff(times_ns, prepend=before_ns)
    assert steps_ns.min() >= 1
    assert np.ptp(steps_ns) <= 1
    assert times_ns[-1] == before_ns + max(span_ns, samples)


@given(cuts=st.sets(st.integers(1, 99)), other_from=st.integers(0, 100))
def test_a_scan_does_not_depend_on_the_parts_that_it_came_in(cuts: set[int], other_from: int) -> None:
    one, other = columns(100), columns(100)
    whole, parts = Revolution(True), Revolution(True)
    whole.add(part(one, 0, 100, 50), 0, 100, LINE)
    edges = sorted({0, *cuts, other_from, 100})
    for first, end in pairwise(edges):
        samples = part(one if first < other_from else other, 0, 100, 50)
        parts.add(samples, first, end, LINE)
    expected, scan = finished(whole), finished(parts)
    assert scan.stamp_ns == expected.stamp_ns == 7_000_000_000 + 51_000_000
    for name in ("angles", "ranges", "beam_times", "quality"):
        assert np.array_equal(getattr(scan, name), getattr(expected, name))


def test_units_of_a_scan() -> None:
    revolution = Revolution(False)
    revolution.add(part(columns(64), 0, 64, 0), 0, 64, LINE)
    scan = finished(revolution, min_range=0.3)
    turned = -2 * np.pi * np.arange(64) / 64
    assert np.allclose(np.exp(1j * scan.angles), np.exp(1j * turned))
    assert scan.angles.min() == -np.pi
    assert scan.angles.max() < np.pi
    metres = np.arange(64) * 0.01
    assert np.allclose(scan.ranges, np.where(metres >= 0.3, metres, 0.0))
    assert np.allclose(scan.beam_times, np.arange(64) * 1e-3)
    assert not scan.quality.any()


def test_too_few_samples_a_gap_or_too_long_a_time_make_no_scan() -> None:
    few, gap, slow = Revolution(False), Revolution(False), Revolution(False)
    few.add(part(columns(64), 0, 29, 0), 0, 29, LINE)
    gap.add(part(columns(64), 0, 64, 0), 0, 64, LINE)
    gap.spoil()
    gap.add(part(columns(64), 0, 64, 0), 0, 64, LINE)
    slow.add(part(columns(64), 0, 64, 0), 0, 64, LINE._replace(tick_ns=16_000_000))
    assert [each.scan(0.0, 40.0) for each in (few, gap, slow)] == [None, None, None]
