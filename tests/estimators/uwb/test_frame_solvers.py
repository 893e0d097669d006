"""Solvers of whole frames: height where it can be seen, honest covariance, verdicts on single ranges."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from estimators import estimator_config_class, make_estimator
from estimators.base import Setup, Verdict
from estimators.messages import FloatArray
from estimators.uwb.frame_solver import FrameSolver
from estimators.uwb.gd_pf import GdPf
from tests.strategies import SETUP, range_frame

SECOND_NS = 10**9
HIGH_AND_LOW = replace(
    SETUP,
    anchors={
        1: np.array([0.0, 0.0, 0.2]),
        2: np.array([8.0, 0.2, 2.6]),
        3: np.array([7.8, 6.0, 0.3]),
        4: np.array([0.1, 5.9, 2.7]),
    },
    tag_in_body=np.array([0.0, 0.0, 0.3]),
)
FLAT = replace(HIGH_AND_LOW, anchors={i: np.array([*a[:2], 2.5]) for i, a in HIGH_AND_LOW.anchors.items()})
TAG = np.array([3.0, 2.0, 1.4])
SOLVERS = pytest.mark.parametrize("name", ["linear_ls", "gd", "momentum_gd"])
EVERY = pytest.mark.parametrize("name", ["linear_ls", "gd", "momentum_gd", "gd_pf"])


def solver(name: str, setup: Setup, **settings: float) -> FrameSolver | GdPf:
    made = make_estimator(name, estimator_config_class(name).model_validate(settings), setup)
    assert isinstance(made, FrameSolver | GdPf)
    return made


def slants(setup: Setup, tag: FloatArray) -> list[float]:
    return [float(np.linalg.norm(anchor - tag)) for anchor in setup.anchors.values()]


@SOLVERS
def test_four_anchors_in_no_plane_give_the_height_too(name: str) -> None:
    found = solver(name, HIGH_AND_LOW, dimensions=3)
    report = found.update(range_frame(0, [1, 2, 3, 4], slants(HIGH_AND_LOW, TAG)))
    pose = found.pose_at(0)
    assert pose is not None
    np.testing.assert_allclose(pose.T_map_body[:3, 3], TAG - [0.0, 0.0, 0.3], atol=1e-6)
    assert 0.0 < pose.cov[2, 2] < 0.1
    assert report.verdicts == (Verdict.ACCEPTED,) * 4
    np.testing.assert_allclose(report.residuals, 0.0, atol=1e-6)


@EVERY
def test_anchors_in_a_plane_leave_the_height_unobservable(name: str) -> None:
    site_height = FLAT.height + FLAT.tag_in_body[2]
    found = solver(name, FLAT, dimensions=3)
    for k in range(30):
        found.update(
            range_frame(k * SECOND_NS // 10, [1, 2, 3, 4], slants(FLAT, np.array([3.0, 2.0, site_height])))
        )
    pose = found.pose_at(3 * SECOND_NS)
    assert pose is not None
    np.testing.assert_allclose(pose.xy, TAG[:2], atol=0.03)
    assert pose.cov[2, 2] == np.inf
    assert (pose.cov[2, [0, 1, 3, 4, 5]] == 0.0).all()


@EVERY
def test_in_the_plane_the_height_is_that_of_the_site(name: str) -> None:
    found = solver(name, HIGH_AND_LOW)
    tag = np.array([3.0, 2.0, SETUP.height + 0.3])
    found.update(range_frame(0, [1, 2, 3, 4], slants(HIGH_AND_LOW, tag)))
    pose = found.pose_at(0)
    assert pose is not None
    assert pose.T_map_body[2, 3] == pytest.approx(SETUP.height)
    assert pose.cov[2, 2] == pytest.approx(SETUP.height_sigma**2)


@pytest.mark.parametrize("name", ["gd", "momentum_gd"])
@pytest.mark.parametrize("dimensions", [2, 3])
def test_covariance_is_that_of_the_errors(name: str, dimensions: int) -> None:
    rng = np.random.default_rng(0)
    found = solver(name, HIGH_AND_LOW, dimensions=dimensions, range_sigma=0.1)
    squares = []
    for k in range(300):
        tag = np.array([*rng.uniform([2.0, 1.5], [6.0, 4.5]), 0.6])
        noisy = (np.array(slants(HIGH_AND_LOW, tag)) + rng.normal(0.0, 0.1, 4)).tolist()
        found.update(range_frame(k * SECOND_NS, [1, 2, 3, 4], noisy))
        fix = found.fix
        assert fix is not None
        error = (fix.position - tag)[:dimensions]
        squares.append(error @ np.linalg.solve(fix.cov[:dimensions, :dimensions], error))
    low, high = chi2.ppf(1e-3, 300 * dimensions), chi2.ppf(1 - 1e-3, 300 * dimensions)
    assert low < sum(squares) < high


@SOLVERS
@pytest.mark.parametrize("dimensions", [2, 3])
def test_a_pose_is_as_unsure_as_its_ranges_disagree(name: str, dimensions: int) -> None:
    fifth = np.array([4.0, 6.5, 1.5])
    setup = replace(HIGH_AND_LOW, anchors={**HIGH_AND_LOW.anchors, 5: fifth})
    found = solver(name, setup, dimensions=dimensions)
    tag = np.array([3.0, 2.0, SETUP.height + 0.3])
    agreeing = slants(setup, tag)
    variances = []
    for k, excess in enumerate((0.0, 1.0)):
        found.update(range_frame(k, list(setup.anchors), [agreeing[0] + excess, *agreeing[1:]]))
        pose = found.pose_at(k)
        assert pose is not None
        variances.append(np.diag(pose.cov)[:3])
    growth = variances[1] / variances[0]
    # Of the site's height nothing was measured.
    assert (growth[:dimensions] > 3.0).all()
    assert dimensions == 3 or growth[2] == 1.0


def test_linear_least_squares_suffers_more_from_blocked_ranges() -> None:
    rng = np.random.default_rng(0)
    worse = {}
    for name in ("linear_ls", "momentum_gd"):
        found = solver(name, HIGH_AND_LOW)
        errors = []
        for k in range(200):
            tag = np.array([*rng.uniform([1.0, 1.0], [7.0, 5.0]), 0.6])
            blocked = np.array(slants(HIGH_AND_LOW, tag)) + rng.exponential(0.5) * np.eye(4)[k % 4]
            found.update(range_frame(k * SECOND_NS, [1, 2, 3, 4], blocked.tolist()))
            assert found.fix is not None
            errors.append(np.linalg.norm(found.fix.position[:2] - tag[:2]))
        worse[name] = np.sqrt(np.mean(np.square(errors)))
    assert worse["linear_ls"] > 1.05 * worse["momentum_gd"]


@EVERY
@pytest.mark.parametrize("dimensions", [2, 3])
def test_bad_ranges_get_their_verdicts_and_spoil_nothing(name: str, dimensions: int) -> None:
    tag = np.array([3.0, 2.0, 0.6])
    found = solver(name, HIGH_AND_LOW, dimensions=dimensions)
    report = found.update(
        range_frame(
            0,
            [1, 99, 2, 3, 4, 1],
            [*slants(HIGH_AND_LOW, tag)[:1], 3.0, *slants(HIGH_AND_LOW, tag)[1:], -1.0],
        )
    )
    good = [True, False, True, True, True, False]
    assert [verdict is Verdict.ACCEPTED for verdict in report.verdicts] == good
    assert report.verdicts[1] is Verdict.UNKNOWN_ANCHOR
    assert report.verdicts[5] is Verdict.IMPOSSIBLE
    assert np.isfinite(report.residuals).tolist() == good
    assert found.fix is not None
    np.testing.assert_allclose(found.fix.position, tag, atol=0.05)
    assert report.iterations == found.fix.iterations


@EVERY
@pytest.mark.parametrize("dimensions", [2, 3])
def test_too_few_anchors_give_no_fix(name: str, dimensions: int) -> None:
    found = solver(name, HIGH_AND_LOW, dimensions=dimensions)
    report = found.update(range_frame(0, [1, 2], [3.0, 5.0]))
    assert report.verdicts == (Verdict.TOO_FEW,) * 2
    assert report.iterations is None
    assert found.pose_at(0) is None


@EVERY
def test_a_fix_grows_uncertain_and_then_is_no_pose(name: str) -> None:
    found = solver(name, HIGH_AND_LOW, max_age=0.5)
    found.update(range_frame(0, [1, 2, 3, 4], slants(HIGH_AND_LOW, TAG)))
    now, later = found.pose_at(0), found.pose_at(SECOND_NS // 4)
    assert now is not None
    assert later is not None
    assert later.cov[0, 0] > now.cov[0, 0]
    assert found.pose_at(SECOND_NS // 2 + 1) is None
