"""The worst trial of an evaluation as a log: to be replayed, and looked at in Rerun."""

from collections.abc import Sequence
from pathlib import Path

from companion.evaluation import Evaluation
from companion.fault_trial import faulty_records
from companion.log_edit.edit import write_log
from companion.log_trial import LOG_SUFFIX
from companion.sim.scenario import load_scenario
from companion.sim.simulate import START_NS, records


def write_worst_trial(
    result: Evaluation, path: Path, folder: Path, sets: list[str], faults: Sequence[str] = ()
) -> Path | None:
    """Run the worst trial again and write what crossed its ports.

    Args:
        result: of the scenario.
        path: scenario file, or log.
        folder: where the log is written.
        sets: `--set` assignments on the site's configuration.
        faults: of every trial.

    Returns:
        The log; None where there is nothing to write: the source is a log, or a scenario without bytes.

    Raises:
        UserError: the log cannot be written.
    """
    seed = result.worst_seed()
    log = folder / f"{result.file_stem}_seed{seed}{LOG_SUFFIX}"
    if faults:
        config, start_ns, edited = faulty_records(path, seed, sets, faults)
        write_log(log, config, start_ns, edited)
        return log
    if path.suffix == LOG_SUFFIX:
        return None
    scenario = load_scenario(path, seed, sets)
    if scenario.file.increments is not None:
        return None
    write_log(log, scenario.config, START_NS, records(scenario))
    return log
