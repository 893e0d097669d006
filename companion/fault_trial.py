"""A trial into which faults are put: a scenario or a log, edited, then run as any log."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from companion.alignment import Alignment
from companion.config import Config
from companion.errors import UserError
from companion.log import Log, RawChunk, Truth
from companion.log_edit.edit import edit_records
from companion.log_edit.faults import parse_fault
from companion.log_trial import LOG_SUFFIX, run_records
from companion.replay import config_of
from companion.sim.scenario import load_scenario
from companion.sim.simulate import START_NS, records
from companion.trial_figures import TrialFigures


def run_fault_trial(
    path: Path,
    seed: int,
    sets: list[str],
    choices: Sequence[str],
    alignment: Alignment = Alignment.NONE,
    faults: Sequence[str] = (),
) -> dict[str, TrialFigures | None]:
    """Run estimators on a scenario or log in which something goes wrong.

    Args:
        path: scenario file, or log with truth.
        seed: of everything random, in the scenario and in the faults.
        sets: `--set` assignments on the site's configuration.
        choices: NAME[:PARAM] of estimators, or single sensors.
        alignment: of tracks, for `TrialFigures.ate_m`.
        faults: as the command line writes them, all at once.

    Returns:
        Figures by choice; None for an estimator that gave no pose where truth is known.

    Raises:
        UserError: a file, a choice or a fault is wrong, or the scenario has no bytes.
    """
    config, start_ns, edited = faulty_records(path, seed, sets, faults)
    return run_records(edited, str(path), config, start_ns, choices, alignment)


def faulty_records(
    path: Path, seed: int, sets: list[str], faults: Sequence[str]
) -> tuple[Config, int, list[RawChunk | Truth]]:
    """Configuration, time of the first pose and records of one trial; see `run_fault_trial`."""
    rng = np.random.default_rng([seed, len(faults)])
    found: Iterable[RawChunk | Truth]
    if path.suffix == LOG_SUFFIX:
        found = log = Log(path)
        config, start_ns = config_of(log, sets), log.start_ns
    else:
        scenario = load_scenario(path, seed, sets)
        if scenario.file.increments is not None:
            raise UserError(f"{path}: a scenario with [increments] has no bytes to put a fault into")
        found, config, start_ns = records(scenario), scenario.config, START_NS
    parsed = [parse_fault(fault, config) for fault in faults]
    return config, start_ns, edit_records(found, config, start_ns, parsed, rng)
