"""One trial of a scenario: estimators side by side on the same measurements, and how far each was off."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from companion.estimator_choice import chosen_settings, split_choice
from companion.evaluate import Errors, Reference, compare
from companion.legs import LegFigures, leg_figures
from companion.log import Truth
from companion.pipeline import Chain, Pipeline
from companion.sim.measurements import MeasuredWalk, measure, setup_of
from companion.sim.scenario import Scenario, load_scenario
from companion.sim.simulate import START_NS, converse
from estimators import make_estimator
from estimators.base import Estimator, Report, Setup, Verdict
from estimators.bounds import landmark_information, posterior_bound, range_information
from estimators.lidar.dead_reckoning import DeadReckoning
from estimators.lidar.scan_matching import ScanMatcher
from estimators.messages import Measurement, PoseEstimate

UWB_ALONE, LIDAR_ALONE = "uwb_ls", "lidar"
"""The single sensors: `least_squares` on ranges alone; increments added up from the true start."""


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
    iterations: float | None = None
    legs: dict[str, LegFigures] = field(default_factory=dict)


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
    if scenario.file.increments is not None:
        walk = measure(scenario)
        bound = _bound(scenario, setup, walk)
        truths, instants = _step_through(walk, timed, poses)
    else:
        truths, instants = _run_chain(scenario, timed, poses)
    reference = Reference(truths)
    covered = sum(reference.covers(stamp_ns) for stamp_ns in instants)
    found: dict[str, TrialFigures | None] = {}
    for choice in choices:
        errors = compare(poses[choice], reference, covered)
        figures = _figures(errors, timed[choice].seconds, bound)
        iterations = float(np.mean(taken)) if (taken := timed[choice].iterations) else None
        legs = leg_figures(scenario, errors) if scenario.file.trajectory.leg_names else {}
        found[choice] = replace(figures, iterations=iterations, legs=legs) if figures else None
    return found


class _TimedEstimator:
    """An estimator that notes how long each update took that it had a use for."""

    def __init__(self, estimator: Estimator) -> None:
        self._estimator = estimator
        self.seconds: list[float] = []
        self.iterations: list[int] = []

    def reset(self) -> None:
        self._estimator.reset()

    def update(self, measurement: Measurement) -> Report:
        begin = time.perf_counter()
        report = self._estimator.update(measurement)
        took = time.perf_counter() - begin
        if Verdict.NOT_USED not in report.verdicts:
            self.seconds.append(took)
        if report.iterations is not None:
            self.iterations.append(report.iterations)
        return report

    def pose_at(self, stamp_ns: int) -> PoseEstimate | None:
        return self._estimator.pose_at(stamp_ns)


def _make(scenario: Scenario, setup: Setup, choice: str) -> Estimator:
    if choice == LIDAR_ALONE:
        return DeadReckoning(setup, scenario.trajectory.at(np.zeros(1)).pose[0])
    if choice == UWB_ALONE:
        choice = "least_squares"
    settings = chosen_settings(scenario.config, choice, "--estimators")
    return make_estimator(split_choice(choice)[0], settings, setup)


def _step_through(
    walk: MeasuredWalk, estimators: Mapping[str, Estimator], poses: Mapping[str, list[PoseEstimate]]
) -> tuple[list[Truth], list[int]]:
    """Measurements straight into the estimators; poses at the end of every step."""
    instants: list[int] = walk.stamps_ns.tolist()
    waiting = iter(walk.in_order())
    following = next(waiting, None)
    for stamp_ns in instants:
        while following is not None and following.stamp_ns <= stamp_ns:
            for estimator in estimators.values():
                estimator.update(following)
            following = next(waiting, None)
        _note({label: estimator.pose_at(stamp_ns) for label, estimator in estimators.items()}, poses)
    return [Truth(stamp_ns, pose) for stamp_ns, pose in zip(instants, walk.poses, strict=True)], instants


def _run_chain(
    scenario: Scenario, estimators: Mapping[str, Estimator], poses: Mapping[str, list[PoseEstimate]]
) -> tuple[list[Truth], list[int]]:
    """The whole chain from emulated bytes on, in memory; poses at its ticks."""
    config = scenario.config
    front_end = ScanMatcher(config.scan_matcher, config.lidar_mounting())
    chain = Chain(config, START_NS, Pipeline(front_end, estimators), next(iter(estimators)))
    truths: list[Truth] = []
    instants: list[int] = []
    for item in converse(scenario, chain.sensors):
        if isinstance(item, Truth):
            truths.append(item)
            continue
        for tick in chain.feed(item):
            instants.append(tick.stamp_ns)
            _note(tick.poses, poses)
    return truths, instants


def _note(now: Mapping[str, PoseEstimate | None], poses: Mapping[str, list[PoseEstimate]]) -> None:
    for choice, pose in now.items():
        if pose is not None:
            poses[choice].append(pose)


def _bound(scenario: Scenario, setup: Setup, walk: MeasuredWalk) -> float | None:
    """Root mean square over the walk of the least position error [m]; blocked ranges do not count.

    None when ranges or landmarks are measured between the steps, where no increment tells the motion, or
    without noise.
    """
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


def _figures(errors: Errors, seconds: list[float], bound: float | None) -> TrialFigures | None:
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
    )
