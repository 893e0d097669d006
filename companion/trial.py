"""One trial of a scenario: estimators side by side on the same measurements, and how far each was off."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from companion.alignment import Alignment
from companion.config import Config
from companion.estimator_choice import chosen_settings, split_choice
from companion.evaluate import Errors, Reference, compare
from companion.legs import LegFigures, leg_figures
from companion.log import Truth
from companion.metrics import integrity_violations, relative_errors, trajectory_error
from companion.pipeline import (
    Chain,
    Outcome,
    Pipeline,
    make_front_end,
    make_monitor,
    make_sensors,
)
from companion.range_score import RangeScore, TrueExcess
from companion.sim.measurements import MeasuredWalk, measure, setup_of
from companion.sim.scenario import Scenario, load_scenario
from companion.sim.simulate import START_NS, converse
from companion.watched import WatchedEstimator
from estimators import make_estimator
from estimators.base import Estimator, Setup
from estimators.bounds import (
    landmark_information,
    position_information,
    posterior_bound,
    range_information,
    seen_from,
)
from estimators.geometry import transform_each
from estimators.lidar.dead_reckoning import DeadReckoning
from estimators.messages import FloatArray, LandmarkFrame, PoseEstimate, RangeFrame

_BOUND_POSES = 300
"""The bound of single frames is taken at about so many poses of the walk."""
_WORST_CONDITION = 1e4
"""Of information that still tells a position."""
UWB_ALONE, LIDAR_ALONE = "uwb_ls", "lidar"
"""The single sensors: `least_squares` on ranges alone; increments added up from the true start."""

RIGHT_WITHIN = (0.3, np.deg2rad(10.0))
"""Horizontal distance [m] and heading error [rad] within which a pose that was looked for is found."""
MOVED = 0.01
"""A robot that is further than this [m] from where it stood has set off."""


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


def run_trial(
    path: Path, seed: int, sets: list[str], choices: Sequence[str], alignment: Alignment = Alignment.NONE
) -> dict[str, TrialFigures | None]:
    """Run a scenario once.

    Args:
        path: scenario file.
        seed: of everything random.
        sets: `--set` assignments on the site's configuration.
        choices: NAME[:PARAM] of estimators, or single sensors.
        alignment: of tracks, for `TrialFigures.ate_m`.

    Returns:
        Figures by choice; None for an estimator that gave no pose at all.

    Raises:
        UserError: a file or a choice is wrong.
    """
    scenario = load_scenario(path, seed, sets)
    setup = setup_of(scenario)
    start = scenario.trajectory.at(np.zeros(1)).pose[0]
    watched = watched_choices(scenario.config, setup, choices, start)
    poses: dict[str, list[PoseEstimate]] = {choice: [] for choice in choices}
    bound: float | None = None
    excess = TrueExcess(1.0 / scenario.file.uwb.rate)
    if scenario.file.increments is not None:
        walk = measure(scenario)
        bound = _bound(scenario, setup, walk)
        for frame, by_anchor in zip(walk.range_frames, walk.excess, strict=True):
            excess.note(frame.stamp_ns, by_anchor)
        truths, instants, outcomes = _step_through(walk, watched, poses)
    else:
        truths, instants, outcomes = _run_chain(scenario, watched, poses, excess)
    scores = _scores(choices, outcomes, excess, scenario.file.uwb.sigma)
    reference = Reference(truths)
    covered = sum(reference.covers(stamp_ns) for stamp_ns in instants)
    epoch_bound = _epoch_bound(scenario, setup, np.array([truth.pose for truth in truths]))
    sought_ns = _sought_since(scenario, truths)
    found: dict[str, TrialFigures | None] = {}
    for choice in choices:
        errors = compare(poses[choice], reference, covered)
        found[choice] = trial_figures(
            errors,
            watched[choice],
            instants[0],
            alignment,
            bound=bound,
            epoch_bound=epoch_bound,
            sought_ns=sought_ns,
            ranges=scores[choice],
            legs=leg_figures(scenario, errors, truths[-1].stamp_ns),
        )
    return found


def watched_choices(
    config: Config, setup: Setup, choices: Iterable[str], start: FloatArray
) -> dict[str, WatchedEstimator]:
    """Estimators and single sensors that choices name, each watched by a monitor of its own.

    Args:
        config: of the site.
        setup: its geometry.
        choices: NAME[:PARAM].
        start: (3,) true x [m], y [m], yaw [rad] at the start, from which `lidar` counts.

    Raises:
        UserError: a parameter is wrong.
    """
    sensors = make_sensors(config)
    return {
        choice: WatchedEstimator(make_choice(config, setup, choice, start), make_monitor(config, sensors))
        for choice in choices
    }


def make_choice(config: Config, setup: Setup, choice: str, start: FloatArray) -> Estimator:
    """Estimator or single sensor that a choice names; see `watched_choices`."""
    if choice == LIDAR_ALONE:
        return DeadReckoning(setup, start)
    if choice == UWB_ALONE:
        choice = "least_squares"
    settings = chosen_settings(config, choice, "--estimators")
    return make_estimator(split_choice(choice)[0], settings, setup, config.relocation)


def watched_pipeline(config: Config, choices: Mapping[str, Estimator]) -> Pipeline:
    """Pipeline of the site's front end and these estimators, by choice."""
    names = (split_choice(choice)[0] for choice in choices if choice not in (LIDAR_ALONE, UWB_ALONE))
    front_end, look_back = make_front_end(config, names)
    return Pipeline(front_end, choices, look_back)


def _step_through(
    walk: MeasuredWalk, estimators: Mapping[str, Estimator], poses: Mapping[str, list[PoseEstimate]]
) -> tuple[list[Truth], list[int], list[Outcome]]:
    """Measurements straight into the estimators; poses at the end of every step."""
    outcomes: list[Outcome] = []
    instants: list[int] = walk.stamps_ns.tolist()
    waiting = iter(walk.in_order())
    following = next(waiting, None)
    for stamp_ns in instants:
        while following is not None and following.stamp_ns <= stamp_ns:
            reports = {choice: estimator.update(following) for choice, estimator in estimators.items()}
            outcomes.append(Outcome(following, reports))
            following = next(waiting, None)
        note_poses({label: estimator.pose_at(stamp_ns) for label, estimator in estimators.items()}, poses)
    truths = [Truth(stamp_ns, pose) for stamp_ns, pose in zip(instants, walk.poses, strict=True)]
    return truths, instants, outcomes


def _run_chain(
    scenario: Scenario,
    estimators: Mapping[str, Estimator],
    poses: Mapping[str, list[PoseEstimate]],
    excess: TrueExcess,
) -> tuple[list[Truth], list[int], list[Outcome]]:
    """The whole chain from emulated bytes on, in memory; poses at its ticks."""
    config = scenario.config
    pipeline = watched_pipeline(config, estimators)
    chain = Chain(config, START_NS, pipeline, next(iter(estimators)))
    truths: list[Truth] = []
    instants: list[int] = []
    outcomes: list[Outcome] = []
    for item in converse(scenario, chain.sensors, excess.note):
        if isinstance(item, Truth):
            truths.append(item)
            continue
        for tick in chain.feed(item):
            instants.append(tick.stamp_ns)
            outcomes += tick.outcomes
            note_poses(tick.poses, poses)
    return truths, instants, outcomes


def _scores(
    choices: Sequence[str], outcomes: list[Outcome], excess: TrueExcess, sigma: float
) -> dict[str, RangeScore]:
    scores = {choice: RangeScore() for choice in choices}
    for outcome in outcomes:
        if isinstance(outcome.measurement, RangeFrame):
            too_long = excess.of(outcome.measurement)
            for choice, report in outcome.reports.items():
                scores[choice].note(too_long, sigma, report)
    return scores


def note_poses(now: Mapping[str, PoseEstimate | None], poses: Mapping[str, list[PoseEstimate]]) -> None:
    """Add the poses of an instant to those before, by choice; who has none adds none."""
    for choice, pose in now.items():
        if pose is not None:
            poses[choice].append(pose)


def _bound(scenario: Scenario, setup: Setup, walk: MeasuredWalk) -> float | None:
    """Root mean square over the walk of the least position error [m]; blocked ranges do not count.

    What is measured between two steps counts at the later one, as if the motion in between were known: that
    can only lower the bound. None where no increment tells the motion, without noise, and where the start is
    unknown or the robot is carried off.
    """
    sigma = scenario.file.uwb.sigma
    if scenario.file.kidnap or not setup.start.known or sigma == 0.0:
        return None
    information = np.zeros((len(walk.poses), 3, 3))

    def count(stamp_ns: int, pose: FloatArray, seen: FloatArray) -> None:
        k = int(np.searchsorted(walk.stamps_ns, stamp_ns))
        if k < len(walk.poses):
            information[k] += seen_from(walk.poses[k], pose, seen)

    at_frames = _true_poses(scenario, walk.range_frames)
    for frame, unblocked, pose in zip(walk.range_frames, walk.unblocked, at_frames, strict=True):
        count(frame.stamp_ns, pose, range_information(pose, setup, unblocked, sigma))
    for look, pose in zip(walk.landmark_frames, _true_poses(scenario, walk.landmark_frames), strict=True):
        ids = look.landmark_ids.tolist()
        seen = landmark_information(pose, setup, ids, look.range_sigma, look.bearing_sigma)
        count(look.stamp_ns, pose, seen)
    increment_covs = [increment.cov for increment in walk.increments[1:]]
    bounds = posterior_bound(np.diag(setup.start.sigma**2), walk.poses, increment_covs, information)
    return float(np.sqrt((bounds[:, 0, 0] + bounds[:, 1, 1]).mean()))


def _true_poses(scenario: Scenario, frames: Sequence[RangeFrame | LandmarkFrame]) -> FloatArray:
    """Poses (N, 3) at which something was measured."""
    times = np.array([(frame.stamp_ns - START_NS) * 1e-9 for frame in frames], dtype=np.float64)
    return scenario.trajectory.at(times).pose


def _epoch_bound(scenario: Scenario, setup: Setup, poses: FloatArray) -> float | None:
    """Root mean square over the walk of the least error of one frame of ranges [m].

    Blocked ranges do not count. Poses from which ranges give no position are left out; None when there is
    no other, or without noise.
    """
    sigma = scenario.file.uwb.sigma
    if sigma == 0.0:
        return None
    some = poses[:: max(1, len(poses) // _BOUND_POSES)]
    horizontal = transform_each(some, setup.tag_in_body[None, :2])
    tags = np.column_stack([horizontal, np.full(len(some), setup.height + setup.tag_in_body[2])])
    anchors = np.array(list(setup.anchors.values()))
    clear = np.array([scenario.world.line_of_sight(tag, anchors) for tag in tags])
    information = position_information(tags, anchors, clear, sigma)
    told = np.linalg.cond(information) < _WORST_CONDITION
    if not told.any():
        return None
    return float(np.sqrt(np.linalg.inv(information[told]).trace(axis1=1, axis2=2).mean()))


def _sought_since(scenario: Scenario, truths: Sequence[Truth]) -> int | None:
    """When the robot set off, or was carried off for the last time; None when its place was known."""
    xy = np.array([truth.pose[:2] for truth in truths])
    if scenario.file.kidnap:
        return truths[1 + int(np.argmax(np.linalg.norm(np.diff(xy, axis=0), axis=1)))].stamp_ns
    if scenario.config.start.known:
        return None
    return truths[int(np.argmax(np.linalg.norm(xy - xy[0], axis=1) > MOVED))].stamp_ns


def _settled(errors: Errors, since_ns: int) -> float:
    if not errors.has_yaw:
        return np.inf
    wrong = (errors.distance > RIGHT_WITHIN[0]) | (np.abs(errors.error[:, 2]) > RIGHT_WITHIN[1])
    right_from = 1 + int(np.flatnonzero(wrong)[-1]) if wrong.any() else 0
    if right_from == len(wrong):
        return np.inf
    return max(0.0, float(errors.stamps_ns[right_from] - since_ns) * 1e-9)


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
