"""PF-IBAS: consistent with few particles where the likelihood is sharp; the printed variant is not."""

import numpy as np
import pytest

from estimators.base import Estimator
from estimators.messages import FloatArray
from tests.estimators.matched_world import pose_error
from tests.estimators.particle_runs import errors_and_nees, matched_filter, matched_run
from tests.estimators.test_particle_filter import nees_bounds

RUNS = 30


def figures(estimator: Estimator, landmarks: bool) -> FloatArray:
    """Squared error and NEES, (RUNS, K, 2)."""
    rows = []
    for seed in range(RUNS):
        estimator.reset()
        rows.append(errors_and_nees(estimator, seed, 2.0, landmarks))
    return np.array(rows)


def test_forty_particles_have_a_nees_within_both_bounds_where_the_likelihood_is_sharp() -> None:
    low, high = nees_bounds(RUNS)
    by_half_second = figures(matched_filter("pf_ibas", particles=40), landmarks=True)[..., 1].mean(axis=0)
    assert (low < by_half_second).all(), by_half_second
    assert (by_half_second < high).all(), by_half_second


def test_forty_particles_err_less_than_the_plain_filter_with_as_many() -> None:
    ibas = figures(matched_filter("pf_ibas", particles=40), landmarks=True)
    plain = figures(matched_filter("pf", particles=40), landmarks=True)
    assert ibas[..., 0].mean() < plain[..., 0].mean()
    assert ibas[..., 1].mean() < plain[..., 1].mean()


def test_the_printed_variant_follows_the_walk_but_is_far_too_sure() -> None:
    printed = figures(matched_filter("pf_ibas_printed", particles=40), landmarks=True)
    assert np.sqrt(printed[..., 0].mean()) < 0.2
    assert printed[..., 1].mean() > 10.0 * nees_bounds(RUNS)[1]


def test_without_a_known_heading_it_goes_on_as_a_plain_filter() -> None:
    # A cloud of all headings is no Gaussian: search and draw would claim one.
    truth, stream = matched_run(0, 0.5, landmarks=False)
    wide = matched_filter("pf_ibas", particles=400)
    assert hasattr(wide, "start_at")
    wide.start_at(0, truth[0, :3], np.diag([0.01, 0.01, 4.0]))
    for measurement in stream:
        wide.update(measurement)
    pose = wide.pose_at(stream[-1].stamp_ns)
    assert pose is not None
    assert np.isfinite(pose.cov).all()
    assert pose.cov[5, 5] > 0.1


@pytest.mark.parametrize("iterations", [0, 1, 5])
def test_any_number_of_moves_ends_in_the_same_posterior(iterations: int) -> None:
    truth, stream = matched_run(5, 1.0, landmarks=True)
    ibas = matched_filter("pf_ibas", iterations=iterations)
    for measurement in stream:
        ibas.update(measurement)
    pose = ibas.pose_at(stream[-1].stamp_ns)
    assert pose is not None
    error = pose_error(np.array([*pose.xy, pose.yaw]), truth[-1])
    assert float(error @ np.linalg.solve(pose.planar_cov, error)) < 16.3
