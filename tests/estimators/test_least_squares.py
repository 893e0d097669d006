"""Least squares on every frame: position, its covariance with age, and what it does not know."""

import numpy as np
import pytest

from estimators.base import Verdict
from estimators.least_squares import LeastSquares
from estimators.messages import RangeFrame
from tests.strategies import SETUP, range_frame

SECOND_NS = 10**9
TAG = np.array([3.0, 2.0, SETUP.height + SETUP.tag_in_body[2]])
ACCEPTED, TOO_FEW, AMBIGUOUS = Verdict.ACCEPTED, Verdict.TOO_FEW, Verdict.AMBIGUOUS


def exact(stamp_ns: int) -> RangeFrame:
    """Ranges from every anchor to the tag."""
    slants = [float(np.linalg.norm(anchor - TAG)) for anchor in SETUP.anchors.values()]
    return range_frame(stamp_ns, list(SETUP.anchors), slants)


def picked(frame: RangeFrame, *rows: int) -> RangeFrame:
    """Some ranges of a frame."""
    return range_frame(
        frame.stamp_ns, frame.anchor_ids[list(rows)].tolist(), frame.ranges[list(rows)].tolist()
    )


def estimator(**settings: float) -> LeastSquares:
    return LeastSquares(LeastSquares.Config.model_validate(settings), SETUP)


def test_exact_ranges_give_the_position_of_the_tag() -> None:
    solver = estimator()
    report = solver.update(exact(0))
    assert report.verdicts == (ACCEPTED,) * 4
    np.testing.assert_allclose(report.residuals, 0.0, atol=1e-6)
    pose = solver.pose_at(0)
    assert pose is not None
    np.testing.assert_allclose(pose.T_map_body[:3, 3], [TAG[0], TAG[1], SETUP.height], atol=1e-6)


def test_it_knows_no_heading() -> None:
    solver = estimator()
    solver.update(exact(0))
    pose = solver.pose_at(0)
    assert pose is not None
    assert pose.cov[5, 5] == np.inf
    assert np.isfinite(pose.cov[:5, :5]).all()
    assert (pose.cov[5, :5] == 0.0).all()


def test_a_bad_range_does_not_spoil_the_others() -> None:
    frame = exact(0)
    solver = estimator()
    bad = range_frame(0, [99, *frame.anchor_ids.tolist()], [3.0, *frame.ranges.tolist()])
    bad.ranges[2] = float("nan")
    report = solver.update(bad)
    assert report.verdicts == (Verdict.UNKNOWN_ANCHOR, ACCEPTED, Verdict.IMPOSSIBLE, ACCEPTED, ACCEPTED)
    assert np.isnan(report.residuals[[0, 2]]).all()
    np.testing.assert_allclose(report.residuals[[1, 3, 4]], 0.0, atol=1e-6)
    pose = solver.pose_at(0)
    assert pose is not None
    np.testing.assert_allclose(pose.xy, TAG[:2], atol=1e-6)


@pytest.mark.parametrize("rows", [(), (1,), (3, 3, 3)])
def test_too_few_different_anchors_keep_the_last_fix(rows: tuple[int, ...]) -> None:
    solver = estimator()
    assert solver.update(picked(exact(0), *rows)).verdicts == (TOO_FEW,) * len(rows)
    assert solver.pose_at(0) is None
    solver.update(exact(1))
    assert solver.update(picked(exact(2), *rows)).verdicts == (TOO_FEW,) * len(rows)
    pose = solver.pose_at(2)
    assert pose is not None
    np.testing.assert_allclose(pose.xy, TAG[:2], atol=1e-6)


@pytest.mark.parametrize("rows", [(0, 1), (0, 1, 1)])
def test_two_anchors_are_ambiguous_until_a_fix_tells_the_side(rows: tuple[int, ...]) -> None:
    solver = estimator()
    assert solver.update(picked(exact(0), *rows)).verdicts == (AMBIGUOUS,) * len(rows)
    assert solver.pose_at(0) is None
    solver.update(exact(1))
    report = solver.update(picked(exact(2), *rows))
    assert report.verdicts == (ACCEPTED,) * len(rows)
    np.testing.assert_allclose(report.residuals, 0.0, atol=1e-6)
    pose = solver.pose_at(2)
    assert pose is not None
    np.testing.assert_allclose(pose.xy, TAG[:2], atol=1e-6)


def test_a_fix_that_is_too_old_tells_no_side() -> None:
    solver = estimator(max_age=0.5)
    solver.update(exact(0))
    assert solver.update(picked(exact(600_000_000), 0, 1)).verdicts == (AMBIGUOUS, AMBIGUOUS)


def test_a_side_is_not_told_near_the_line_of_the_anchors() -> None:
    # Anchors 1 and 2 run along the southern wall: from a spot beside it, both sides are within reach.
    line = SETUP.anchors[1][:2], SETUP.anchors[2][:2]
    tag = np.array([*(0.5 * (line[0] + line[1]) + [0.0, 0.3]), TAG[2]])
    slants = [float(np.linalg.norm(anchor - tag)) for anchor in SETUP.anchors.values()]
    solver = estimator()
    solver.update(range_frame(0, list(SETUP.anchors), slants))
    assert solver.update(range_frame(10**8, [1, 2], slants[:2])).verdicts == (AMBIGUOUS, AMBIGUOUS)
    pose = solver.pose_at(10**8)
    assert pose is not None
    np.testing.assert_allclose(pose.xy, tag[:2], atol=1e-6)


def test_a_frame_older_than_one_without_a_fix_is_late() -> None:
    solver = estimator()
    solver.update(picked(exact(2_000_000_000), 1))
    assert set(solver.update(exact(1_500_000_000)).verdicts) == {Verdict.LATE}


def test_covariance_grows_with_age_either_way_and_then_there_is_no_pose() -> None:
    solver = estimator(max_age=0.5, speed_sigma=0.8)
    solver.update(exact(SECOND_NS))
    now, later, before = (solver.pose_at(SECOND_NS + age) for age in (0, 400_000_000, -400_000_000))
    assert now is not None
    assert later is not None
    assert before is not None
    growth = (0.8 * 0.4) ** 2
    np.testing.assert_allclose(later.cov[:2, :2] - now.cov[:2, :2], growth * np.eye(2), atol=1e-12)
    np.testing.assert_array_equal(later.cov, before.cov)
    assert solver.pose_at(SECOND_NS + 500_000_001) is None
    assert solver.pose_at(SECOND_NS - 500_000_001) is None


def test_position_is_consistent_over_positions_headings_and_noise() -> None:
    # The body is at a lever arm from the tag in a direction that only the covariance knows of.
    rng = np.random.default_rng(0)
    solver = estimator(range_sigma=0.1)
    squares = []
    for k in range(1000):
        body, yaw = rng.uniform([2.0, 1.5], [6.0, 4.5]), rng.uniform(-np.pi, np.pi)
        arm = complex(*SETUP.tag_in_body[:2]) * np.exp(1j * yaw)
        tag = np.array([body[0] + arm.real, body[1] + arm.imag, TAG[2]])
        slants = [float(np.linalg.norm(a - tag) + rng.normal(0.0, 0.1)) for a in SETUP.anchors.values()]
        solver.update(range_frame(k * SECOND_NS, list(SETUP.anchors), slants))
        pose = solver.pose_at(k * SECOND_NS)
        assert pose is not None
        error = pose.xy - body
        squares.append(error @ np.linalg.solve(pose.cov[:2, :2], error))
    # 2 degrees of freedom; the mean of 1000 has a standard error of 2 / sqrt(1000).
    assert np.mean(squares) == pytest.approx(2.0, abs=3 * 2 / np.sqrt(1000))
