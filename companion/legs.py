"""Errors on each leg of a walk, as papers tabulate them."""

from dataclasses import dataclass

import numpy as np

from companion.evaluate import Errors
from companion.sim.scenario import Scenario
from companion.sim.simulate import START_NS


@dataclass(frozen=True, slots=True)
class LegFigures:
    """How an estimator did on one leg, turns left out.

    Attributes:
        rmse_m: root mean square of the horizontal error [m].
        max_m: largest horizontal error [m].
    """

    rmse_m: float
    max_m: float


def leg_figures(scenario: Scenario, errors: Errors) -> dict[str, LegFigures]:
    """Figures by the names that the scenario gives its legs, if any; legs without a pose are left out.

    Args:
        scenario: without bytes, so that its walk begins at `START_NS`.
        errors: of one estimator.
    """
    names = scenario.file.trajectory.leg_names
    if not names:
        return {}
    times = (errors.stamps_ns - START_NS) * 1e-9
    figures: dict[str, LegFigures] = {}
    for name, (begin, end) in zip(names, scenario.trajectory.legs, strict=True):
        distance = errors.distance[(times >= begin) & (times <= end)]
        if len(distance):
            figures[name] = LegFigures(float(np.sqrt((distance**2).mean())), float(distance.max()))
    return figures
