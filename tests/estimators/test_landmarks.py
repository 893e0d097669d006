"""Known landmarks in every filter that uses them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimators.base import Verdict
from estimators.messages import LandmarkFrame
from tests.estimators.matched_world import HALL, true_ranges
from tests.estimators.particle_runs import errors_and_nees, matched_filter, seen_landmarks
from tests.estimators.test_particle_filter import nees_bounds

EVERY_FILTER = pytest.mark.parametrize(
    "name", ["ekf", "graph", "pf", "pf_ibas", "pf_ibas_graph", "pf_ibas_printed"]
)
anything = st.floats(allow_nan=True, allow_infinity=True)


def test_the_ekfs_nees_with_landmarks_is_within_both_bounds() -> None:
    runs = 30
    nees = [errors_and_nees(matched_filter("ekf"), seed, 2.0, landmarks=True)[:, 1] for seed in range(runs)]
    low, high = nees_bounds(runs)
    by_half_second = np.mean(nees, axis=0)
    assert (low < by_half_second).all(), by_half_second
    assert (by_half_second < high).all(), by_half_second


@EVERY_FILTER
@settings(deadline=None, max_examples=40)
@given(
    seen=st.lists(st.tuples(st.integers(0, 4), anything, anything), max_size=5),
    sigmas=st.tuples(anything, anything),
)
def test_looks_with_anything_in_them_leave_a_sound_pose(
    name: str, seen: list[tuple[int, float, float]], sigmas: tuple[float, float]
) -> None:
    estimator = matched_filter(name)
    estimator.update(true_ranges(0, HALL.start.pose, HALL))
    ids = np.array([row[0] for row in seen], dtype=np.int64)
    ranges, bearings = np.array([row[1:] for row in seen]).reshape(-1, 2).T
    frame = LandmarkFrame(0, ids, ranges.copy(), bearings.copy(), *sigmas)
    assert len(estimator.update(frame).verdicts) == 1
    pose = estimator.pose_at(0)
    assert pose is not None
    assert np.isfinite(pose.T_map_body).all()
    assert np.isfinite(pose.cov).all()
    assert (np.linalg.eigvalsh(pose.planar_cov) > 0.0).all()


@EVERY_FILTER
def test_landmarks_that_are_unknown_or_impossible_or_far_off_do_not_count(name: str) -> None:
    nan = float("nan")
    good = seen_landmarks(0, HALL.start.pose, np.random.default_rng(0))
    near, ahead = float(good.ranges[0]), float(good.bearings[0])

    def verdict(ids: list[int], ranges: list[float], bearings: list[float], sigma: float = 0.03) -> Verdict:
        frame = LandmarkFrame(0, np.array(ids), np.array(ranges), np.array(bearings), sigma, 0.012)
        estimator = matched_filter(name, landmark_gate=0.99999)
        estimator.update(true_ranges(0, HALL.start.pose, HALL))
        return estimator.update(frame).verdicts[0]

    assert verdict([], [], []) is Verdict.NOT_USED
    assert verdict([77], [3.0], [0.0]) is Verdict.NOT_USED
    assert verdict([0, 1], [nan, -1.0], [0.0, 0.0]) is Verdict.IMPOSSIBLE
    assert verdict([0, 1], [0.0, 2.0], [0.0, nan]) is Verdict.IMPOSSIBLE
    assert verdict([0], [near], [ahead], sigma=0.0) is Verdict.IMPOSSIBLE
    assert verdict([0], [near + 3.0], [ahead]) is Verdict.GATED
    assert verdict([0], [near], [ahead + 1.5]) is Verdict.GATED
    assert verdict([0, 1], [near, 40.0], [ahead, 0.0]) is Verdict.ACCEPTED


@EVERY_FILTER
def test_bearings_are_the_same_a_turn_further(name: str) -> None:
    good = seen_landmarks(0, HALL.start.pose, np.random.default_rng(0))
    turned = LandmarkFrame(
        0, good.landmark_ids, good.ranges, good.bearings + 2.0 * np.pi, good.range_sigma, good.bearing_sigma
    )
    poses = []
    for frame in (good, turned):
        estimator = matched_filter(name)
        assert estimator.update(frame).verdicts == (Verdict.ACCEPTED,)
        poses.append(estimator.pose_at(0))
    assert poses[0] is not None
    assert poses[1] is not None
    np.testing.assert_allclose(poses[0].T_map_body, poses[1].T_map_body, atol=1e-9)
