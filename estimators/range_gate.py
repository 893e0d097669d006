"""Which ranges of a frame a filter believes, and how much: shared by all that predict them."""

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt
from typing import Literal, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from estimators import chi2
from estimators.anchor_trust import AnchorTrust
from estimators.base import Setup, Verdict
from estimators.messages import FloatArray, Measurement, PoseEstimate, PoseIncrement, RangeFrame
from estimators.models.range import reduce_height
from estimators.nlos.power import Power
from estimators.nlos.prediction import PRIOR, Prediction, excess_log_ratio
from estimators.nlos.robust import sigma_factor
from estimators.nlos.visibility import OBSTRUCTED, Visibility

_NO_BIAS = np.zeros(3)

NlosMethod = Literal["prediction", "power", "visibility", "robust"]
Reduced: TypeAlias = tuple[FloatArray, float, float, FloatArray]
"""Anchor (3,), horizontal range to it and the standard deviation of that [m], derivative (3,) by the pose of
what was taken off for the bearing."""


@dataclass(slots=True, eq=False)  # not frozen: that costs four times as much to make, four times a frame
class Candidate:
    """A range that is to be held against its prediction.

    Attributes:
        anchor_id: whose range it is.
        stamp_ns: when it was measured.
        anchor: (3,) position [m], map frame.
        measured: horizontal range [m].
        sigma: its standard deviation [m].
        prior: log-odds of its anchor being blocked, by what was known before this frame.
        bias_by_pose: (3,) derivative of what was taken off for the bearing by (x, y, yaw).
        by_power: log-likelihood ratio of its powers.
        pose: (3,) x [m], y [m], yaw [rad] that the body is predicted at.
    """

    anchor_id: int
    stamp_ns: int
    anchor: FloatArray
    measured: float
    sigma: float
    bias_by_pose: FloatArray
    prior: float
    by_power: float
    pose: FloatArray


class HorizontalRanges:
    """Height reduction of known anchors' ranges.

    Args:
        sigma: standard deviation of a range [m].
        setup: geometry of the site.
    """

    def __init__(self, sigma: float, setup: Setup) -> None:
        self._sigma = sigma
        self._anchors = {i: (anchor, setup.height_to(anchor)) for i, anchor in setup.anchors.items()}
        self._lifts = {i: float(arm[2] - setup.tag_in_body[2]) for i, arm in setup.tags.items()}
        self._arm, self._bearing_biases = setup.arm, setup.bearing_biases
        self._newest: tuple[RangeFrame, list[Verdict | Reduced]] | None = None

    def of(
        self, frame: RangeFrame, pose: FloatArray | None = None, yaw_variance: float = 0.0
    ) -> list[Verdict | Reduced]:
        """For each range of a frame what it is in the plane, or what is wrong with it.

        Args:
            frame: with N ranges.
            pose: (3,) predicted x [m], y [m], yaw [rad] of the body in the map; None: that bias stays.
            yaw_variance: of its yaw [rad^2].
        """
        bias = None if pose is None else self._bearing_biases.get(frame.tag_id)
        if bias is not None and pose is not None:
            arm = self._arm(frame.tag_id)
            return self._reduced(frame, lambda anchor: bias.at(pose, anchor, arm, yaw_variance))
        # A filter asks, and a graph behind it asks again.
        if self._newest is None or self._newest[0] is not frame:
            self._newest = frame, self._reduced(frame, lambda _: (0.0, _NO_BIAS))
        return self._newest[1]

    def _reduced(
        self, frame: RangeFrame, bias_to: Callable[[FloatArray], tuple[float, FloatArray]]
    ) -> list[Verdict | Reduced]:
        lift = self._lifts.get(frame.tag_id, 0.0)
        found: list[Verdict | Reduced] = []
        for anchor_id, slant in zip(frame.anchor_ids.tolist(), frame.ranges.tolist(), strict=True):
            if anchor_id not in self._anchors:
                found.append(Verdict.UNKNOWN_ANCHOR)
                continue
            anchor, height = self._anchors[anchor_id]
            longer, by_pose = bias_to(anchor)
            reduced = reduce_height(slant - longer, self._sigma, height - lift)
            if reduced is None:
                found.append(Verdict.IMPOSSIBLE)
                continue
            # What is taken off the slant range changes the horizontal one as the noise does.
            by_pose = by_pose if by_pose is _NO_BIAS else by_pose * (reduced[1] / self._sigma)
            found.append((anchor, *reduced, by_pose))
        return found


class RangeGate:
    """Height reduction of known anchors' ranges, NIS gate, and rejection of blocked ranges.

    A range is rejected when it is too far from its prediction (NIS gate), or more likely blocked than not by
    the sum of what the chosen methods say, see `estimators.nlos`; and while its anchor contradicts the
    others, see `AnchorTrust`.
    """

    class Config(BaseModel):
        """Settings of every filter on ranges."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        range_sigma: float = Field(0.10, gt=0, le=10, description="standard deviation of a range [m]")
        range_gate: float = Field(
            0.997, gt=0.5, lt=1, description="share of good ranges that pass the NIS gate"
        )
        nlos: tuple[NlosMethod, ...] = Field(
            ("prediction", "power", "visibility"),
            description="what tells blocked ranges, in any order: prediction (too long for the pose, or a "
            "moment ago), power (weak first path), visibility (the LiDAR sees an obstacle), robust (the "
            "likelier blocked, the less it counts, but nothing is rejected as blocked)",
        )
        nlos_excess: float = Field(
            0.5, gt=0, le=10, description="mean of what a blocked range is too long by [m]"
        )
        nlos_memory: float = Field(
            2.0, gt=0, le=60, description="time constant with which it is forgotten that one was blocked [s]"
        )
        nlos_power: float = Field(
            8.0,
            ge=0,
            le=60,
            description="power of everything received above that of the first path that says nothing [dB]; "
            "2 dB more make a blocked range likely, 2 dB less a clear one",
        )
        obstacle_height: float = Field(
            2.0,
            ge=0,
            le=100,
            description="taken for the height above the map's floor of all that the LiDAR sees [m]",
        )

    def __init__(self, config: Config, setup: Setup) -> None:
        self.horizontal = HorizontalRanges(config.range_sigma, setup)
        """Height reduction, for those who take up where a filter leaves off."""
        self._excess = config.nlos_excess
        self._limit = chi2.ppf(config.range_gate, 1)
        methods = config.nlos
        self._looks_at_residual = "prediction" in methods or "robust" in methods
        self._weighs = "robust" in methods
        self._prediction = Prediction(config.nlos_memory) if "prediction" in methods else None
        self._power = Power(config.nlos_power) if "power" in methods else None
        self._visibility = Visibility(config.obstacle_height, setup) if "visibility" in methods else None
        self._trust = AnchorTrust(len(setup.anchors))

    def reset(self) -> None:
        """Know nothing of any anchor and of what stands around."""
        self._trust.reset()
        if self._prediction is not None:
            self._prediction.reset()
        if self._visibility is not None:
            self._visibility.reset()

    @property
    def limit(self) -> float:
        """Greatest NIS that passes."""
        return self._limit

    def see(self, measurement: Measurement, pose_at: Callable[[int], PoseEstimate | None]) -> None:
        """Look at what is no range; `pose_at` is that of the filter, which has taken the measurement."""
        if isinstance(measurement, PoseIncrement):
            self._trust.note_odometry(measurement.stamp_ns)
        if self._visibility is not None:
            self._visibility.see(measurement, pose_at)

    def candidates(
        self, frame: RangeFrame, pose: FloatArray, yaw_variance: float
    ) -> list[Verdict | Candidate]:
        """For each range of a frame what is known before its residual, or what is wrong with it.

        Args:
            frame: with N ranges.
            pose: (3,) predicted x [m], y [m], yaw [rad] of the body in the map.
            yaw_variance: of its yaw [rad^2].
        """
        reduced, pose = self.horizontal.of(frame, pose, yaw_variance), pose.copy()
        signals = zip(
            frame.anchor_ids.tolist(), frame.rx_power.tolist(), frame.fp_power.tolist(), strict=True
        )
        return [
            item if isinstance(item, Verdict) else self._candidate(frame.stamp_ns, pose, signal, item)
            for item, signal in zip(reduced, signals, strict=True)
        ]

    def judge(self, candidate: Candidate, residual: float, nis: float) -> tuple[Verdict, float]:
        """Verdict on a range, and by how much its sigma is to be multiplied when it is used.

        Args:
            candidate: the range.
            residual: measured minus predicted [m], before the range is used.
            nis: normalised innovation squared, likewise.
        """
        verdict, factor = self._judge(candidate, residual, nis)
        if verdict.is_nlos:
            return verdict, factor
        variance = residual**2 / nis if nis > 0.0 else candidate.sigma**2
        self._trust.note(candidate.anchor_id, candidate.stamp_ns, residual, variance, candidate.sigma)
        if not self._trust.believes(candidate.anchor_id):
            return Verdict.CONTRADICTS, 1.0
        return verdict, factor

    def _judge(self, candidate: Candidate, residual: float, nis: float) -> tuple[Verdict, float]:
        """Verdict on the range alone."""
        if nis > self._limit and residual < 0.0:
            # Nothing shortens a range: rather is the pose wrong, which says nothing of what stands between.
            return Verdict.GATED, 1.0
        log_odds = candidate.prior + candidate.by_power
        by_residual = 0.0
        if self._looks_at_residual:
            sigma = abs(residual) / sqrt(nis) if nis > 0.0 else candidate.sigma
            by_residual = excess_log_ratio(residual, sigma, self._excess)
            log_odds += by_residual
        if self._prediction is not None:
            known = candidate.prior + by_residual
            self._prediction.remember(candidate.anchor_id, candidate.stamp_ns, known)
        if nis > self._limit and not self._weighs:
            return Verdict.GATED if self._prediction is None else Verdict.TOO_LONG, 1.0
        by_visibility = self._looked(candidate, log_odds)
        log_odds += by_visibility
        if self._weighs:
            verdict = Verdict.DOWNWEIGHTED if log_odds > 0.0 else Verdict.ACCEPTED
            return verdict, sigma_factor(log_odds)
        if log_odds > 0.0:
            return _reason(by_residual, candidate.by_power, by_visibility), 1.0
        return Verdict.ACCEPTED, 1.0

    def _candidate(
        self,
        stamp_ns: int,
        pose: FloatArray,
        signal: tuple[int, float, float],
        reduced: Reduced,
    ) -> Candidate:
        anchor_id, rx_power, fp_power = signal
        anchor, measured, sigma, bias_by_pose = reduced
        prior = self._prediction.prior(anchor_id, stamp_ns) if self._prediction else PRIOR
        by_power = self._power.log_ratio(rx_power, fp_power) if self._power else 0.0
        return Candidate(anchor_id, stamp_ns, anchor, measured, sigma, bias_by_pose, prior, by_power, pose)

    def _looked(self, candidate: Candidate, log_odds: float) -> float:
        """What the LiDAR sees says of a range, if it can change what is thought of it.

        Args:
            candidate: the range.
            log_odds: of its being blocked, by all else.
        """
        matters = self._weighs or log_odds + OBSTRUCTED > 0.0
        return (
            self._visibility.log_ratio(candidate.pose, candidate.anchor)
            if self._visibility and matters
            else 0.0
        )


def _reason(by_residual: float, by_power: float, by_visibility: float) -> Verdict:
    """What spoke most for a blocked range; its anchor's past when nothing of now did."""
    reasons = {
        Verdict.TOO_LONG: by_residual,
        Verdict.WEAK_FIRST_PATH: by_power,
        Verdict.OBSTRUCTED: by_visibility,
    }
    strongest = max(reasons, key=reasons.__getitem__)
    return strongest if reasons[strongest] > 0.0 else Verdict.SUSPECT
