"""How far an estimator was off in a trial, in figures."""

from dataclasses import dataclass

import numpy as np

from companion.alignment import Alignment
from companion.evaluate import Errors
from companion.legs import LegFigures
from companion.metrics import integrity_violations, relative_errors, trajectory_error
from companion.range_score import RangeScore
from companion.watched import WatchedEstimator

RIGHT_WITHIN = (0.3, np.deg2rad(10.0))
"""Horizontal distance [m] and heading error [rad] within which a pose that was looked for is found."""


@dataclass(frozen=True, slots=True)
class TrialFigures:
    """How one estimator did in one trial.

    Attributes:
        rmse_m: root mean square of the horizontal error [m]; the same along the map's axes below.
        max_m: largest horizontal error [m]; the same along the map's axes below.
        p95_m: 95th percentile of the horizontal error [m].
        yaw_rmse_deg: root mean square heading error [deg]; None without heading.
        nees: mean normalised estimation error squared.
        nees_dof: its expectation.
        availability: share of the instants at which there was a pose.
        update_us: median and 99th percentile of the time of an update that was used [us].
        bound_ratio: `rmse_m` over the posterior Cramer-Rao bound; None when that is not known.
        settled_s: time from the first motion, or from the last kidnapping, until the pose stays within
            `RIGHT_WITHIN` to the end [s]; infinite when it does not, or has no heading; None when the start
            was known.
        ranges: what became of blocked and of clean ranges; None when nobody knows which are which.
        ate_m: `rmse_m` after the alignment that was asked for.
        rpe_m: root mean square of the position error that grows over a metre of the way; None without
            heading, or on a shorter way.
        rpe_deg: the same of the heading.
        nis: mean NIS of the ranges that were accepted; None when there are none.
        nis_count: how many they are.
        first_fix_s: time from the first instant to the first pose that a live run would send; None without.
        integrity: share of the poses that would be sent whose error is beyond 3 sigma; None without any.
        epoch_bound_ratio: `rmse_m` over what a single frame of unblocked ranges allows; below 1 for what has
            a memory or a LiDAR; None when not known.
        errors: at every instant.
        iterations: mean steps of its solver for a frame; None without such a solver.
        legs: the same errors on the legs that the scenario names.
    """

    rmse_m: float
    rmse_x_m: float
    rmse_y_m: float
    max_m: float
    max_x_m: float
    max_y_m: float
    p95_m: float
    yaw_rmse_deg: float | None
    nees: float
    nees_dof: int
    availability: float
    update_us: tuple[float, float]
    bound_ratio: float | None
    settled_s: float | None
    ranges: RangeScore | None
    ate_m: float
    rpe_m: float | None
    rpe_deg: float | None
    nis: float | None
    nis_count: int
    first_fix_s: float | None
    integrity: float | None
    epoch_bound_ratio: float | None
    errors: Errors
    iterations: float | None
    legs: dict[str, LegFigures]


def trial_figures(
    errors: Errors,
    watched: WatchedEstimator,
    begin_ns: int,
    alignment: Alignment,
    *,
    bound: float | None = None,
    epoch_bound: float | None = None,
    sought_ns: int | None = None,
    ranges: RangeScore | None = None,
    legs: dict[str, LegFigures] | None = None,
) -> TrialFigures | None:
    """Figures of one estimator in one trial; None when it gave no pose where truth is known.

    Args:
        errors: of its poses.
        watched: the estimator, after the trial.
        begin_ns: first instant at which a pose was asked for.
        alignment: of the track, for `TrialFigures.ate_m`.
        bound: least position error that any estimator can have, root mean square [m]; None when not known.
        epoch_bound: as `bound`, for estimators of a single frame of ranges [m].
        sought_ns: from when on the pose had to be found; None when it was known.
        ranges: what became of blocked and clean ranges; None when nobody knows which are which.
        legs: figures of the legs that have names.
    """
    accuracy = errors.accuracy()
    if accuracy is None:
        return None
    by_axis = np.abs(errors.error[:, :2])
    rmse_x, rmse_y = np.sqrt((by_axis**2).mean(axis=0)).tolist()
    max_x, max_y = by_axis.max(axis=0).tolist()
    median, p99 = (1e6 * np.percentile(watched.seconds, [50, 99])).tolist()
    drift = relative_errors(errors) if errors.has_yaw else np.empty((0, 3))
    rpe = np.sqrt((drift**2).mean(axis=0)).tolist() if len(drift) else None
    healthy_ns = watched.healthy_ns
    return TrialFigures(
        rmse_m=accuracy.rmse,
        rmse_x_m=rmse_x,
        rmse_y_m=rmse_y,
        max_m=accuracy.max,
        max_x_m=max_x,
        max_y_m=max_y,
        p95_m=accuracy.p95,
        yaw_rmse_deg=accuracy.yaw_rmse_deg,
        nees=accuracy.nees,
        nees_dof=accuracy.nees_dof,
        availability=accuracy.availability,
        update_us=(median, p99),
        bound_ratio=accuracy.rmse / bound if bound is not None else None,
        settled_s=_settled(errors, sought_ns) if sought_ns is not None else None,
        ranges=ranges,
        ate_m=trajectory_error(errors, alignment),
        rpe_m=float(np.hypot(rpe[0], rpe[1])) if rpe else None,
        rpe_deg=float(np.rad2deg(rpe[2])) if rpe else None,
        nis=float(np.mean(watched.nis)) if watched.nis else None,
        nis_count=len(watched.nis),
        first_fix_s=(healthy_ns[0] - begin_ns) * 1e-9 if healthy_ns else None,
        integrity=integrity_violations(errors, healthy_ns),
        epoch_bound_ratio=accuracy.rmse / epoch_bound if epoch_bound else None,
        errors=errors,
        iterations=float(np.mean(watched.iterations)) if watched.iterations else None,
        legs=legs or {},
    )


def _settled(errors: Errors, since_ns: int) -> float:
    if not errors.has_yaw:
        return np.inf
    wrong = (errors.distance > RIGHT_WITHIN[0]) | (np.abs(errors.error[:, 2]) > RIGHT_WITHIN[1])
    right_from = 1 + int(np.flatnonzero(wrong)[-1]) if wrong.any() else 0
    if right_from == len(wrong):
        return np.inf
    return max(0.0, float(errors.stamps_ns[right_from] - since_ns) * 1e-9)
