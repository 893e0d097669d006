"""An estimator that finds its start, and finds itself again when it was carried off or led astray."""

from dataclasses import replace

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from estimators.base import Report, Settable, Setup, Sketch, Sketched, Taken, Verdict, taken_by
from estimators.geometry import compose, inverse
from estimators.messages import FloatArray, Measurement, PoseEstimate, PoseIncrement, RangeFrame, Scan
from estimators.range_gate import HorizontalRanges
from estimators.relocation.map_search import LEAST_RANGES, MOST_CELLS, MapSearch
from estimators.relocation.search import (
    Minimum,
    agreeing,
    find_pose,
    lies_outside,
    residuals_at,
    too_short,
    total_loss,
)
from estimators.relocation.window import PlacedRanges, Window

SHORTER = (1.0, 0.5)
"""Shares of the window that are tried: after the robot was carried off, a long one tells of two places."""
LEAST_SPREAD = 0.1
"""A way along which tags lie no further apart than this [m] holds no heading worth a search."""
MOST_SIGMA_XY = 0.3
"""A found position less certain than this [m] is not taken."""
DOUBTFUL_LOSS = 0.75
"""Mean loss of a range above which a pose is compared with what a search finds; that of good ones is 0.5."""
CLEARLY_LESS, CLEARLY_BELOW = 1.5, 5.0
"""Another pose must have this many times the loss, and so much more, to be ruled out."""
LEAST_AGREEING = 0.5
"""Least share of ranges that agree in every third of the way: it must not begin or end elsewhere."""
MOST_MEAN_SQUARE = 2.0
"""Of normalised residuals; a wrong pose that seems to explain all ranges explains them badly."""
LOST_YAW_SIGMA = 0.35
"""With less certain a heading than this [rad] a filter is set to what is found without further proof."""
MOST_TOO_SHORT = 0.1
"""Share of ranges too short for a filter's pose above which it may be wrong: blocked ones are too long."""
RECENT = 1.0
"""A place in the map must agree with the ranges of the last so many seconds."""
OUTSIDE = 0.999
"""Confidence with which a found pose must differ from the filter's."""


class Recovering:
    """A filter together with a search that needs none.

    Before the start is known there is no pose. A known filter is only disturbed when the last seconds' ranges
    agree, most of them and along the whole way, on one other pose, clearly not on its own, and some are too
    short for its own: blocked anchors only lengthen ranges, so they do not move a filter that is right. That
    last proof is not asked for while a found pose is younger than the window: it came of less of a way.

    With a map of the site a robot that stands still is looked for by its scan, too. Ranges decide between
    places that look alike and must agree with the one that is taken.

    Args:
        wrapped: the filter.
        config: of the search.
        range_sigma: standard deviation of a range, as the filter's [m].
        setup: geometry of the site.
    """

    class Config(BaseModel):
        """Settings of the search for an unknown or lost pose."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        enabled: bool = Field(
            True, description="whether to look for an unknown start, and for a pose that was lost"
        )
        window: float = Field(
            5.0, ge=1, le=60, description="the last so many seconds of motion and ranges are looked at [s]"
        )
        period: float = Field(0.5, ge=0.1, le=60, description="time between two searches [s]")
        bias_sigma: float = Field(
            0.05,
            ge=0,
            le=5,
            description="standard deviation of what all ranges of an anchor err by in common [m]",
        )
        max_sigma_yaw_deg: float = Field(
            5.0, gt=0, le=30, description="a found heading less certain than this is not taken [deg]"
        )
        min_agreeing: float = Field(
            0.65, ge=0.5, le=1, description="least share of ranges that agree with a found pose"
        )

    def __init__(self, wrapped: Settable, config: Config, range_sigma: float, setup: Setup) -> None:
        self._wrapped = wrapped
        self._sketched = wrapped if isinstance(wrapped, Sketched) else None
        self._config = config
        self._period_ns = round(config.period * 1e9)
        self._starts_known = setup.start.known
        self._window = Window(config.window, HorizontalRanges(range_sigma, setup), setup)
        floor = setup.floor_map
        self._map: MapSearch | None = None
        if floor is not None and floor.occupied.size <= MOST_CELLS:
            self._map = MapSearch(floor, range_sigma, setup)
        self.reset()

    def reset(self) -> None:
        """Forget everything but configuration and setup."""
        self._wrapped.reset()
        self._window.clear()
        if self._map is not None:
            self._map.reset()
        self._known = self._starts_known
        self._note = "" if self._known else self._doubt(None)
        self._searched_ns: int | None = None
        self._set_ns: int | None = None

    @property
    def takes(self) -> Taken:
        """What the filter takes, if it says so; the search needs ranges, scans and increments."""
        taken = taken_by(self._wrapped)
        return None if taken is None else taken | {RangeFrame, Scan, PoseIncrement}

    def update(self, measurement: Measurement) -> Report:
        """Take one measurement; while the pose is looked for, the report's note says what is missing."""
        known = self._wrapped.update(measurement) if self._known else None
        if isinstance(measurement, RangeFrame):
            verdicts = self._window.add_ranges(_not_blamed(measurement, known))
        elif isinstance(measurement, PoseIncrement):
            verdicts = [self._window.add_increment(measurement)]
        else:
            verdicts = [Verdict.NOT_USED]
        if self._map is not None:
            _show(self._map, measurement, verdicts)
        report = known or Report(tuple(verdicts))
        if isinstance(measurement, PoseIncrement) and verdicts == [Verdict.WAITING]:
            self._look_round(measurement.stamp_ns)
        return replace(report, note=self._note) if self._note else report

    def pose_at(self, stamp_ns: int) -> PoseEstimate | None:
        """Pose of the filter; None before the start is known."""
        return self._wrapped.pose_at(stamp_ns) if self._known else None

    def sketch(self) -> Sketch | None:
        """What the filter shows; nothing before the start is known."""
        return None if self._sketched is None or not self._known else self._sketched.sketch()

    def _look_round(self, now_ns: int) -> None:
        """Search when it is time for it, and there is reason to."""
        if self._searched_ns is not None and now_ns - self._searched_ns < self._period_ns:
            return
        self._searched_ns = now_ns
        estimate = self._wrapped.pose_at(now_ns) if self._known else None
        if estimate is not None and not estimate.cov[5, 5] < LOST_YAW_SIGMA**2:
            estimate = None
        if self._map is None:
            self._note = self._doubt(estimate)
        elif self._is_placed(self._map, now_ns, estimate):
            self._note = ""
        else:
            note = self._doubt(estimate)
            self._note = note and (self._map.flaw or note)

    def _is_placed(self, in_map: MapSearch, now_ns: int, estimate: PoseEstimate | None) -> bool:
        """Set the filter to where a scan fits the map, if ranges do not speak against it."""
        recent = self._window.ranges_since(RECENT)
        if estimate is not None:
            if recent is None:
                return False
            held = self._at_keyframe(np.array([*estimate.xy, estimate.yaw]))
            residuals = residuals_at(recent, held[None])
            if _fits(residuals) or not self._is_worth_a_search(residuals, estimate.stamp_ns):
                return False
        place = in_map.search(now_ns)
        if place is None:
            return False
        pose = self._at_keyframe(place.pose)
        lever = np.eye(3)
        lever[:2, 2] = place.pose[1] - pose[1], pose[0] - place.pose[0]
        cov = lever @ place.cov @ lever.T
        if not self._is_certain(cov):
            in_map.flaw = "position is not sure enough yet"
            return False
        if recent is not None:
            residuals = residuals_at(recent, pose[None])
            share = agreeing(residuals)
            if share < self._config.min_agreeing or too_short(residuals) > MOST_TOO_SHORT:
                in_map.flaw = f"ranges contradict, {share:.0%} agree"
                return False
            if estimate is not None and not _is_better(pose, cov, recent, held, estimate.planar_cov):
                return False
        self._set(pose, cov)
        return True

    def _is_worth_a_search(self, residuals: FloatArray, now_ns: int) -> bool:
        """Whether a filter's pose may be wrong: blocked ranges alone are no reason for a long search."""
        return self._is_young(now_ns) or too_short(residuals) > MOST_TOO_SHORT

    def _is_certain(self, cov: FloatArray) -> bool:
        """Whether a found pose with a covariance (3, 3) may be taken."""
        limit = np.deg2rad(self._config.max_sigma_yaw_deg)
        return bool(cov[2, 2] <= limit**2 and np.linalg.eigvalsh(cov[:2, :2])[1] <= MOST_SIGMA_XY**2)

    def _doubt(self, estimate: PoseEstimate | None) -> str:
        """Set the filter to another pose if ranges speak for one; say what is missing if it has none.

        Args:
            estimate: what the filter says; None when it does not know its pose.
        """
        note, tried = "", 0
        for share in SHORTER:
            placed = self._window.ranges_since(share * self._config.window)
            if placed is None or len(placed.ranges) in (tried, 0):
                break
            tried = len(placed.ranges)
            if estimate is not None:
                held = self._at_keyframe(np.array([*estimate.xy, estimate.yaw]))
                residuals = residuals_at(placed, held[None])
                if _fits(residuals):
                    break
                if not self._is_worth_a_search(residuals, estimate.stamp_ns):
                    continue
            found, flaw = self._search(placed)
            note = note or flaw
            if found is None:
                continue
            if estimate is None or _is_better(found.pose, found.cov, placed, held, estimate.planar_cov):
                self._set(found.pose, found.cov)
                return ""
        if estimate is not None:
            return ""
        return note or "waiting for increments and ranges"

    def _at_keyframe(self, newest: FloatArray) -> FloatArray:
        """Where a body that is here now (3,) must have been at the newest keyframe, (3,)."""
        return compose(newest, inverse(self._window.newest_pose))

    def _search(self, placed: PlacedRanges) -> tuple[Minimum | None, str]:
        """The pose of the newest keyframe, or None and what speaks against it."""
        spread = float(np.sqrt(placed.tags.var(axis=0).sum()))
        if spread < LEAST_SPREAD:
            return None, "drive a metre"
        found = find_pose(placed, self._config.bias_sigma)
        if found is None:
            return None, "ranges to two anchors are needed"
        if float(np.rad2deg(np.sqrt(found.cov[2, 2]))) > self._config.max_sigma_yaw_deg:
            return None, "drive a metre"
        if (
            found.agreeing < self._config.min_agreeing
            or found.least_agreeing < LEAST_AGREEING
            or found.mean_square > MOST_MEAN_SQUARE
        ):
            return None, f"ranges contradict, {found.agreeing:.0%} agree"
        if not _is_clearly_less(found.loss, found.rival):
            return None, "two places fit, drive a curve"
        if float(np.sqrt(np.linalg.eigvalsh(found.cov[:2, :2])[1])) > MOST_SIGMA_XY:
            return None, "position is not sure enough yet"
        return found, ""

    def _set(self, pose: FloatArray, cov: FloatArray) -> None:
        """Put the filter where it should have been at the newest keyframe, and let it follow from there."""
        assert self._window.keyframe_ns is not None
        self._wrapped.start_at(self._window.keyframe_ns, pose, cov)
        for increment in self._window.since_keyframe:
            self._wrapped.update(increment)
        self._known = True
        self._set_ns = self._window.keyframe_ns

    def _is_young(self, now_ns: int) -> bool:
        """Whether the filter's pose was found less than a window ago."""
        return self._set_ns is not None and (now_ns - self._set_ns) * 1e-9 < self._config.window


def _is_clearly_less(loss: float, other: float) -> bool:
    return other > CLEARLY_LESS * loss + CLEARLY_BELOW


def _fits(residuals: FloatArray) -> bool:
    """Whether a pose explains ranges well that leave residuals (1, N)."""
    return float(total_loss(residuals)[0]) < DOUBTFUL_LOSS * residuals.size


def _is_better(
    found: FloatArray, found_cov: FloatArray, placed: PlacedRanges, held: FloatArray, held_cov: FloatArray
) -> bool:
    """Whether ranges speak clearly for what was found and against a filter's pose; (3,) and (3, 3).

    Two anchors of four that are blocked alike fit a wrong place with a third one better than the right place
    without. But at the right place no range is too short.
    """
    loss, other = total_loss(residuals_at(placed, np.array([found, held]))).tolist()
    return _is_clearly_less(loss, other) and lies_outside(found, held, found_cov + held_cov, OUTSIDE)


def _not_blamed(frame: RangeFrame, report: Report | None) -> RangeFrame:
    """A frame without ranges of anchors that the filter leaves out, while others agree with it."""
    if report is None or Verdict.CONTRADICTS not in report.verdicts:
        return frame
    kept = np.array([verdict is not Verdict.CONTRADICTS for verdict in report.verdicts])
    if report.verdicts.count(Verdict.ACCEPTED) < len(kept) - np.count_nonzero(kept):
        return frame
    columns = (frame.anchor_ids, frame.ranges, frame.rx_power, frame.fp_power)
    return RangeFrame(frame.stamp_ns, frame.tag_id, *(column[kept] for column in columns))


def _show(in_map: MapSearch, measurement: Measurement, verdicts: list[Verdict]) -> None:
    """Hand on what a search in the map needs, if it is good for anything."""
    if isinstance(measurement, Scan):
        in_map.add_scan(measurement)
    elif isinstance(measurement, RangeFrame) and verdicts.count(Verdict.WAITING) >= LEAST_RANGES:
        in_map.add_ranges(measurement)
    elif isinstance(measurement, PoseIncrement) and verdicts == [Verdict.WAITING]:
        in_map.add_increment(measurement)
