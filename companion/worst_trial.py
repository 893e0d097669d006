"""The worst trial of an evaluation as a log: to be replayed, and looked at in Rerun."""

from pathlib import Path

from companion.evaluation import Evaluation
from companion.log_trial import LOG_SUFFIX
from companion.sim.scenario import load_scenario
from companion.sim.simulate import simulate


def write_worst_trial(result: Evaluation, path: Path, folder: Path, sets: list[str]) -> Path | None:
    """Run the worst trial again and write what crossed its ports.

    Args:
        result: of the scenario.
        path: scenario file, or log.
        folder: where the log is written.
        sets: `--set` assignments on the site's configuration.

    Returns:
        The log; None where there is nothing to write: the source is a log, or a scenario without bytes.

    Raises:
        UserError: the log cannot be written.
    """
    if path.suffix == LOG_SUFFIX:
        return None
    seed = result.worst_seed()
    scenario = load_scenario(path, seed, sets)
    if scenario.file.increments is not None:
        return None
    log = folder / f"{result.scenario}_seed{seed}{LOG_SUFFIX}"
    for _ in simulate(scenario, log):
        pass
    return log
