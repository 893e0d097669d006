"""Measurements without bytes: their noise is what the scenario states and what they claim themselves."""

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from companion.errors import UserError
from companion.sim.measurements import MeasuredWalk, measure, setup_of
from companion.sim.scenario import Scenario, load_scenario
from companion.sim.simulate import START_NS
from estimators.geometry import between, rotation, wrap_angle
from estimators.messages import FloatArray, LandmarkFrame, PoseIncrement, RangeFrame
from tests.conftest import write_scenario

INCREMENTS = "[increments]\nrate = 20\nsigma_x = 0.03\nsigma_y = 0.01\nsigma_yaw_deg = 0.5\n"
LANDMARKS = (
    "[landmarks]\npositions = [[4.0, 5.0], [9.0, 2.0]]\nrate = 10\nrange_sigma = 0.05\n"
    "bearing_sigma_deg = 1.0\nmax_range = 6.0\n"
)
SHELF = "[[world.random_boxes]]\ncount = 2\nx = [4.5, 5.5]\ny = [4.0, 5.0]\n"


def load(folder: Path, more: str, seed: int = 1) -> Scenario:
    return load_scenario(write_scenario(folder, more=more), seed, [])


def walked(folder: Path, more: str, seed: int = 1) -> MeasuredWalk:
    return measure(load(folder, more, seed))


def increment_errors(walk: MeasuredWalk) -> tuple[FloatArray, FloatArray]:
    """Errors (K - 1, 3) along the map's axes, and whitened by the claimed covariances."""
    along_map, whitened = [], []
    for k, measured in enumerate(walk.increments[1:]):
        error = measured.increment - between(walk.poses[k], walk.poses[k + 1])
        error[2] = wrap_angle(error[2])
        along_map.append([*(rotation(walk.poses[k, 2]) @ error[:2]), error[2]])
        whitened.append(np.linalg.solve(np.linalg.cholesky(measured.cov), error))
    return np.array(along_map), np.array(whitened)


def test_increments_err_along_the_axes_of_the_map_as_stated(tmp_path: Path) -> None:
    errors = np.vstack([increment_errors(walked(tmp_path, INCREMENTS, seed))[0] for seed in range(10)])
    # Some 2,000 draws know a standard deviation to 1.6 %.
    assert errors.std(axis=0) == pytest.approx([0.03, 0.01, np.deg2rad(0.5)], rel=0.08)
    assert np.abs(errors.mean(axis=0) / errors.std(axis=0)).max() < 5.0 / np.sqrt(len(errors))


def test_increments_claim_what_was_drawn(tmp_path: Path) -> None:
    whitened = np.vstack([increment_errors(walked(tmp_path, INCREMENTS, seed))[1] for seed in range(10)])
    low, high = chi2.ppf(1e-4, whitened.size), chi2.ppf(1 - 1e-4, whitened.size)
    assert low < (whitened**2).sum() < high
    np.testing.assert_allclose(np.corrcoef(whitened.T), np.eye(3), atol=5.0 / np.sqrt(len(whitened)))


def test_scale_and_drift_are_one_draw_a_trial_and_part_of_the_claim(tmp_path: Path) -> None:
    still = "[increments]\nrate = 20\nsigma_x = 1e-9\nsigma_y = 1e-9\nsigma_yaw_deg = 1e-9\n"
    scales, drifts = [], []
    for seed in range(60):
        walk = walked(tmp_path, still + "scale_sigma = 0.02\nyaw_drift_deg = 0.3\n", seed)
        steps = np.array([between(a, b) for a, b in zip(walk.poses[:-1], walk.poses[1:], strict=True)])
        measured = np.array([increment.increment for increment in walk.increments[1:]])
        lengths = np.hypot(steps[:, 0], steps[:, 1])
        moved = lengths > 0.01
        scale = measured[moved, 0] / steps[moved, 0] - 1.0
        drift = (measured[moved, 2] - steps[moved, 2]) / lengths[moved]
        np.testing.assert_allclose(scale, scale[0], atol=1e-6)
        np.testing.assert_allclose(drift, drift[0], atol=1e-6)
        scales.append(scale[0])
        drifts.append(drift[0])
    assert np.std(scales) == pytest.approx(0.02, rel=0.4)
    assert np.std(drifts) == pytest.approx(np.deg2rad(0.3), rel=0.4)
    claimed = np.array([np.diag(increment.cov) for increment in walk.increments[1:]])[moved]
    np.testing.assert_allclose(claimed[:, 0], (0.02 * steps[moved, 0]) ** 2, rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(claimed[:, 2], (np.deg2rad(0.3) * lengths[moved]) ** 2, rtol=1e-6)


def test_increments_follow_each_other_from_instant_to_instant(tmp_path: Path) -> None:
    walk = walked(tmp_path, INCREMENTS)
    assert walk.stamps_ns[0] == START_NS
    assert set(np.diff(walk.stamps_ns).tolist()) == {50_000_000}
    stamps = walk.stamps_ns.tolist()
    assert [increment.stamp_ns for increment in walk.increments] == stamps
    assert [increment.from_stamp_ns for increment in walk.increments] == [stamps[0], *stamps[:-1]]
    assert all(increment.is_keyframe for increment in walk.increments)


def range_errors(scenario: Scenario, walk: MeasuredWalk) -> tuple[FloatArray, list[bool]]:
    """Errors of all ranges, and which of them came straight; poses come from the trajectory itself."""
    setup = setup_of(scenario)
    errors: list[float] = []
    straight: list[bool] = []
    for frame, unblocked in zip(walk.range_frames, walk.unblocked, strict=True):
        pose = scenario.trajectory.at(np.array([(frame.stamp_ns - START_NS) * 1e-9])).pose[0]
        xy = pose[:2] + rotation(pose[2]) @ setup.tag_in_body[:2]
        tag = np.array([*xy, setup.height + setup.tag_in_body[2]])
        for anchor_id, measured in zip(frame.anchor_ids.tolist(), frame.ranges.tolist(), strict=True):
            errors.append(measured - float(np.linalg.norm(setup.anchors[anchor_id] - tag)))
            straight.append(anchor_id in unblocked)
    return np.array(errors), straight


def test_straight_ranges_have_the_stated_noise_and_blocked_ones_an_excess(tmp_path: Path) -> None:
    uwb = "[uwb]\nrate = 50\nsigma = 0.05\nnlos_least = 0.5\nnlos_mean = 0.2\ndropout = 0.0\n"
    scenario = load(tmp_path, INCREMENTS + uwb)
    errors, straight = range_errors(scenario, measure(scenario))
    clear, blocked = errors[straight], errors[np.logical_not(straight)]
    assert len(blocked) > 100
    assert clear.std() == pytest.approx(0.05, rel=0.1)
    assert abs(clear.mean()) < 5.0 * 0.05 / np.sqrt(len(clear))
    assert blocked.min() > 0.5 - 5.0 * 0.05
    assert blocked.mean() == pytest.approx(0.7, abs=5.0 * 0.21 / np.sqrt(len(blocked)))


def test_ranges_are_blocked_exactly_where_the_column_stands_between(tmp_path: Path) -> None:
    """The scenario's only obstacle is a column of 0.6 m by 0.6 m around (4.0, 3.6), higher than all rays."""
    scenario = load(tmp_path, INCREMENTS)
    setup, walk = setup_of(scenario), measure(scenario)
    along = np.linspace(0.0, 1.0, 2000)[:, None]
    judged = 0
    for frame, unblocked in zip(walk.range_frames[::5], walk.unblocked[::5], strict=True):
        pose = scenario.trajectory.at(np.array([(frame.stamp_ns - START_NS) * 1e-9])).pose[0]
        tag = pose[:2] + rotation(pose[2]) @ setup.tag_in_body[:2]
        for anchor_id in frame.anchor_ids.tolist():
            ray = tag + along * (setup.anchors[anchor_id][:2] - tag)
            depth = 0.3 - np.abs(ray - [4.0, 3.6]).max(axis=1).min()
            # Rays that graze the column within a centimetre are left to rounding.
            if abs(depth) > 0.01:
                judged += 1
                assert (anchor_id in unblocked) == (depth < 0.0)
    assert judged > 100


def test_lost_ranges_are_missing_from_frame_and_from_the_unblocked(tmp_path: Path) -> None:
    walk = walked(tmp_path, INCREMENTS + "[uwb]\nrate = 100\ndropout = 0.3\n")
    counts = [len(frame.ranges) for frame in walk.range_frames]
    assert np.mean(counts) == pytest.approx(4 * 0.7, abs=0.15)
    for frame, unblocked in zip(walk.range_frames, walk.unblocked, strict=True):
        assert set(unblocked) <= set(frame.anchor_ids.tolist())
        assert len(frame.ranges) == len(frame.anchor_ids) == len(frame.rx_power) == len(frame.fp_power)


def test_blocked_ranges_lose_most_on_their_first_path(tmp_path: Path) -> None:
    walk = walked(tmp_path, INCREMENTS)
    gaps: dict[bool, list[float]] = {True: [], False: []}
    for frame, unblocked in zip(walk.range_frames, walk.unblocked, strict=True):
        for i, anchor_id in enumerate(frame.anchor_ids.tolist()):
            gaps[anchor_id in unblocked].append(float(frame.rx_power[i] - frame.fp_power[i]))
    assert np.mean(gaps[True]) == pytest.approx(3.0, abs=0.3)
    assert np.mean(gaps[False]) == pytest.approx(11.0, abs=0.5)
    assert min(gaps[True]) >= 0.0, "the first path is a part of what is received"
    assert np.std(gaps[False]) == pytest.approx(2.0, abs=0.5)


def test_a_delay_that_is_not_known_is_a_bias_of_each_anchor_for_the_whole_trial(tmp_path: Path) -> None:
    uwb = "[uwb]\nsigma = 1e-4\nnlos_least = 0\nnlos_mean = 0\ndropout = 0\n"
    biases = []
    for seed in range(12):
        known, unknown = (
            walked(tmp_path, INCREMENTS + uwb + delay, seed) for delay in ("", "delay_sigma_ns = 1.0\n")
        )
        off = np.array(
            [b.ranges - a.ranges for a, b in zip(known.range_frames, unknown.range_frames, strict=True)]
        )
        assert off.std(axis=0).max() < 1e-3
        biases.append(off.mean(axis=0))
    # Draws of half of what light travels in a nanosecond.
    assert np.std(biases) == pytest.approx(0.1499, rel=0.35)


def test_landmarks_are_seen_with_the_stated_noise_as_far_as_stated(tmp_path: Path) -> None:
    errors, hidden = [], 0
    for seed in range(10):
        scenario = load(tmp_path, INCREMENTS + LANDMARKS, seed)
        setup, walk = setup_of(scenario), measure(scenario)
        assert sorted(setup.landmarks) == [0, 1]
        for look in walk.landmark_frames:
            assert look.range_sigma == 0.05
            assert look.bearing_sigma == pytest.approx(np.deg2rad(1.0))
            pose = scenario.trajectory.at(np.array([(look.stamp_ns - START_NS) * 1e-9])).pose[0]
            offsets = {i: complex(*(p - pose[:2])) for i, p in setup.landmarks.items()}
            assert look.landmark_ids.tolist() == [i for i, offset in offsets.items() if abs(offset) <= 6.0]
            hidden += 2 - len(look.landmark_ids)
            for i, range_, bearing in zip(look.landmark_ids, look.ranges, look.bearings, strict=True):
                direction = float(np.angle(offsets[int(i)]) - pose[2])
                errors.append([range_ - abs(offsets[int(i)]), wrap_angle(bearing - direction)])
    assert hidden > 0
    assert np.std(errors, axis=0) == pytest.approx([0.05, np.deg2rad(1.0)], rel=0.1)


def test_order_is_by_stamp_with_the_increment_first(tmp_path: Path) -> None:
    walk = walked(tmp_path, INCREMENTS + LANDMARKS + "[uwb]\nrate = 20\n")
    ordered = walk.in_order()
    stamps = [measurement.stamp_ns for measurement in ordered]
    assert stamps == sorted(stamps)
    assert [type(m) for m in ordered if m.stamp_ns == START_NS] == [PoseIncrement, RangeFrame, LandmarkFrame]
    assert len(ordered) == len(walk.increments) + len(walk.range_frames) + len(walk.landmark_frames)


def drawn(walk: MeasuredWalk) -> list[bytes]:
    return [
        *(increment.increment.tobytes() for increment in walk.increments[1:]),
        *(frame.ranges.tobytes() for frame in walk.range_frames),
        *(look.bearings.tobytes() for look in walk.landmark_frames),
    ]


def test_same_seed_same_measurements(tmp_path: Path) -> None:
    first, again, other = (walked(tmp_path, INCREMENTS + LANDMARKS, seed) for seed in (5, 5, 6))
    assert drawn(first) == drawn(again)
    assert not set(drawn(first)) & set(drawn(other))


def test_random_boxes_stand_elsewhere_in_every_trial_but_within_their_region(tmp_path: Path) -> None:
    fixed = len(load(tmp_path, "").world.segments)
    outlines, places = [], []
    for seed in range(20):
        segments = load(tmp_path, SHELF, seed).world.segments[fixed:]
        assert len(segments) == 2 * 4
        corners = segments[:, :2].reshape(2, 4, 2)
        centres = corners.mean(axis=1)
        assert (centres >= [4.5, 4.0]).all()
        assert (centres <= [5.5, 5.0]).all()
        sides = np.linalg.norm(np.diff(corners, axis=1), axis=2)
        assert (sides >= 0.3 - 1e-9).all()
        assert (sides <= 0.6 + 1e-9).all()
        outlines.append(corners.tobytes())
        places += [*centres]
    assert len(set(outlines)) == 20
    assert (np.ptp(places, axis=0) > 0.7).all()
    assert (
        load(tmp_path, SHELF, 3).world.segments.tobytes() == load(tmp_path, SHELF, 3).world.segments.tobytes()
    )


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (LANDMARKS, r"landmarks: no emulated device sends landmarks, they need a table \[increments\]"),
        ("[increments]\nsigma_x = 0\n", "increments.sigma_x: Input should be greater than 0, got 0"),
        ("[increments]\nsigma_z = 1\n", "increments.sigma_z: unknown key"),
        (
            "[[world.random_boxes]]\ncount = 1\nx = [3, 1]\ny = [0, 1]\n",
            "world.random_boxes.0: x: least 3 is above greatest 1",
        ),
        (
            "[[world.random_boxes]]\ncount = 1\nx = [0, 1]\ny = [0, 1]\nside = [0, 1]\n",
            "world.random_boxes.0: side: a length must be above 0, got 0",
        ),
        ("[gait]\nfrequency = 0\n", "gait.frequency: Input should be greater than 0, got 0"),
        (
            "[paper]\nsource = 'x'\n[paper.estimators]\nekf = { rmse = 1 }\n",
            "paper.estimators.ekf.rmse: unknown",
        ),
    ],
)
def test_wrong_tables_are_refused(tmp_path: Path, more: str, said: str) -> None:
    with pytest.raises(UserError, match=said):
        load(tmp_path, more)
