"""Which ranges of a frame a filter believes, and how much: shared by all that predict them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from estimators import chi2
from estimators.anchor_trust import AnchorTrust
from estimators.base import Report, Setup, Verdict
from estimators.messages import FloatArray, IntArray, Measurement, PoseEstimate, PoseIncrement, RangeFrame
from estimators.nlos.visibility import OBSTRUCTED, Visibility

NlosMethod = Literal["prediction", "power", "visibility", "robust"]


@dataclass(slots=True, eq=False)  # not frozen: that costs four times as much to make
class Candidates:
    """Ranges of a frame in the plane, to be held against their predictions.

    Attributes:
        frame: with N ranges.
        pose: (3,) x [m], y [m], yaw [rad] that the body is predicted at.
        verdicts: (N,) what is wrong with each, `Verdict.WAITING` when nothing is.
        anchors: (N,) number of each anchor, in the order of the site's; negative where something is wrong.
        rows: (N, 4) anchor x and y [m], map frame, horizontal range and its standard deviation [m], as
            `estimators.kernels` has them; of infinite sigma where something is wrong.
        bias_by_pose: (N, 3) derivative by the pose of what was taken off for the bearing.
        codes: (N,) the gate's verdicts as `estimators.kernels` has them, once it has judged.
    """

    frame: RangeFrame
    pose: FloatArray
    verdicts: list[Verdict]
    anchors: IntArray
    rows: FloatArray
    bias_by_pose: FloatArray
    codes: IntArray


class HorizontalRanges:
    """Height reduction of known anchors' ranges.

    Args:
        sigma: standard deviation of a range [m].
        setup: geometry of the site.
    """

    def __init__(self, sigma: float, setup: Setup) -> None:
        # Numba loads slowly: only who judges ranges waits for it.
        from estimators.kernels import range_gate

        self._kernels = range_gate
        self._sigma = sigma
        self._setup = setup
        self._ids = np.array(list(setup.anchors), dtype=np.int64)
        self._site = np.array([[*p[:2], setup.height_to(p)] for p in setup.anchors.values()]).reshape(-1, 3)

    def of(self, frame: RangeFrame, pose: FloatArray, yaw_variance: float) -> Candidates:
        """What a frame's ranges are in the plane, or what is wrong with them.

        Args:
            frame: with N ranges.
            pose: (3,) predicted x [m], y [m], yaw [rad] of the body in the map.
            yaw_variance: of its yaw [rad^2]; without a heading, infinite, bias by the bearing stays.
        """
        kernels, setup = self._kernels, self._setup
        slants, slopes = frame.ranges, np.zeros((len(frame.ranges), 3))
        bias, arm = setup.bearing_biases.get(frame.tag_id), setup.arm(frame.tag_id)
        if bias is not None:
            slants = slants.copy()
            for i, anchor_id in enumerate(frame.anchor_ids.tolist()):
                if anchor_id in setup.anchors:
                    longer, slopes[i] = bias.at(pose, setup.anchors[anchor_id], arm, yaw_variance)
                    slants[i] -= longer
        anchors, rows = np.empty(len(slants), dtype=np.int64), np.zeros((len(slants), 4))
        kernels.reduce_heights(
            np.ascontiguousarray(frame.anchor_ids),
            np.ascontiguousarray(slants),
            self._ids,
            self._site,
            float(arm[2] - setup.tag_in_body[2]),
            self._sigma,
            anchors,
            rows,
        )
        if bias is not None:
            usable = anchors >= 0
            # What is taken off the slant range changes the horizontal one as the noise does.
            slopes[usable] *= rows[usable, 3:] / self._sigma
        verdicts = [Verdict.WAITING if k >= 0 else kernels.VERDICTS[k] for k in anchors.tolist()]
        return Candidates(frame, pose.copy(), verdicts, anchors, rows, slopes, np.empty_like(anchors))


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
        # Numba loads slowly: only who judges ranges waits for it.
        from estimators.kernels import blocked, range_gate

        self._kernels, self._never = range_gate, blocked.NEVER
        self.horizontal = HorizontalRanges(config.range_sigma, setup)
        """Height reduction: what is to be judged, and for those who take up where a filter leaves off."""
        self._limit = chi2.ppf(config.range_gate, 1)
        methods = config.nlos
        self._visibility = Visibility(config.obstacle_height, setup) if "visibility" in methods else None
        self._settings = (
            self._limit,
            config.nlos_excess,
            config.nlos_memory,
            config.nlos_power,
            OBSTRUCTED if "visibility" in methods else 0.0,
            "prediction" in methods,
            "power" in methods,
            "robust" in methods,
        )
        self._places = list(setup.anchors.values())
        self._trust = AnchorTrust(len(self._places))
        self._known_ns = np.zeros(len(self._places), dtype=np.int64)
        self._state = (self._known_ns, np.zeros(len(self._places)), *self._trust.state)
        self.reset()

    def reset(self) -> None:
        """Know nothing of any anchor and of what stands around."""
        self._trust.reset()
        self._known_ns[:] = self._never
        if self._visibility is not None:
            self._visibility.reset()

    @property
    def limit(self) -> float:
        """Greatest NIS that passes."""
        return self._limit

    def doubt(self, stamp_ns: int) -> float:
        """How far a pose that these ranges correct may be off because they contradict each other [m]."""
        return self._trust.doubt(stamp_ns)

    def see(self, measurement: Measurement, pose_at: Callable[[int], PoseEstimate | None]) -> None:
        """Look at what is no range; `pose_at` is that of the filter, which has taken the measurement."""
        if isinstance(measurement, PoseIncrement):
            self._trust.note_odometry(measurement.stamp_ns)
        if self._visibility is not None:
            self._visibility.see(measurement, pose_at)

    def judge_at(
        self, candidates: Candidates, cov: FloatArray, arm: FloatArray
    ) -> tuple[Report, FloatArray, FloatArray]:
        """Verdicts on ranges of a frame from the pose that the body is predicted at.

        Args:
            candidates: N ranges; their sigmas become those they are to be used with, infinite without.
            cov: (K, K) beginning with x, y, yaw of the pose.
            arm: (3,) tag antenna in the body frame [m].

        Returns:
            The report; measured minus predicted (N,) [m]; derivative of the predicted by the pose (N, 3).
        """
        residuals, by_pose, spread = self._kernels.expected_at(
            candidates.anchors,
            candidates.rows,
            candidates.bias_by_pose,
            candidates.pose,
            np.ascontiguousarray(cov),
            *arm[:2].tolist(),
        )
        return self.judge_together(candidates, residuals.copy(), spread), residuals, by_pose

    def judge_together(self, candidates: Candidates, mean: FloatArray, cov: FloatArray) -> Report:
        """Verdicts on ranges of a frame that are expected together.

        Args:
            candidates: N ranges; their sigmas become those they are to be used with, infinite without.
            mean: (N,) measured minus predicted [m]; is corrected by what is used.
            cov: (N, N) of the predictions [m^2], likewise.
        """
        frame, codes, count = candidates.frame, candidates.codes, len(mean)
        report = np.full((3, count), np.nan)
        begin = 0
        while True:
            begin = self._kernels.judge_together(
                self._state,
                self._settings,
                frame.stamp_ns,
                candidates.anchors,
                np.ascontiguousarray(frame.rx_power),
                np.ascontiguousarray(frame.fp_power),
                candidates.rows,
                mean,
                cov,
                codes,
                report,
                begin,
            )
            if begin == count:
                break
            report[2, begin] = self._look(candidates, begin)
        verdicts = tuple([self._kernels.VERDICTS[code] for code in codes.tolist()])
        return Report(verdicts, report[0], report[1])

    def _look(self, candidates: Candidates, k: int) -> float:
        """What the LiDAR sees on the way to an anchor."""
        assert self._visibility is not None
        return self._visibility.log_ratio(candidates.pose, self._places[candidates.anchors[k]])
