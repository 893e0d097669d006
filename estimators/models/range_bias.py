"""Bias of UWB ranges: how much too long an anchor's ranges are, and how to take it off."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import atan2, cos, exp, hypot, sin

import numpy as np

from estimators.messages import FloatArray, RangeFrame

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


@dataclass(frozen=True, slots=True)
class BearingBias:
    """Bias of one tag's ranges by direction, ``cosine cos 2b + sine sin 2b`` at the anchor's bearing b.

    An antenna on a robot answers later into some directions than into others. The bearing is that from the
    tag, counter-clockwise from the body's x axis.

    Attributes:
        cosine: [m].
        sine: [m].

    Source: the second harmonic alone, by our choice: the first looks like a wrong lever arm, and the tag's
        place is measured.
    """

    cosine: float
    sine: float

    def at(
        self, pose: FloatArray, anchor: FloatArray, lever_arm: FloatArray, yaw_variance: float = 0.0
    ) -> tuple[float, FloatArray]:
        """Expected bias and its Jacobian.

        Args:
            pose: (3,) x [m], y [m], yaw [rad] of the body in the map.
            anchor: (2,) or (3,) position in the map [m]; only x and y are used.
            lever_arm: (2,) or (3,) tag antenna in the body frame [m]; only x and y are used.
            yaw_variance: of a normally distributed yaw [rad^2]; without a heading no bias remains.

        Returns:
            Bias of the slant range [m] and its derivative by (x, y, yaw), (3,).
        """
        c, s = cos(pose[2]), sin(pose[2])
        arm_x = c * lever_arm[0] - s * lever_arm[1]
        arm_y = s * lever_arm[0] + c * lever_arm[1]
        dx = anchor[0] - pose[0] - arm_x
        dy = anchor[1] - pose[1] - arm_y
        twice = 2.0 * (atan2(dy, dx) - pose[2])
        # Of normally distributed angles of variance v the means of cos and sin are exp(-v / 2) times theirs.
        known = exp(-2.0 * yaw_variance)
        c2, s2 = known * cos(twice), known * sin(twice)
        slope = 2.0 * (self.sine * c2 - self.cosine * s2)
        distance = max(hypot(dx, dy), 1e-9)
        along_x, along_y = dy / distance**2, -dx / distance**2
        by_pose = np.array([along_x, along_y, along_y * arm_x - along_x * arm_y - 1.0])
        return self.cosine * c2 + self.sine * s2, slope * by_pose


def without_bearing_bias(
    frame: RangeFrame,
    bias: BearingBias,
    pose: FloatArray,
    anchors: Mapping[int, FloatArray],
    lever_arm: FloatArray,
    yaw_variance: float = 0.0,
) -> RangeFrame:
    """Frame without the part of its bias that depends on the bearing.

    Args:
        frame: of the tag.
        bias: of the tag.
        pose: (3,) x [m], y [m], yaw [rad] of the body in the map.
        anchors: id -> position (3,) [m], map frame; ranges of others stay as they are.
        lever_arm: (3,) tag antenna in the body frame [m].
        yaw_variance: as of `BearingBias.at`.
    """
    parts = [
        bias.at(pose, anchors[i], lever_arm, yaw_variance)[0] if i in anchors else 0.0
        for i in frame.anchor_ids.tolist()
    ]
    return replace(frame, ranges=frame.ranges - parts)


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
