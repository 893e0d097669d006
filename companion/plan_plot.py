"""The picture of an anchor layout: accuracy over the floor, as it is and with one more anchor."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, QuadMesh
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from companion.config import Config
from companion.errors import UserError
from companion.plan import Layout
from estimators.messages import FloatArray

_SIZE, _DPI = (12.0, 5.8), 125
_INK, _NO_POSITION = "#202020", "#B0B0B0"


def plan_figure(layout: Layout, config: Config, path: Path) -> None:
    """Draw a layout as a PNG picture of 1500 x 725 pixels.

    Left the floor as it is, right with one more anchor (star). Grey is where ranges give no position; the
    line goes round what is worse than the limit.

    Args:
        layout: to draw.
        config: of the site.
        path: file to write.

    Raises:
        UserError: the file cannot be written.
    """
    picture = Figure(figsize=_SIZE, dpi=_DPI, layout="constrained")
    now, then = picture.subplots(1, 2, sharex=True, sharey=True)
    known = layout.error[np.isfinite(layout.error)]
    best = min(float(np.nanmin(layout.error_with_extra)), float(known.min()) if len(known) else layout.limit)
    least, most = 0.9 * best, max(3.0 * layout.limit, 2.0 * best)
    scale = LogNorm(least, most)
    for ax, error, title in (
        (now, layout.error, "now"),
        (then, layout.error_with_extra, "with one more anchor"),
    ):
        mesh = _draw(ax, layout, error, config, scale)
        share = layout.good_share(error)
        ax.set_title(f"{title}: {share:.0%} within {layout.limit:g} m", loc="left", fontsize=9)
    then.plot(
        *layout.extra[:2], "*", color="#D55E00", markersize=15, markeredgecolor="white", label="one more"
    )
    then.legend(loc="upper right", fontsize=8)
    now.set_ylabel("map y [m]")
    low, high = np.nanmin(layout.segments, axis=0), np.nanmax(layout.segments, axis=0)
    now.set(xlim=(low[[0, 2]].min() - 0.4, high[[0, 2]].max() + 0.4))
    now.set(ylim=(low[[1, 3]].min() - 0.4, high[[1, 3]].max() + 0.9))
    bar = picture.colorbar(mesh, ax=[now, then], extend="max", shrink=0.9)
    bar.set_label("least position error of one frame of ranges [m]", fontsize=9)
    ticks = [tick for tick in (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0) if least <= tick <= most]
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.ax.minorticks_off()
    picture.suptitle(f"{config.site.name}: accuracy of ranges over the floor", fontsize=11)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        picture.savefig(path, format="png")
    except OSError as error:
        raise UserError(f"cannot write the picture {path}: {error.strerror}") from error


def _draw(ax: Axes, layout: Layout, error: FloatArray, config: Config, scale: LogNorm) -> QuadMesh:
    ax.set_facecolor("white")
    without = np.where(np.isinf(error), 1.0, np.nan)
    if np.isfinite(without).any():
        ax.contourf(layout.x, layout.y, np.isinf(error), levels=[0.5, 1.5], colors=[_NO_POSITION])
    shown = np.where(np.isfinite(error), error, np.nan)
    mesh = ax.pcolormesh(layout.x, layout.y, shown, norm=scale, cmap="viridis_r", shading="nearest")
    bad = np.nan_to_num(error, nan=0.0, posinf=1e9) > layout.limit
    if bad.any() and not bad.all():
        ax.contour(layout.x, layout.y, bad, levels=[0.5], colors=["#D55E00"], linewidths=1.2)
    ax.add_collection(LineCollection(list(layout.segments.reshape(-1, 2, 2)), colors=_INK, linewidths=1.8))
    for anchor_id, position in config.anchors.items():
        ax.plot(*position[:2], "^", color=_INK, markersize=9, markeredgecolor="white")
        ax.annotate(f"A{anchor_id}", position[:2], (6, 6), textcoords="offset points", fontsize=8)
    ax.set(aspect="equal", xlabel="map x [m]")
    ax.tick_params(labelsize=8)
    return mesh
