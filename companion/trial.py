"""One trial of a scenario: estimators side by side on the same measurements, and how far each was off."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from companion.estimator_choice import chosen_settings, split_choice
from companion.evaluate import Errors, Reference, compare
from companion.log import Truth
from companion.look_back import make_look_back
from companion.pipeline import Chain, Outcome, Pipeline, make_front_end, make_matcher
from companion.range_score import RangeScore, TrueExcess
from companion.sim.measurements import MeasuredWalk, measure, setup_of
from companion.sim.scenario import Scenario, load_scenario
from companion.sim.simulate import START_NS, converse
from estimators import make_estimator
from estimators.base import Estimator, Report, Setup, Verdict
from estimators.bounds import landmark_information, posterior_bound, range_information
from estimators.lidar.dead_reckoning import DeadReckoning
from estimators.messages import Measurement, PoseEstimate, RangeFrame

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
            `RIGHT_WITHIN` to the end [s]; infinite when it does not, or has no heading.
        ranges: what became of blocked and of clean ranges.
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
    settled_s: float
    ranges: RangeScore


def run_trial(
    path: Path, seed: int, sets: list[str], choices: Sequence[str]
) -> dict[str, TrialFigures | None]:
    """Run a scenario once.

    Args:
        path: scenario file.
        seed: of everything random.
        sets: `--set` assignments on the site's configuration.
        choices: NAME[:PARAM] of estimators, or single sensors.

    Returns:
        Figures by choice; None for an estimator that gave no pose at all.

    Raises:
        UserError: a file or a choice is wrong.
    """
    scenario = load_scenario(path, seed, sets)
    setup = setup_of(scenario)
    timed = {choice: _TimedEstimator(_make(scenario, setup, choice)) for choice in choices}
    poses: dict[str, list[PoseEstimate]] = {choice: [] for choice in choices}
    bound: float | None = None
    excess = TrueExcess(1.0 / scenario.file.uwb.rate)
    if scenario.file.increments is not None:
        walk = measure(scenario)
        bound = _bound(scenario, setup, walk)
        for frame, by_anchor in zip(walk.range_frames, walk.excess, strict=True):
            excess.note(frame.stamp_ns, by_anchor)
        truths, instants, outcomes = _step_through(walk, timed, poses)
    else:
        truths, instants, outcomes = _run_chain(scenario, timed, poses, excess)
    scores = _scores(choices, outcomes, excess, scenario.file.uwb.sigma)
    reference = Reference(truths)
    covered = sum(reference.covers(stamp_ns) for stamp_ns in instants)
    sought_ns = _sought_since(truths, kidnapped=bool(scenario.file.kidnap))
    return {
        choice: _figures(
            compare(poses[choice], reference, covered),
            timed[choice].seconds,
            bound,
            sought_ns,
            scores[choice],
        )
        for choice in choices
    }


class _TimedEstimator:
    """An estimator that notes how long each update took that it had a use for."""

    def __init__(self, estimator: Estimator) -> None:
        self._estimator = estimator
        self.seconds: list[float] = []

    def reset(self) -> None:
        self._estimator.reset()

    def update(self, measurement: Measurement) -> Report:
        begin = time.perf_counter()
        report = self._estimator.update(measurement)
        took = time.perf_counter() - begin
        if Verdict.NOT_USED not in report.verdicts:
            self.seconds.append(took)
        return report

    def pose_at(self, stamp_ns: int) -> PoseEstimate | None:
        return self._estimator.pose_at(stamp_ns)


def _make(scenario: Scenario, setup: Setup, choice: str) -> Estimator:
    if choice == LIDAR_ALONE:
        return DeadReckoning(setup, scenario.trajectory.at(np.zeros(1)).pose[0])
    if choice == UWB_ALONE:
        choice = "least_squares"
    settings = chosen_settings(scenario.config, choice, "--estimators")
    return make_estimator(split_choice(choice)[0], settings, setup, scenario.config.relocation)


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
        _note({label: estimator.pose_at(stamp_ns) for label, estimator in estimators.items()}, poses)
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
    matcher = make_matcher(config)
    names = (split_choice(choice)[0] for choice in estimators if choice not in (LIDAR_ALONE, UWB_ALONE))
    pipeline = Pipeline(make_front_end(config, matcher), estimators, make_look_back(config, matcher, names))
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
            _note(tick.poses, poses)
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


def _note(now: Mapping[str, PoseEstimate | None], poses: Mapping[str, list[PoseEstimate]]) -> None:
    for choice, pose in now.items():
        if pose is not None:
            poses[choice].append(pose)


def _bound(scenario: Scenario, setup: Setup, walk: MeasuredWalk) -> float | None:
    """Root mean square over the walk of the least position error [m]; blocked ranges do not count.

    None when ranges or landmarks are measured between the steps, where no increment tells the motion,
    without noise, and where the start is unknown or the robot is carried off.
    """
    if scenario.file.kidnap or not setup.start.known:
        return None
    step_of = {stamp_ns: k for k, stamp_ns in enumerate(walk.stamps_ns.tolist())}
    measured_at = {frame.stamp_ns for frame in walk.range_frames}
    measured_at |= {look.stamp_ns for look in walk.landmark_frames}
    sigma = scenario.file.uwb.sigma
    if sigma == 0.0 or not measured_at <= step_of.keys():
        return None
    information = np.zeros((len(walk.poses), 3, 3))
    for frame, unblocked in zip(walk.range_frames, walk.unblocked, strict=True):
        k = step_of[frame.stamp_ns]
        information[k] += range_information(walk.poses[k], setup, unblocked, sigma)
    for look in walk.landmark_frames:
        k = step_of[look.stamp_ns]
        information[k] += landmark_information(
            walk.poses[k], setup, look.landmark_ids.tolist(), look.range_sigma, look.bearing_sigma
        )
    increment_covs = [increment.cov for increment in walk.increments[1:]]
    bounds = posterior_bound(np.diag(setup.start.sigma**2), walk.poses, increment_covs, information)
    return float(np.sqrt((bounds[:, 0, 0] + bounds[:, 1, 1]).mean()))


def _sought_since(truths: Sequence[Truth], kidnapped: bool) -> int:
    """When the robot set off, or was carried off for the last time."""
    xy = np.array([truth.pose[:2] for truth in truths])
    if kidnapped:
        return truths[1 + int(np.argmax(np.linalg.norm(np.diff(xy, axis=0), axis=1)))].stamp_ns
    return truths[int(np.argmax(np.linalg.norm(xy - xy[0], axis=1) > MOVED))].stamp_ns


def _settled(errors: Errors, since_ns: int) -> float:
    if not errors.has_yaw:
        return np.inf
    wrong = (errors.distance > RIGHT_WITHIN[0]) | (np.abs(errors.error[:, 2]) > RIGHT_WITHIN[1])
    right_from = 1 + int(np.flatnonzero(wrong)[-1]) if wrong.any() else 0
    if right_from == len(wrong):
        return np.inf
    return max(0.0, float(errors.stamps_ns[right_from] - since_ns) * 1e-9)


def _figures(
    errors: Errors, seconds: list[float], bound: float | None, sought_ns: int, ranges: RangeScore
) -> TrialFigures | None:
    accuracy = errors.accuracy()
    if accuracy is None:
        return None
    by_axis = np.abs(errors.error[:, :2])
    rmse_x, rmse_y = np.sqrt((by_axis**2).mean(axis=0)).tolist()
    max_x, max_y = by_axis.max(axis=0).tolist()
    median, p99 = (1e6 * np.percentile(seconds, [50, 99])).tolist()
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
        settled_s=_settled(errors, sought_ns),
        ranges=ranges,
    )
