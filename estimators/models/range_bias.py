"""Bias of UWB ranges: how much too long an anchor's ranges are, and how to take it off."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from estimators.messages import RangeFrame

_ONE_TAG: Mapping[int, float] = {}


@dataclass(frozen=True, slots=True)
class RangeBias:
    """Bias of one anchor's ranges, ``constant + per_metre (d - distance)`` at the true distance d.

    Attributes:
        constant: [m], at `distance`.
        per_metre: growth of the bias with distance.
        distance: [m], where `constant` holds.

    Source: chen2019 Eq. (2), r_D with its error model; linear in the distance by our choice.
    """

    constant: float
    per_metre: float
    distance: float

    def corrected(self, measured: float) -> float:
        """Range [m] without its bias."""
        return (measured - self.constant + self.per_metre * self.distance) / (1.0 + self.per_metre)


def without_bias(
    frame: RangeFrame, biases: Mapping[int, RangeBias], by_tag: Mapping[int, float] = _ONE_TAG
) -> RangeFrame:
    """Frame with corrected ranges; those of anchors that `biases` does not name stay as they are.

    Args:
        frame: as measured.
        biases: anchor id -> bias.
        by_tag: tag id -> by how much its ranges to all anchors are longer than other tags' [m].

    Returns:
        The frame. A range that its bias would make zero or less becomes NaN: no distance, to be refused like
        any other.
    """
    if not biases:
        return frame
    ranges = frame.ranges.copy()
    of_tag = by_tag.get(frame.tag_id, 0.0)
    for i, anchor_id in enumerate(frame.anchor_ids.tolist()):
        bias = biases.get(anchor_id)
        if bias is not None and ranges[i] > 0.0:
            corrected = bias.corrected(float(ranges[i]) - of_tag)
            ranges[i] = corrected if corrected > 0.0 else np.nan
    return replace(frame, ranges=ranges)
