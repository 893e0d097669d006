"""Picture of a range calibration: errors over distance and time, before and after."""

from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from companion.calibration.ranges import Calibration
from companion.errors import UserError

_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#000000", "#B8A400")
"""Okabe and Ito's colours: told apart by colour-blind eyes too."""
_SHOWN = 400
"""Ranges drawn of each anchor at most."""


def residual_figure(calibration: Calibration, path: Path, title: str) -> None:
    """Draw range errors before and after calibration, with the fitted lines.

    Args:
        calibration: what was found.
        path: PNG to write.
        title: above the picture.

    Raises:
        UserError: the file cannot be written.
    """
    picture = Figure(figsize=(10.0, 5.2), dpi=150, layout="constrained")
    picture.suptitle(title, fontsize=11)
    before, after = picture.subplots(1, 2, sharey=True)
    before.set_ylabel("range minus distance [m]", fontsize=9)
    extent = []
    for (anchor_id, fit), colour in zip(calibration.anchors.items(), cycle(_COLOURS), strict=False):
        distances = fit.ranges.distances
        shown = slice(None, None, max(1, len(distances) // _SHOWN))
        for ax, calibrated in ((before, False), (after, True)):
            residuals = fit.residuals(calibrated)
            ax.plot(distances[shown], residuals[shown], ".", color=colour, markersize=2, alpha=0.5)
            extent.append(np.percentile(residuals, [1.0, 99.0]))
        ends = np.array([distances.min(), distances.max()])
        line = fit.bias.constant + fit.bias.per_metre * (ends - fit.bias.distance)
        before.plot(ends, line, color=colour, linewidth=2.0, label=f"anchor {anchor_id}")
    for ax, name, calibrated in ((before, "as measured", False), (after, "calibrated", True)):
        every = np.concatenate([fit.residuals(calibrated) for fit in calibration.anchors.values()])
        rms, median = float(np.sqrt((every**2).mean())), float(np.median(every))
        ax.set_title(f"{name}: median {median:+.3f} m, RMS {rms:.3f} m", fontsize=10)
        ax.set_xlabel("distance [m]", fontsize=9)
        ax.axhline(0.0, color="#303030", linewidth=0.8)
        ax.grid(color="#E4E4E4", linewidth=0.6)
        ax.set_axisbelow(True)
        ax.tick_params(labelsize=8)
        ax.spines[["top", "right"]].set_visible(False)
    low, high = np.min(extent), np.max(extent)
    before.set_ylim(low - 0.3 * (high - low), high + 0.3 * (high - low))
    picture.legend(loc="outside lower center", ncols=8, fontsize=9, frameon=False)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        picture.savefig(path, format="png")
    except OSError as error:
        raise UserError(f"cannot write the picture {path}: {error.strerror}") from error
