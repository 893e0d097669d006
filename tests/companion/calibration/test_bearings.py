"""Range biases by bearing against known poses: found as well as claimed, and only where they are."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from companion.calibration.bearings import BearingFit, fit_bearings
from estimators.geometry import transform
from estimators.messages import FloatArray, RangeFrame
from estimators.models.range_bias import BearingBias
from tests.strategies import range_frame

ANCHORS = {1: np.array([0.0, 0.0, 2.0]), 2: np.array([6.0, 0.0, 2.0]), 3: np.array([0.0, 5.0, 2.0])}
OF_ANCHOR = np.array([0.10, 0.25, -0.05])
ARMS = {4: np.array([0.2, 0.1]), 7: np.array([-0.2, 0.0])}
GROWTH = 0.01
NOTHING = BearingBias(0.0, 0.0)
TRUE = {4: BearingBias(0.03, -0.02), 7: BearingBias(-0.01, 0.04)}


def way() -> FloatArray:
    """Poses (300, 3) of half a minute."""
    t = np.arange(300) * 0.1
    x, y = 2.5 + np.sin(0.5 * t), 2.0 + np.cos(0.3 * t)
    return np.column_stack([x, y, 0.9 * np.sin(0.4 * t) + 0.3 * t])


def found(patterns: Mapping[int, BearingBias], poses: FloatArray, seed: int) -> dict[int, BearingFit]:
    """What a drive tells of two tags, their ranges blocked now and then."""
    rng = np.random.default_rng(seed)
    frames: list[RangeFrame] = []
    tags, of_frames = [], []
    for k, pose in enumerate(poses):
        for tag_id, arm in ARMS.items():
            tag = np.array([*transform(pose, arm[None])[0], 0.4])
            slants = np.array([np.linalg.norm(anchor - tag) for anchor in ANCHORS.values()])
            by_bearing = [patterns[tag_id].at(pose, anchor, arm)[0] for anchor in ANCHORS.values()]
            excess = 1.0 * (rng.random(3) < 0.03)
            noisy = slants * (1.0 + GROWTH) + OF_ANCHOR + by_bearing + 0.05 * rng.standard_normal(3) + excess
            frames.append(replace(range_frame(k * 10**8, list(ANCHORS), noisy.tolist()), tag_id=tag_id))
            tags.append(tag)
            of_frames.append(pose)
    return fit_bearings(frames, np.array(of_frames), np.array(tags), ANCHORS, 0)


def test_the_two_numbers_of_each_tag_are_found_as_well_as_claimed() -> None:
    poses, squares = way(), []
    for seed in range(20):
        fits = found(TRUE, poses, seed)
        assert list(fits) == list(TRUE)
        for tag_id, true in TRUE.items():
            fit = fits[tag_id]
            squares.append(((fit.bias.cosine - true.cosine) / fit.cosine_sigma) ** 2)
            squares.append(((fit.bias.sine - true.sine) / fit.sine_sigma) ** 2)
    # 80 squares, few of them dependent: 99.9 % of honest means are within a half of one.
    assert 0.5 < np.mean(squares) < 1.6


def test_noise_and_growth_with_the_distance_make_no_bias_by_bearing() -> None:
    poses = way()
    # 40 tags of which one in a thousand may.
    assert sum(len(found(dict.fromkeys(TRUE, NOTHING), poses, seed)) for seed in range(20)) <= 1


def test_one_tag_has_it_and_the_other_has_not() -> None:
    assert list(found(TRUE | {7: NOTHING}, way(), 1)) == [4]


def test_a_robot_that_stands_shows_none() -> None:
    assert found(TRUE, np.tile([2.0, 2.0, 1.0], (300, 1)), 1) == {}
    # Ranges without any noise, too: there is nothing at all to divide by.
    tags, poses = np.tile([2.0, 2.0, 0.4], (64, 1)), np.tile([2.0, 2.0, 0.0], (64, 1))
    frames = [range_frame(k * 10**8, [1], [3.5]) for k in range(64)]
    assert fit_bearings(frames, poses, tags, ANCHORS, 0) == {}


def test_where_no_heading_is_known_none_is_found() -> None:
    poses = way()
    frames = [replace(range_frame(k * 10**8, [1], [3.0]), tag_id=4) for k in range(300)]
    tags = np.column_stack([poses[:, :2], np.full(300, 0.4)])
    poses[:, 2] = np.nan
    assert fit_bearings(frames, poses, tags, ANCHORS, 0) == {}


@pytest.mark.parametrize("seconds", [2, 3])
def test_a_drive_of_seconds_is_too_short_for_sigmas(seconds: int) -> None:
    assert found(TRUE, way()[: 10 * seconds], 1) == {}
