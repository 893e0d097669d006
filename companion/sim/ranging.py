"""How UWB ranges and their signal powers err."""

import numpy as np
from numpy.typing import NDArray

from companion.sim.scenario import UwbTable
from estimators.immutable import immutable
from estimators.messages import FloatArray
from estimators.models.range import two_way_range


@immutable
class Ranging:
    """Ranges as a tag reports them, all arrays of one shape.

    Attributes:
        ranges: [m], slant.
        excess: how much too long what stands between made it [m]; 0 in line of sight.
        received: False where the ranging failed.
        rx_power: [dBm], of everything received.
        fp_power: [dBm], of the first path.
    """

    ranges: FloatArray
    excess: FloatArray
    received: NDArray[np.bool_]
    rx_power: FloatArray
    fp_power: FloatArray


def draw_delay_biases(uwb: UwbTable, count: int, rng: np.random.Generator) -> FloatArray:
    """What ranges of each anchor err by, (count,) [m], when it answers later or sooner than the tag believes.

    Args:
        uwb: how well the delays are known.
        count: number of anchors.
        rng: source of noise; nothing is drawn when the delays are known.
    """
    if uwb.delay_sigma_ns == 0.0:
        return np.zeros(count)
    late = 1e-9 * uwb.delay_sigma_ns * rng.standard_normal(count)
    none = np.zeros(count)
    return two_way_range(none, late, none, none)


def draw_ranging(
    uwb: UwbTable,
    distances: FloatArray,
    clear: NDArray[np.bool_],
    rng: np.random.Generator,
    power_rng: np.random.Generator,
) -> Ranging:
    """Ranges over true distances.

    Args:
        uwb: how they err.
        distances: [m], of any shape.
        clear: of the same shape; False where something stands between.
        rng: source of noise.
        power_rng: that of the powers.
    """
    noise = rng.standard_normal(distances.shape) * uwb.sigma
    excess = np.where(clear, 0.0, uwb.nlos_least + rng.exponential(uwb.nlos_mean, distances.shape))
    received = rng.random(distances.shape) >= uwb.dropout
    # Free-space loss; what is blocked loses more, most of all on its first path.
    rx_power = -72.0 - 20.0 * np.log10(np.maximum(distances, 0.1)) - np.where(clear, 0.0, 6.0)
    weaker = np.where(clear, uwb.power_difference, uwb.nlos_power_difference)
    weaker += uwb.power_sigma * power_rng.standard_normal(distances.shape)
    return Ranging(
        ranges=distances + noise + excess,
        excess=excess,
        received=received,
        rx_power=rx_power,
        fp_power=rx_power - np.maximum(weaker, 0.0),
    )
