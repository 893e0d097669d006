"""The picture of a replay: where the robot was thought to be, how far off, and whether that was admitted."""

from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from companion.errors import UserError
from companion.evaluate import Errors
from companion.replay import Replay
from estimators import chi2
from estimators.messages import FloatArray

# Okabe and Ito's colours: told apart by colour-blind eyes too.
_PRIMARY, _TRUTH = "#0072B2", "#000000"
_OTHERS = ("#CC79A7", "#E69F00", "#009E73", "#D55E00", "#56B4E9")
PALETTE = (_PRIMARY, *_OTHERS)
"""Colours of estimators, in the order in which they are named."""
_WALL, _OBSTACLE, _INK, _GRID = "#404040", "#909090", "#303030", "#E4E4E4"
_SIZE, _DPI = (10.0, 5.7), 150
"""Inches and dots an inch: 1500 x 855 pixels, with text that is still read at a width of 900."""


def figure(result: Replay, path: Path, title: str, obstacles: FloatArray | None) -> None:
    """Draw a replay as a PNG picture of 1500 x 855 pixels.

    Left the map with every estimator's track. Right, when the log holds truth: errors in position and
    heading with three sigma of the primary, and its NEES with the band that holds 95 % of it when the
    covariance is right.

    Args:
        result: of the replay, the primary estimator first.
        path: file to write.
        title: above the picture.
        obstacles: (M, 4) x1, y1, x2, y2 [m] of surfaces in the map frame, None when not known.

    Raises:
        UserError: the file cannot be written.
    """
    # A Figure of its own, not pyplot's: no global state, no display.
    picture = Figure(figsize=_SIZE, dpi=_DPI, layout="constrained")
    picture.suptitle(title, fontsize=11, color=_INK)
    primary = result.errors.get(result.names[0])
    if primary is None or not len(primary.stamps_ns):
        explained = _draw_map(picture.add_subplot(), result, obstacles)
    else:
        knows_yaw = any(errors.has_yaw for errors in result.errors.values())
        panels = [_draw_position, *([_draw_heading] if knows_yaw else []), _draw_nees]
        grid = picture.add_gridspec(len(panels), 2, width_ratios=[1.1, 1.0])
        explained = _draw_map(picture.add_subplot(grid[:, 0]), result, obstacles)
        for row, draw in enumerate(panels):
            ax = picture.add_subplot(grid[row, 1])
            draw(ax, result)
            is_last = row == len(panels) - 1
            ax.tick_params(labelbottom=is_last)
            ax.set_xlabel("time [s]" if is_last else "", fontsize=9)
    picture.legend(handles=explained, loc="outside lower center", ncols=6, fontsize=9, frameon=False)
    for ax in picture.axes:
        ax.tick_params(labelsize=8, colors=_INK)
        ax.spines[["top", "right"]].set_visible(False)
        ax.set_axisbelow(True)
        ax.grid(color=_GRID, linewidth=0.6)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        picture.savefig(path, format="png")
    except OSError as error:
        raise UserError(f"cannot write the picture {path}: {error.strerror}") from error


def _draw_map(ax: Axes, result: Replay, obstacles: FloatArray | None) -> list[Line2D]:
    """Draw the map; gives what the legend explains."""
    if obstacles is not None:
        ax.add_collection(LineCollection(list(obstacles.reshape(-1, 2, 2)), colors=_OBSTACLE, linewidths=1.2))
    for wall in result.config.site.walls:
        ax.plot(*np.array(wall).T, color=_WALL, linewidth=2.0)
    anchors = np.array(list(result.config.anchors.values()))[:, :2]
    marks = ax.plot(*anchors.T, "^", color=_INK, markersize=7, label="anchors")
    for i, position in zip(result.config.anchors, anchors, strict=True):
        # On the side towards the room, where no wall crosses the name.
        side = 11.0 * np.sign(anchors.mean(axis=0) - position)
        ax.annotate(f"A{i}", position, side, textcoords="offset points", ha="center", va="center", fontsize=8)
    tracks: list[Line2D] = []
    for zorder, (name, colour) in enumerate(reversed(_colours(result).items()), start=2):
        xy = np.array([pose.xy for pose in result.poses[name]]).reshape(-1, 2)
        width = 1.6 if name == result.names[0] else 0.8
        tracks += ax.plot(*xy.T, color=colour, linewidth=width, alpha=0.85, label=name, zorder=zorder)
    if result.errors:
        truth = max(result.errors.values(), key=lambda errors: len(errors.truth)).truth
        style = (0, (4, 2))
        tracks += ax.plot(
            *truth[:, :2].T, color=_TRUTH, linewidth=0.9, linestyle=style, label="truth", zorder=9
        )
    # The room decides what is seen, not the wildest pose.
    corners = np.array([*anchors, *(corner for wall in result.config.site.walls for corner in wall)])
    (left, bottom), (right, top) = corners.min(axis=0) - 0.4, corners.max(axis=0) + 0.4
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    ax.set_xlabel("map x [m]", fontsize=9)
    ax.set_ylabel("map y [m]", fontsize=9)
    return [*reversed(tracks), *marks]


def _draw_position(ax: Axes, result: Replay) -> None:
    (a, b), (_, d) = result.errors[result.names[0]].cov[:, :2, :2].transpose(1, 2, 0)
    major = np.sqrt(0.5 * (a + d) + np.hypot(0.5 * (a - d), b))
    lines = {name: errors.distance for name, errors in result.errors.items()}
    _draw_errors(ax, result, lines, np.full(len(major), 1e-3), 3.0 * major)
    peak = max(float(np.nanmax(values, initial=0.1)) for values in lines.values())
    # Estimators differ by a factor of ten and more: only a logarithm shows how each of them does.
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter("{x:g}")
    ax.set_ylim(0.005, 1.5 * peak)
    ax.set_title(f"position error [m]; shaded: 3 sigma of {result.names[0]}", loc="left", fontsize=9)


def _draw_heading(ax: Axes, result: Replay) -> None:
    bound = 3.0 * np.rad2deg(np.sqrt(result.errors[result.names[0]].cov[:, 2, 2]))
    lines = {name: _yaw_error(errors) for name, errors in result.errors.items()}
    _draw_errors(ax, result, lines, -bound, bound)
    # The first seconds, before the heading settles, would squeeze the rest.
    known = [np.abs(v[np.isfinite(v)]) for v in (bound, *lines.values())]
    limit = 1.3 * max(float(np.percentile(values, 85)) for values in known if len(values))
    ax.set_ylim(-limit, limit)
    ax.set_title(f"heading error [deg]; shaded: 3 sigma of {result.names[0]}", loc="left", fontsize=9)


def _draw_errors(
    ax: Axes, result: Replay, lines: dict[str, FloatArray], lower: FloatArray, upper: FloatArray
) -> None:
    primary = result.names[0]
    times, known = _seconds(result, primary), np.isfinite(upper)
    ax.fill_between(times, lower, upper, where=known, color=_PRIMARY, alpha=0.2, linewidth=0.0)
    for name, colour in reversed(_colours(result).items()):
        ax.plot(_seconds(result, name), lines[name], color=colour, linewidth=1.2 if name == primary else 0.6)


def _draw_nees(ax: Axes, result: Replay) -> None:
    primary = result.names[0]
    errors = result.errors[primary]
    nees, dof = errors.nees, errors.nees_dof
    low, high = float(chi2.ppf(0.025, dof)), float(chi2.ppf(0.975, dof))
    ax.axhspan(low, high, color=_PRIMARY, alpha=0.15, linewidth=0.0)
    ax.plot(_seconds(result, primary), nees, color=_PRIMARY, linewidth=0.6)
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter("{x:g}")
    ax.set_ylim(0.2 * low, 3.0 * max(high, float(nees.max(initial=0.0))))
    ax.set_title(f"NEES of {primary}; shaded: 95 % of chi-square, {dof} dof", loc="left", fontsize=9)


def _colours(result: Replay) -> dict[str, str]:
    primary, *others = result.names
    return {primary: _PRIMARY, **dict(zip(others, cycle(_OTHERS), strict=False))}


def _yaw_error(errors: Errors) -> FloatArray:
    """Heading error (N,) [deg]; NaN where the estimator does not know the heading."""
    return np.where(np.isfinite(errors.cov[:, 2, 2]), np.rad2deg(errors.error[:, 2]), np.nan)


def _seconds(result: Replay, name: str) -> FloatArray:
    """Times (N,) [s] of an estimator's errors since the first of any."""
    begin_ns = min(errors.stamps_ns[0] for errors in result.errors.values() if len(errors.stamps_ns))
    return np.asarray((result.errors[name].stamps_ns - begin_ns) * 1e-9)
