"""Tags of one robot against each other: by how much longer the ranges of each are."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from math import hypot

import numpy as np

from companion.calibration.ranges import fit_anchor, ranges_by_anchor
from companion.errors import UserError
from estimators.messages import FloatArray, RangeFrame


@dataclass(frozen=True, slots=True)
class TagBias:
    """Bias of one tag's ranges, beyond those of the anchors.

    Attributes:
        constant: [m]; those of the tags that the anchors were calibrated with sum to zero.
        sigma: its standard deviation [m].
    """

    constant: float
    sigma: float


def fit_tags(
    frames: Sequence[RangeFrame], tags: FloatArray, anchors: Mapping[int, FloatArray], start_ns: int
) -> dict[int, TagBias]:
    """Part of the range biases that belongs to the tags; empty for a single tag.

    A bias is late answers of both ends, so it is the sum of the anchor's and the tag's.

    Args:
        frames: N, as measured.
        tags: (N, 3) true positions of the frame's tag [m], map frame; NaN where they are not known.
        anchors: id -> (3,) position [m].
        start_ns: beginning of the log.

    Raises:
        UserError: no anchor has enough ranges of all tags.

    Source: chen2019 Eq. (1)-(2), time bias of a pair of modules; parts: two-way layout without interaction.
    """
    ids = np.array([frame.tag_id for frame in frames])
    names = np.unique(ids).tolist()
    if len(names) == 1:
        return {}
    fits = []
    for name in names:
        own = np.flatnonzero(ids == name).tolist()
        by_anchor = ranges_by_anchor([frames[i] for i in own], tags[own], anchors, start_ns)
        fits.append({i: fit_anchor(ranges) for i, ranges in by_anchor.items()})
    shared = [i for i in anchors if all(i in of_tag for of_tag in fits)]
    if not shared:
        raise UserError(f"no anchor has enough ranges of all {len(names)} tags where the position is known")
    constants = np.array([[of_tag[i].bias.constant for i in shared] for of_tag in fits])
    variances = np.array([[of_tag[i].constant_sigma ** 2 for i in shared] for of_tag in fits])
    parts = (constants.mean(axis=1) - constants.mean()).tolist()
    sigmas = (np.sqrt(variances.sum(axis=1)) / len(shared)).tolist()
    return {name: TagBias(part, sigma) for name, part, sigma in zip(names, parts, sigmas, strict=True)}


def carried_over(known: Mapping[int, TagBias], seen: Collection[int]) -> dict[int, TagBias]:
    """What was known of tags that a new calibration of the anchors has not seen, beyond its biases.

    The new biases of the anchors hold the mean of the tags that were seen. What the tags differ by stays.

    Args:
        known: beyond the biases of the anchors before, by tag id; a tag that is not in it has none.
        seen: ids of the tags, at least one, with whose ranges the anchors were calibrated anew.
    """
    of_seen = [known.get(i, TagBias(0.0, 0.0)) for i in seen]
    mean = sum(bias.constant for bias in of_seen) / len(of_seen)
    mean_sigma = hypot(*(bias.sigma for bias in of_seen)) / len(of_seen)
    return {
        i: TagBias(bias.constant - mean, hypot(bias.sigma, mean_sigma))
        for i, bias in known.items()
        if i not in seen
    }


def without_tag_bias(frame: RangeFrame, biases: Mapping[int, TagBias]) -> RangeFrame:
    """Frame with the part of its tag taken off."""
    bias = biases.get(frame.tag_id)
    return frame if bias is None else replace(frame, ranges=frame.ranges - bias.constant)
