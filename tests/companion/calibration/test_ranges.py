"""Range biases against known positions: found with honest sigmas, in spite of blocked ranges."""

import numpy as np
import pytest
from scipy.stats import chi2

from companion.calibration.ranges import Ranges, fit_anchor, fit_biases, half_sample_mode, trim_limit
from estimators.messages import FloatArray
from estimators.models.range_bias import RangeBias, without_bias
from tests.strategies import range_frame


def drive(
    rng: np.random.Generator, constant: float, per_metre: float, blocked: float = 0.0, count: int = 600
) -> Ranges:
    """A minute of ranges whose errors grow with the distance; some stretches are blocked."""
    times = np.arange(count) / 10.0
    distances: FloatArray = 4.0 + 2.0 * np.sin(times / 7.0)
    errors = constant + per_metre * distances + 0.08 * rng.standard_normal(count)
    hidden = (times % 10.0) < 10.0 * blocked
    return Ranges(times, distances + errors + hidden * (0.3 + rng.exponential(0.3, count)), distances)


def at_zero(bias: RangeBias) -> float:
    return bias.constant - bias.per_metre * bias.distance


def test_bias_and_growth_are_found_as_well_as_claimed() -> None:
    squares = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        found = fit_biases({i: drive(rng, 0.15 + 0.1 * i, 0.02) for i in range(3)})
        fits = list(found.anchors.values())
        squares.append(((fits[0].bias.per_metre - 0.02) / fits[0].per_metre_sigma) ** 2)
        for i, fit in enumerate(fits):
            true = 0.15 + 0.1 * i + 0.02 * fit.bias.distance
            squares.append(((fit.bias.constant - true) / fit.constant_sigma) ** 2)
        assert len({fit.bias.per_metre for fit in fits}) == 1
    # The clustered covariance of sixty blocks is known to some tenths itself.
    low, high = chi2.ppf(1e-4, 160) / 160, 1.15 * chi2.ppf(1 - 1e-4, 160) / 160
    assert low < np.mean(squares) < high


def test_growth_that_noise_could_have_made_is_not_taken() -> None:
    grown = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        found = fit_biases({i: drive(rng, 0.1, 0.0) for i in range(2)})
        grown += any(fit.bias.per_metre != 0.0 for fit in found.anchors.values())
    assert grown <= 3


def test_what_one_anchor_alone_shows_of_growth_is_not_laid_on_it() -> None:
    rng = np.random.default_rng(3)
    found = fit_biases({0: drive(rng, 0.1, 0.03), 1: drive(rng, 0.1, -0.03)})
    assert [fit.bias.per_metre for fit in found.anchors.values()] == [0.0, 0.0]


def test_no_growth_is_looked_for_at_one_distance() -> None:
    rng = np.random.default_rng(0)
    stay = Ranges(np.arange(100) / 10.0, 5.2 + 0.05 * rng.standard_normal(100), np.full(100, 5.0))
    fit = fit_biases({0: stay}).anchors[0]
    assert (fit.bias.per_metre, fit.per_metre_sigma) == (0.0, 0.0)
    assert fit.bias.constant == pytest.approx(0.2, abs=0.03)


def test_blocked_ranges_are_left_out() -> None:
    for seed in range(10):
        ranges = drive(np.random.default_rng(seed), 0.1, 0.0, blocked=0.3)
        fit = fit_anchor(ranges)
        assert fit.bias.constant == pytest.approx(0.1, abs=0.03)
        assert fit.used < 0.85 * len(ranges.measured)


def test_corrected_ranges_have_no_bias_left() -> None:
    fit = fit_biases({0: drive(np.random.default_rng(1), 0.2, 0.03)}).anchors[0]
    assert np.median(fit.residuals(calibrated=False)) > 0.25
    assert abs(np.median(fit.residuals(calibrated=True))) < 0.02


def test_the_spread_about_the_line_is_that_of_the_noise_alone() -> None:
    fit = fit_biases({0: drive(np.random.default_rng(1), 0.2, 0.1)}).anchors[0]
    assert fit.spread == pytest.approx(0.08, abs=0.01)


def test_the_common_bias_is_the_mean_and_more_certain_than_any() -> None:
    rng = np.random.default_rng(2)
    found = fit_biases({i: drive(rng, 0.1 * i, 0.0) for i in range(4)})
    assert found.common == pytest.approx(0.15, abs=0.02)
    assert found.common_sigma < min(fit.constant_sigma for fit in found.anchors.values())
    assert found.common_ns == pytest.approx(found.common / 0.299792458)


def test_the_mode_is_where_values_are_densest() -> None:
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.normal(1.0, 0.05, 500), rng.uniform(1.2, 5.0, 400)])
    assert half_sample_mode(values) == pytest.approx(1.0, abs=0.1)
    assert half_sample_mode(np.array([3.0])) == 3.0


def test_the_trim_limit_is_three_sigma_of_the_short_side() -> None:
    noise = 0.1 * np.random.default_rng(0).standard_normal(4000)
    blocked = np.where(np.arange(4000) % 3 == 0, np.abs(noise) + 1.0, noise)
    assert trim_limit(noise) == pytest.approx(0.3, rel=0.1)
    assert trim_limit(blocked) == pytest.approx(0.3, rel=0.1)


def test_a_bias_taken_off_undoes_the_bias_put_on() -> None:
    bias = RangeBias(0.2, 0.03, 4.0)
    for distance in (0.5, 4.0, 20.0):
        assert bias.corrected(distance + 0.2 + 0.03 * (distance - 4.0)) == pytest.approx(distance)


def test_a_frame_keeps_what_no_bias_is_known_of_and_bad_ranges_stay_bad() -> None:
    frame = range_frame(7, [1, 2, 3, 1], [5.0, 6.0, float("nan"), 0.1])
    corrected = without_bias(frame, {1: RangeBias(0.5, 0.0, 0.0), 3: RangeBias(0.5, 0.0, 0.0)})
    np.testing.assert_array_equal(corrected.ranges, [4.5, 6.0, np.nan, np.nan])
    np.testing.assert_array_equal(frame.ranges, [5.0, 6.0, np.nan, 0.1])
    assert without_bias(frame, {}) is frame
    of_tag = without_bias(frame, {1: RangeBias(0.5, 0.0, 0.0)}, {frame.tag_id: 0.25, frame.tag_id + 1: 9.0})
    np.testing.assert_array_equal(of_tag.ranges, [4.25, 6.0, np.nan, np.nan])
