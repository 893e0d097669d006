"""Errors on each leg of a walk, as papers tabulate them."""

from dataclasses import dataclass

import numpy as np

from companion.evaluate import Errors
from companion.sim.scenario import Scenario


@dataclass(frozen=True, slots=True)
class LegFigures:
    """How an estimator did on one leg, turns left out.

    Attributes:
        rmse_m: root mean square of the horizontal error [m].
        max_m: largest horizontal error [m].
    """

    rmse_m: float
    max_m: float


def leg_figures(scenario: Scenario, errors: Errors, end_ns: int) -> dict[str, LegFigures]:
    """Figures by the names that the scenario gives its legs, if any; legs without a pose are left out.

    Args:
        scenario: that was run.
        errors: of one estimator.
        end_ns: when the walk was over.
    """
    names = scenario.file.trajectory.leg_names
    if not names:
        return {}
    # It ends with the walk, and began when the LiDAR was ready.
    times = (errors.stamps_ns - end_ns) * 1e-9 + scenario.trajectory.duration
    figures: dict[str, LegFigures] = {}
    for name, (begin, end) in zip(names, scenario.trajectory.legs, strict=True):
        distance = errors.distance[(times >= begin) & (times <= end)]
        if len(distance):
            figures[name] = LegFigures(float(np.sqrt((distance**2).mean())), float(distance.max()))
    return figures
