"""A log as a trial: estimators side by side on what it holds, and how far each was off."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from companion.alignment import Alignment
from companion.config import Config
from companion.errors import UserError
from companion.evaluate import Reference, compare
from companion.log import Log, RawChunk, Truth
from companion.pipeline import Chain
from companion.replay import config_of
from companion.trial_figures import TrialFigures, trial_figures
from companion.watched_choices import note_poses, watched_choices, watched_pipeline
from estimators.messages import PoseEstimate

LOG_SUFFIX = ".mcap"


def log_config(path: Path, sets: Sequence[str]) -> Config:
    """Configuration stored in a log, with `--set` assignments applied.

    Raises:
        UserError: the file is no log, or an assignment is wrong.
    """
    return config_of(Log(path), list(sets))


def run_log_trial(
    path: Path, seed: int, sets: list[str], choices: Sequence[str], alignment: Alignment = Alignment.NONE
) -> dict[str, TrialFigures | None]:
    """Run estimators on a log.

    Args:
        path: log with truth.
        seed: nothing is random in a log: takes no part.
        sets: `--set` assignments on the log's configuration.
        choices: NAME[:PARAM] of estimators, or single sensors.
        alignment: of tracks, for `TrialFigures.ate_m`.

    Returns:
        Figures by choice; None for an estimator that gave no pose where truth is known.

    Raises:
        UserError: no log, no truth in it, or a choice is wrong.
    """
    del seed
    log = Log(path)
    return run_records(log, str(path), config_of(log, sets), log.start_ns, choices, alignment)


def run_records(
    records: Iterable[RawChunk | Truth],
    origin: str,
    config: Config,
    start_ns: int,
    choices: Sequence[str],
    alignment: Alignment = Alignment.NONE,
) -> dict[str, TrialFigures | None]:
    """Run estimators on the records of a log; see `run_log_trial`.

    Args:
        records: in the order of their stamps.
        origin: names them in errors.
        config: of the site.
        start_ns: time of the first pose.
        choices: as for `run_log_trial`.
        alignment: as for `run_log_trial`.

    Raises:
        UserError: no truth among them, or a choice is wrong.
    """
    waiting = list(records)
    truths = [record for record in waiting if isinstance(record, Truth)]
    if not truths:
        raise UserError(f"{origin}: no truth in the log, nothing to compare with; use companion replay")
    reference = Reference(truths)
    setup = config.setup()
    begin_ns = max(start_ns, truths[0].stamp_ns)
    start = reference.at([begin_ns])[0] if np.isfinite(truths[0].pose[2]) else setup.start.pose
    watched = watched_choices(config, setup, choices, start)
    chain = Chain(config, start_ns, watched_pipeline(config, watched), next(iter(watched)))
    poses: dict[str, list[PoseEstimate]] = {choice: [] for choice in choices}
    instants: list[int] = []
    for record in waiting:
        if isinstance(record, Truth):
            continue
        for tick in chain.feed(record):
            instants.append(tick.stamp_ns)
            note_poses(tick.poses, poses)
    covered = sum(reference.covers(stamp_ns) for stamp_ns in instants)
    return {
        choice: trial_figures(
            compare(poses[choice], reference, covered), watched[choice], start_ns, alignment
        )
        for choice in choices
    }
