"""What choices on the command line name, watched side by side on the same measurements."""

from collections.abc import Iterable, Mapping

from companion.config import Config
from companion.estimator_choice import chosen_settings, split_choice
from companion.pipeline import Pipeline, make_front_end, make_monitor, make_sensors
from companion.watched import WatchedEstimator
from estimators import make_estimator
from estimators.base import Estimator, Setup
from estimators.lidar.dead_reckoning import DeadReckoning
from estimators.messages import FloatArray, PoseEstimate

UWB_ALONE, LIDAR_ALONE = "uwb_ls", "lidar"
"""The single sensors: `least_squares` on ranges alone; increments added up from the true start."""


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


def note_poses(now: Mapping[str, PoseEstimate | None], poses: Mapping[str, list[PoseEstimate]]) -> None:
    """Add the poses of an instant to those before, by choice; who has none adds none."""
    for choice, pose in now.items():
        if pose is not None:
            poses[choice].append(pose)
