"""Which feature a sighting is of, where several could be meant."""

import numpy as np
import pytest

from estimators.lidar.feature_association import NEW, match_walls
from estimators.lidar.feature_map import FeatureMap, Kind
from estimators.lidar.features import Walls, find_features
from estimators.lidar.sightings import NOW, STATES, WallSightings
from estimators.messages import FloatArray

SIGMA = 0.015


def wall_at(distance: float) -> FloatArray:
    """Points (60, 2) [m] of a wall across the x axis."""
    return np.column_stack([np.full(60, distance), np.linspace(-1.0, 1.0, 60)])


def seen(points: FloatArray) -> tuple[Walls, WallSightings]:
    """By a body at the origin, all at the end of the scan."""
    walls = find_features(points, np.zeros((len(points), 2)), SIGMA).walls
    basis = np.tile([0.0, 0.0, 1.0, 0.0], (len(points), 1))
    return walls, WallSightings.of(walls, points, basis)


def knowing_a_wall(sigma: float) -> FeatureMap:
    """A map with one wall at 2 m, and how far along the x axis the body is being this uncertain since."""
    here = FeatureMap(np.zeros(STATES), 1e-6 * np.eye(STATES))
    walls, sightings = seen(wall_at(2.0))
    values = np.column_stack([walls.angle, np.zeros(1)])
    rows = sightings.rows(here.states, np.zeros(1, dtype=np.int64), values, walls.centre)
    here.add(Kind.WALL, values, walls.centre, np.column_stack([walls.low, walls.high]), rows)
    here.cov[NOW.start, NOW.start] += sigma**2
    return here


@pytest.mark.parametrize(("sigma", "feature"), [(0.05, 0), (0.15, 0), (0.3, NEW), (2.0, NEW)])
def test_what_may_as_well_be_a_neighbour_is_taken_for_new(sigma: float, feature: int) -> None:
    found = match_walls(knowing_a_wall(sigma), *seen(wall_at(2.0 + 0.5 * sigma)))
    assert found.feature.tolist() == [feature]


@pytest.mark.parametrize(("second", "misfit"), [(2.1, None), (2.4, 0)])
def test_two_sightings_of_a_wall_must_agree_with_each_other(second: float, misfit: int | None) -> None:
    here = knowing_a_wall(1.0)
    both = [seen(wall_at(distance))[1] for distance in (2.1, second)]
    index, wall, anchor = np.zeros(1, dtype=np.int64), here.features[:1], here.anchors[:1]
    first, other = (sightings.rows(here.states, index, wall, anchor) for sightings in both)
    # Either alone could be that wall, seen from somewhere else.
    assert here.misfit(first) is None
    assert here.misfit(other) is None
    assert here.misfit(first + other) == misfit
