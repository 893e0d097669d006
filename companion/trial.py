"""One trial of a scenario: estimators side by side on the same measurements, and how far each was off."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from companion.alignment import Alignment
from companion.evaluate import Reference, compare
from companion.legs import leg_figures
from companion.log import Truth
from companion.pipeline import Chain, Outcome
from companion.range_score import RangeScore, TrueExcess
from companion.sim.measurements import MeasuredWalk, measure, setup_of
from companion.sim.scenario import Scenario, load_scenario
from companion.sim.simulate import START_NS, converse
from companion.trial_figures import TrialFigures, trial_figures
from companion.walk_bounds import epoch_bound, walk_bound
from companion.watched_choices import note_poses, watched_choices, watched_pipeline
from estimators.base import Estimator
from estimators.messages import PoseEstimate, RangeFrame

MOVED = 0.01
"""A robot that is further than this [m] from where it stood has set off."""


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
        bound = walk_bound(scenario, setup, walk)
        for frame, by_anchor in zip(walk.range_frames, walk.excess, strict=True):
            excess.note(frame.stamp_ns, by_anchor)
        truths, instants, outcomes = _step_through(walk, watched, poses)
    else:
        truths, instants, outcomes = _run_chain(scenario, watched, poses, excess)
    scores = _scores(choices, outcomes, excess, scenario.file.uwb.sigma)
    reference = Reference(truths)
    covered = sum(reference.covers(stamp_ns) for stamp_ns in instants)
    of_epochs = epoch_bound(scenario, setup, np.array([truth.pose for truth in truths]))
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
            epoch_bound=of_epochs,
            sought_ns=sought_ns,
            ranges=scores[choice],
            legs=leg_figures(scenario, errors, truths[-1].stamp_ns),
        )
    return found


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


def _sought_since(scenario: Scenario, truths: Sequence[Truth]) -> int | None:
    """When the robot set off, or was carried off for the last time; None when its place was known."""
    xy = np.array([truth.pose[:2] for truth in truths])
    if scenario.file.kidnap:
        return truths[1 + int(np.argmax(np.linalg.norm(np.diff(xy, axis=0), axis=1)))].stamp_ns
    if scenario.config.start.known:
        return None
    return truths[int(np.argmax(np.linalg.norm(xy - xy[0], axis=1) > MOVED))].stamp_ns
