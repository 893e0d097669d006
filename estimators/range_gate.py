"""Which ranges of a frame a filter believes, and how much: shared by all that predict them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import sqrt
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from estimators import chi2
from estimators.base import Setup, Verdict
from estimators.messages import FloatArray, Measurement, PoseEstimate, RangeFrame
from estimators.models.range import reduce_height
from estimators.nlos.power import Power
from estimators.nlos.prediction import PRIOR, Prediction, excess_log_ratio
from estimators.nlos.robust import sigma_factor
from estimators.nlos.visibility import Visibility

_NO_BIAS = np.zeros(3)

NlosMethod = Literal["prediction", "power", "visibility", "robust"]


@dataclass(frozen=True, slots=True, eq=False)
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
        by_visibility: the same of what the LiDAR sees.
    """

    anchor_id: int
    stamp_ns: int
    anchor: FloatArray
    measured: float
    sigma: float
    bias_by_pose: FloatArray
    prior: float
    by_power: float
    by_visibility: float

    @property
    def log_odds(self) -> float:
        """Of being blocked, before the residual is looked at."""
        return self.prior + self.by_power + self.by_visibility


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

    def of(
        self, frame: RangeFrame, pose: FloatArray | None = None, yaw_variance: float = 0.0
    ) -> Iterator[Verdict | tuple[FloatArray, float, float, FloatArray]]:
        """Height reduction of a frame, after the bias by bearing is taken off.

        Args:
            frame: with N ranges.
            pose: (3,) predicted x [m], y [m], yaw [rad] of the body in the map; None: that bias stays.
            yaw_variance: of its yaw [rad^2].

        Yields:
            For each range the anchor (3,), horizontal range and its sigma [m], and the derivative (3,) of
            what was taken off by the pose; or what is wrong with it.
        """
        lift = self._lifts.get(frame.tag_id, 0.0)
        bias = None if pose is None else self._bearing_biases.get(frame.tag_id)
        for anchor_id, slant in zip(frame.anchor_ids.tolist(), frame.ranges.tolist(), strict=True):
            if anchor_id not in self._anchors:
                yield Verdict.UNKNOWN_ANCHOR
                continue
            anchor, height = self._anchors[anchor_id]
            by_pose = _NO_BIAS
            if bias is not None and pose is not None:
                longer, by_pose = bias.at(pose, anchor, self._arm(frame.tag_id), yaw_variance)
                slant -= longer
            reduced = reduce_height(slant, self._sigma, height - lift)
            if reduced is None:
                yield Verdict.IMPOSSIBLE
            else:
                # What is taken off the slant range changes the horizontal one as the noise does.
                yield anchor, *reduced, by_pose if bias is None else by_pose * (reduced[1] / self._sigma)


class RangeGate:
    """Height reduction of known anchors' ranges, NIS gate, and rejection of blocked ranges.

    A range is rejected when it is too far from its prediction (NIS gate), or more likely blocked than not by
    the sum of what the chosen methods say, see `estimators.nlos`.
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
        self._horizontal = HorizontalRanges(config.range_sigma, setup)
        self._excess = config.nlos_excess
        self._limit = chi2.ppf(config.range_gate, 1)
        methods = config.nlos
        self._looks_at_residual = "prediction" in methods or "robust" in methods
        self._weighs = "robust" in methods
        self._prediction = Prediction(config.nlos_memory) if "prediction" in methods else None
        self._power = Power(config.nlos_power) if "power" in methods else None
        self._visibility = Visibility(config.obstacle_height, setup) if "visibility" in methods else None

    def reset(self) -> None:
        """Know nothing of any anchor and of what stands around."""
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
        return [
            item if isinstance(item, Verdict) else self._candidate(frame, i, pose, *item)
            for i, item in enumerate(self._horizontal.of(frame, pose, yaw_variance))
        ]

    def judge(self, candidate: Candidate, residual: float, nis: float) -> tuple[Verdict, float]:
        """Verdict on a range, and by how much its sigma is to be multiplied when it is used.

        Args:
            candidate: the range.
            residual: measured minus predicted [m], before the range is used.
            nis: normalised innovation squared, likewise.
        """
        if nis > self._limit and residual < 0.0:
            # Nothing shortens a range: rather is the pose wrong, which says nothing of what stands between.
            return Verdict.GATED, 1.0
        log_odds = candidate.log_odds
        by_residual = 0.0
        if self._looks_at_residual:
            sigma = abs(residual) / sqrt(nis) if nis > 0.0 else candidate.sigma
            by_residual = excess_log_ratio(residual, sigma, self._excess)
            log_odds += by_residual
        if self._prediction is not None:
            known = candidate.prior + by_residual
            self._prediction.remember(candidate.anchor_id, candidate.stamp_ns, known)
        if self._weighs:
            verdict = Verdict.DOWNWEIGHTED if log_odds > 0.0 else Verdict.ACCEPTED
            return verdict, sigma_factor(log_odds)
        if nis > self._limit:
            return Verdict.GATED if self._prediction is None else Verdict.TOO_LONG, 1.0
        if log_odds > 0.0:
            return _reason(by_residual, candidate), 1.0
        return Verdict.ACCEPTED, 1.0

    def _candidate(
        self,
        frame: RangeFrame,
        i: int,
        pose: FloatArray,
        anchor: FloatArray,
        measured: float,
        sigma: float,
        bias_by_pose: FloatArray,
    ) -> Candidate:
        anchor_id, stamp_ns = int(frame.anchor_ids[i]), frame.stamp_ns
        return Candidate(
            anchor_id,
            stamp_ns,
            anchor,
            measured,
            sigma,
            bias_by_pose,
            prior=self._prediction.prior(anchor_id, stamp_ns) if self._prediction else PRIOR,
            by_power=self._power.log_ratio(frame.rx_power[i], frame.fp_power[i]) if self._power else 0.0,
            by_visibility=self._visibility.log_ratio(pose, anchor) if self._visibility else 0.0,
        )


def _reason(by_residual: float, candidate: Candidate) -> Verdict:
    """What spoke most for a blocked range; its anchor's past when nothing of now did."""
    reasons = {
        Verdict.TOO_LONG: by_residual,
        Verdict.WEAK_FIRST_PATH: candidate.by_power,
        Verdict.OBSTRUCTED: candidate.by_visibility,
    }
    strongest = max(reasons, key=reasons.__getitem__)
    return strongest if reasons[strongest] > 0.0 else Verdict.SUSPECT
