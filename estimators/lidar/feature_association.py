"""Which feature of the map a sighting is of: the only one that it can be, or none.

A sighting belongs to a feature when the Mahalanobis distance between the two, with all that motion, map and
noise leave open, passes a gate, and no other feature passes it. Two features that cannot be told apart are
one wall that was seen in two parts, and are made one.
"""

import numpy as np
from numpy.typing import NDArray

from estimators import chi2
from estimators.geometry import wrap_angles
from estimators.immutable import immutable
from estimators.lidar.feature_map import FeatureMap, Kind
from estimators.lidar.features import Walls
from estimators.lidar.sightings import STATES, Rows, SpotSightings, WallSightings
from estimators.messages import FloatArray, IntArray

GATE = chi2.ppf(0.999, 2)
"""Of the squared Mahalanobis distance of a sighting from its feature."""
NEW_GATE = 4.0 * GATE
"""A sighting that is further from every feature is of a new one; between the gates it is of none."""
LIKE = np.deg2rad(30.0)
"""Directions of walls that differ by more are not compared [rad]."""
REACH = 0.5
"""A wall may be seen so much further along than ever before [m]."""
TOLD_APART = 0.2
"""Where the expected place of a feature is less certain than this [m], it may as well be its neighbour: what
is seen there is of a new one, against which motion goes on."""
NEAR = 1.0
"""Corners and poles further apart are not compared [m]."""

NEW, NONE = -1, -2
"""In place of a feature: the sighting is of a new one, or must not be used."""


@immutable
class Matches:
    """What became of K sightings.

    Attributes:
        feature: (K,) the feature of each, `NEW` or `NONE`.
        known: (K,) whether it can be of any feature.
        doubles: pairs of features between which a sighting could not tell.
    """

    feature: IntArray
    known: NDArray[np.bool_]
    doubles: list[tuple[int, int]]


def match_walls(here: FeatureMap, walls: Walls, sightings: WallSightings) -> Matches:
    """Walls of the map that walls of a scan can be.

    Args:
        here: states and features as predicted.
        walls: found in the scan that was deskewed by these states.
        sightings: the same as sightings.
    """
    known = np.flatnonzero(here.kinds == Kind.WALL)
    wall = here.features[known]
    apart = wrap_angles(walls.angle[:, None] - wall[None, :, 0])
    tangent = np.column_stack([-np.sin(wall[:, 0]), np.cos(wall[:, 0])])
    normal = np.column_stack([np.cos(wall[:, 0]), np.sin(wall[:, 0])])
    off = walls.centre[:, None] - here.anchors[known][None]
    along, across = (off * tangent).sum(axis=2), (off * normal).sum(axis=2) - wall[:, 1]
    extent = here.extents[known]
    beyond = np.maximum(along + walls.low[:, None] - extent[:, 1], extent[:, 0] - along - walls.high[:, None])
    sighting, feature = np.nonzero((np.abs(apart) < LIKE) & (beyond < REACH))
    own = sightings.rows(
        here.states,
        np.zeros(len(walls.size), dtype=np.int64),
        np.column_stack([walls.angle, np.zeros(len(walls.size))]),
        walls.centre,
    )
    residual = np.stack([across[sighting, feature], -apart[sighting, feature]], axis=1)
    by_feature = np.zeros((len(sighting), 2, 2))
    by_feature[:, 0, 0], by_feature[:, 0, 1], by_feature[:, 1, 0] = along[sighting, feature], -1.0, 1.0
    distance = _distances(here, own, residual, by_feature, sighting, known[feature])
    return _unambiguous(len(walls.size), sighting, known[feature], distance)


def match_spots(here: FeatureMap, kind: Kind, sightings: SpotSightings) -> Matches:
    """Corners or poles of the map that those of a scan, deskewed by the predicted states, can be."""
    known = np.flatnonzero(here.kinds == kind)
    count = len(sightings.points)
    own = sightings.rows(here.states, np.zeros(count, dtype=np.int64), np.zeros((count, 2)))
    axes = -own.by_feature.reshape(count, 2, 2)
    position = np.linalg.solve(axes, own.residual.reshape(count, 2, 1))[:, :, 0]
    off = position[:, None] - here.features[known][None]
    sighting, feature = np.nonzero(np.hypot(off[:, :, 0], off[:, :, 1]) < NEAR)
    residual = np.einsum("pij,pj->pi", axes[sighting], off[sighting, feature])
    distance = _distances(here, own, residual, -axes[sighting], sighting, known[feature])
    return _unambiguous(count, sighting, known[feature], distance)


def unite_doubles(here: FeatureMap, doubles: list[tuple[int, int]]) -> bool:
    """Make one of every two walls that cannot be told apart; whether there were any."""
    gone: set[int] = set()
    for pair in doubles:
        if not gone & set(pair) and are_one_wall(here, *pair):
            kept, other = sorted(pair, key=lambda i: -here.sightings[i])
            here.unite(kept, other)
            gone.add(other)
    if gone:
        here.keep(np.setdiff1d(np.arange(len(here.kinds)), sorted(gone)))
    return bool(gone)


def are_one_wall(here: FeatureMap, first: int, second: int) -> bool:
    """Whether two walls of the map cannot be told apart."""
    a, b = here.features[first], here.features[second]
    normal = np.array([np.cos(a[0]), np.sin(a[0])])
    off = here.anchors[second] + b[1] * np.array([np.cos(b[0]), np.sin(b[0])]) - here.anchors[first]
    residual = np.array([normal @ off - a[1], float(wrap_angles(np.array([a[0] - b[0]]))[0])])
    turned = b[0] - a[0]
    H = np.array(
        [
            [off[1] * normal[0] - off[0] * normal[1], -1.0, -b[1] * np.sin(turned), np.cos(turned)],
            [1.0, 0.0, -1.0, 0.0],
        ]
    )
    index = STATES + np.array([2 * first, 2 * first + 1, 2 * second, 2 * second + 1])
    S = H @ here.cov[np.ix_(index, index)] @ H.T
    return bool(residual @ np.linalg.solve(S, residual) < GATE)


def _distances(
    here: FeatureMap,
    own: Rows,
    residual: FloatArray,
    by_feature: FloatArray,
    sighting: IntArray,
    feature: IntArray,
) -> FloatArray:
    """Squared Mahalanobis distances (P,) of pairs of a sighting and a feature; infinite for no telling.

    Args:
        here: states and features as predicted.
        own: two rows a sighting.
        residual: (P, 2).
        by_feature: (P, 2, 2) their derivative.
        sighting: (P,) of each pair.
        feature: (P,) likewise.
    """
    by_states = own.by_states.reshape(-1, 2, STATES)
    HP = by_states @ here.cov[:STATES]
    S = HP[:, :, :STATES] @ by_states.transpose(0, 2, 1)
    S[:, [0, 1], [0, 1]] += own.noise.reshape(-1, 2)
    columns = STATES + 2 * feature[:, None] + [0, 1]
    shared = by_feature @ HP[sighting[:, None], :, columns]
    of_features = by_feature @ here.cov[columns[:, :, None], columns[:, None]] @ by_feature.transpose(0, 2, 1)
    S = S[sighting] + shared + shared.transpose(0, 2, 1) + of_features
    distance = (residual * np.linalg.solve(S, residual[:, :, None])[:, :, 0]).sum(axis=1)
    return np.where(S[:, 0, 0] < TOLD_APART**2, distance, np.inf)


def _unambiguous(count: int, sighting: IntArray, feature: IntArray, distance: FloatArray) -> Matches:
    """The only feature within the gate for each of `count` sightings."""
    found = np.full(count, NEW)
    found[sighting[distance < NEW_GATE]] = NONE
    inside: NDArray[np.bool_] = distance < GATE
    sighting, feature = sighting[inside], feature[inside]
    candidates = np.bincount(sighting, minlength=count)
    alone = candidates[sighting] == 1
    found[sighting[alone]] = feature[alone]
    doubles = {
        (int(a), int(b))
        for i in np.unique(sighting[~alone])
        for a, *others in [np.sort(feature[sighting == i])]
        for b in others
    }
    return Matches(found, candidates > 0, sorted(doubles))
