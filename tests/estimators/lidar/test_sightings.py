"""Sightings of features and the joint map: Jacobians by differences, the update against least squares."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from estimators.geometry import inverse, transform
from estimators.lidar.feature_map import FeatureMap, Kind
from estimators.lidar.features import find_features
from estimators.lidar.sightings import STATES, Rows, SpotSightings, WallSightings
from estimators.messages import FloatArray
from estimators.models.motion import cubic_between
from tests.estimators.models.finite_differences import numerical_jacobian

DT = 0.1
RNG = np.random.default_rng(5)
STATES_NOW = np.array([0.1, -0.2, 0.3, 0.4, 0.1, 0.5, 0.15, -0.18, 0.36, 0.5, 0.2, 0.7])
WALL, ANCHOR = np.array([[2.1, 0.05], [-0.4, -0.02]]), np.array([[1.0, 2.0], [3.0, -0.5]])
SPOT = np.array([[1.5, 0.7], [-0.8, 2.0]])


def walls() -> WallSightings:
    times = np.sort(RNG.uniform(-DT, 0.0, 20))
    lever = RNG.normal(0.0, 0.2, 20)
    lever[:8] -= lever[:8].mean()
    lever[8:] -= lever[8:].mean()
    points = RNG.normal(0.0, 2.0, (20, 2))
    return WallSightings(
        points, cubic_between(1.0 + times / DT, DT), np.array([8, 12]), lever, np.full((2, 2), 1e-5)
    )


def spots() -> SpotSightings:
    basis = cubic_between(np.array([0.3, 0.8]), DT)
    angle = np.array([0.4, -1.9])
    axis = np.column_stack([np.cos(angle), np.sin(angle)])
    return SpotSightings(RNG.normal(0.0, 2.0, (2, 2)), basis, axis, np.full((2, 2), 1e-4), np.zeros(2))


def test_derivatives_of_wall_rows_are_those_of_differences() -> None:
    seen, index = walls(), np.array([0, 1])
    rows = seen.rows(STATES_NOW, index, WALL, ANCHOR)
    by_states = numerical_jacobian(lambda x: seen.rows(x, index, WALL, ANCHOR).residual, STATES_NOW)
    np.testing.assert_allclose(rows.by_states, by_states, atol=1e-7)
    by_wall = numerical_jacobian(
        lambda w: seen.rows(STATES_NOW, index, w.reshape(2, 2), ANCHOR).residual, WALL.ravel()
    )
    expected = np.zeros((4, 4))
    expected[:2, :2], expected[2:, 2:] = rows.by_feature[:2], rows.by_feature[2:]
    np.testing.assert_allclose(expected, by_wall, atol=1e-7)


@pytest.mark.parametrize("directions", [1, 2])
def test_derivatives_of_spot_rows_are_those_of_differences(directions: int) -> None:
    seen, index = spots(), np.array([0, 1])
    rows = seen.rows(STATES_NOW, index, SPOT, directions)
    by_states = numerical_jacobian(lambda x: seen.rows(x, index, SPOT, directions).residual, STATES_NOW)
    np.testing.assert_allclose(rows.by_states, by_states, atol=1e-7)
    by_spot = numerical_jacobian(
        lambda s: seen.rows(STATES_NOW, index, s.reshape(2, 2), directions).residual, SPOT.ravel()
    )
    expected = np.zeros((2 * directions, 4))
    expected[:directions, :2], expected[directions:, 2:] = (
        rows.by_feature[:directions],
        rows.by_feature[directions:],
    )
    np.testing.assert_allclose(expected, by_spot, atol=1e-7)


def small_map() -> FeatureMap:
    """Two walls and a pole, everything correlated with everything."""
    here = FeatureMap(STATES_NOW.copy(), np.eye(STATES) * 1e-4)
    here.mean = np.concatenate([STATES_NOW, WALL.ravel(), SPOT[0]])
    root = RNG.normal(0.0, 0.01, (18, 18))
    here.cov = root @ root.T + 1e-4 * np.eye(18)
    here.kinds = np.array([Kind.WALL, Kind.WALL, Kind.POLE])
    here.anchors = np.vstack([ANCHOR, np.zeros((1, 2))])
    here.extents, here.sightings = np.zeros((3, 2)), np.full(3, 5)
    here.unseen = np.zeros(3, dtype=np.int64)
    return here


def seen_from_pose(mean: FloatArray, anchors: FloatArray) -> FloatArray:
    """Velocity and features as they are from the newest pose, by the definition of each."""
    pose = mean[6:9]
    turned = transform(np.array([0.0, 0.0, -pose[2]]), mean[9:11][None])[0]
    values = [*turned, mean[11]]
    for wall, anchor, moved in zip(mean[12:16].reshape(2, 2), ANCHOR, anchors, strict=True):
        normal = np.array([np.cos(wall[0]), np.sin(wall[0])])
        foot = transform(inverse(pose), (anchor + wall[1] * normal)[None])[0]
        theta = wall[0] - pose[2]
        values += [theta, np.array([np.cos(theta), np.sin(theta)]) @ (foot - moved)]
    return np.array([*values, *transform(inverse(pose), mean[16:18][None])[0]])


def test_a_moved_origin_moves_features_and_covariance_by_their_definition() -> None:
    here = small_map()
    mean, cov = here.mean.copy(), here.cov.copy()
    here.move_origin()
    J = numerical_jacobian(lambda x: seen_from_pose(x, here.anchors[:2]), mean)
    expected = seen_from_pose(mean, here.anchors[:2])
    np.testing.assert_allclose(here.mean[9:], expected, atol=1e-12)
    np.testing.assert_allclose(here.cov[9:, 9:], J @ cov @ J.T, atol=1e-9)
    np.testing.assert_array_equal(here.mean[:9], 0.0)
    np.testing.assert_array_equal(here.cov[:9], 0.0)


def test_the_update_finds_the_least_squares_solution() -> None:
    here = small_map()
    prior, cov = here.mean.copy(), here.cov.copy()
    wall_seen, spot_seen = walls(), spots().chosen(np.array([0]))
    index = np.array([0, 1])

    def rows(mean: FloatArray) -> Rows:
        features = mean[STATES:].reshape(-1, 2)
        of_walls = wall_seen.rows(mean[:STATES], index, features[:2], ANCHOR)
        return of_walls + spot_seen.rows(mean[:STATES], np.array([2]), features[2:])

    # Residuals are measured against what the prior would see, so that the solution is near it.
    zero = rows(prior).residual + RNG.normal(0.0, 0.003, 6)

    def shifted(mean: FloatArray) -> Rows:
        found = rows(mean)
        return Rows(found.residual - zero, *found.columns()[1:])

    root = np.linalg.cholesky(np.linalg.inv(cov)).T

    def cost(mean: FloatArray) -> FloatArray:
        found = shifted(mean)
        return np.concatenate([root @ (mean - prior), found.residual / np.sqrt(found.noise)])

    best = least_squares(cost, prior, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    here.correct(lambda: shifted(here.mean))
    J: FloatArray = np.asarray(best.jac)
    sigma = np.sqrt(np.diag(here.cov))
    np.testing.assert_array_less(np.abs(here.mean - best.x) / sigma, 0.05)
    np.testing.assert_allclose(sigma, np.sqrt(np.diag(np.linalg.inv(J.T @ J))), rtol=0.02)


def test_lines_of_walls_are_those_of_an_orthogonal_fit_and_as_uncertain_as_they_say() -> None:
    angle = np.linspace(2.0, 1.1, 90)
    truth = 2.0 / np.cos(angle - 1.5)
    off = []
    for _ in range(300):
        ranges = truth + RNG.normal(0.0, 0.015, 90)
        points = ranges[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        found = find_features(points, np.zeros((90, 2)), 0.015).walls
        assert len(found.size) == 1
        own = points[found.points]
        _, _, rows = np.linalg.svd(own - own.mean(axis=0))
        normal = np.array([np.cos(found.angle[0]), np.sin(found.angle[0])])
        assert abs(abs(rows[1] @ normal) - 1.0) < 1e-9
        slope = np.angle(np.exp(1j * (found.angle[0] - 1.5 - np.pi)))
        distance = found.centre[0] @ [np.cos(1.5), np.sin(1.5)] - 2.0
        off.append([distance**2 / found.noise[0, 0], slope**2 / found.noise[0, 1]])
    # Means of 300 squares: chi-square bounds at 99.9 %.
    assert (np.mean(off, axis=0) > 0.75).all()
    assert (np.mean(off, axis=0) < 1.3).all()


def test_a_thing_that_stands_alone_is_a_pole_and_a_free_end_of_a_wall_a_corner() -> None:
    angle = np.linspace(-0.6, 0.6, 241)
    ranges = np.where(angle < 0.2, 3.0 / np.cos(angle), 6.0)
    to_pole = np.abs(np.sin(angle + 0.3)) * 2.0 < 0.05
    depth = np.sqrt(np.maximum(0.05**2 - (2.0 * np.sin(angle + 0.3)) ** 2, 0.0))
    ranges[to_pole] = (2.0 * np.cos(angle + 0.3) - depth)[to_pole]
    points = ranges[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    found = find_features(points, np.zeros((241, 2)), 0.01)
    np.testing.assert_allclose(found.poles.position, [[2.0 * np.cos(0.3), -2.0 * np.sin(0.3)]], atol=0.02)
    edges = found.corners.position
    np.testing.assert_allclose(edges, [[3.0, 3.0 * np.tan(0.1975)]], atol=0.01)
