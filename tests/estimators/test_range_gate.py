"""Which ranges are believed: height reduction, unknown anchors, the gate and doubt after it."""

import numpy as np
import pytest
from scipy.stats import chi2

from estimators.base import Verdict
from estimators.range_gate import RangeGate
from tests.strategies import SETUP, range_frame

SECOND_NS = 10**9


def gate(**settings: float) -> RangeGate:
    """Gate in the room of `SETUP`."""
    return RangeGate(RangeGate.Config(**settings), SETUP)


def test_ranges_are_reduced_to_the_horizontal_with_their_sigma_grown() -> None:
    height = SETUP.height_to(SETUP.anchors[2])
    (item,) = gate(range_sigma=0.1).horizontal(range_frame(0, [2], [float(np.hypot(3.0, height))]))
    assert not isinstance(item, Verdict)
    anchor, horizontal, sigma = item
    np.testing.assert_array_equal(anchor, SETUP.anchors[2])
    assert horizontal == pytest.approx(3.0)
    assert sigma == pytest.approx(0.1 * np.hypot(3.0, height) / 3.0)


@pytest.mark.parametrize("slant", [float("nan"), float("inf"), -3.0, 0.0, 1.0])
def test_what_is_no_range_is_impossible(slant: float) -> None:
    # 1 m is shorter than the anchor is high above the tag.
    assert list(gate().horizontal(range_frame(0, [1], [slant]))) == [Verdict.IMPOSSIBLE]


def test_an_anchor_that_the_site_does_not_have_is_unknown_whatever_its_range() -> None:
    frame = range_frame(0, [99, 99], [float("nan"), 3.0])
    assert list(gate().horizontal(frame)) == [Verdict.UNKNOWN_ANCHOR] * 2


def test_the_gate_passes_the_share_of_good_ranges_that_it_says() -> None:
    limit = gate(range_gate=0.95).limit
    assert limit == pytest.approx(float(chi2.ppf(0.95, 1)))
    ranges = gate(range_gate=0.95)
    assert ranges.judge(1, 0, limit) is Verdict.ACCEPTED
    assert ranges.judge(1, 0, np.nextafter(limit, np.inf)) is Verdict.GATED


def test_an_anchor_is_doubted_for_as_long_as_said_after_its_range_was_gated() -> None:
    ranges = gate(suspect_for=0.5)
    assert ranges.judge(1, 0, 1e3) is Verdict.GATED
    assert ranges.doubts(1, SECOND_NS // 2 - 1)
    assert ranges.judge(1, SECOND_NS // 2 - 1, 0.0) is Verdict.SUSPECT
    assert ranges.judge(2, 1, 0.0) is Verdict.ACCEPTED
    assert not ranges.doubts(1, SECOND_NS // 2)
    assert ranges.judge(1, SECOND_NS // 2, 0.0) is Verdict.ACCEPTED
    ranges.judge(1, SECOND_NS, 1e3)
    ranges.reset()
    assert ranges.judge(1, SECOND_NS, 0.0) is Verdict.ACCEPTED
