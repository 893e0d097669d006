"""The picture of an evaluation: tracks, error over time, error distribution, and whether it was admitted."""

from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from companion.errors import UserError
from companion.evaluate import Errors
from companion.evaluation import Evaluation
from companion.metrics import chi2_mean_bounds
from companion.plots import PALETTE
from estimators.messages import FloatArray

_SIZE, _DPI = (12.0, 9.0), 125
_STEP = 0.5
"""Error and NEES over time are shown every so many seconds."""
_SPREAD = (5, 50, 95)
"""Percentiles over the trials: band and line."""


def evaluation_figure(result: Evaluation, path: Path) -> None:
    """Draw an evaluation as a PNG picture of 1500 x 1125 pixels.

    Top left the tracks of the trial that was worst for the last estimator, top right the position error over
    time (median and 5 to 95 % over the trials), bottom left the share of instants with less than an error,
    bottom right the mean NEES over the trials with the band that holds 95 % of it when covariances are right.

    Args:
        result: of at least one trial.
        path: file to write.

    Raises:
        UserError: the file cannot be written.
    """
    picture = Figure(figsize=_SIZE, dpi=_DPI, layout="constrained")
    colours = dict(zip(result.errors, cycle(PALETTE), strict=False))
    shown = {name: errors for name, errors in result.errors.items() if errors}
    (tracks, over_time), (shares, nees) = picture.subplots(2, 2)
    _draw_tracks(tracks, result, colours)
    for name, errors in shown.items():
        _draw_over_time(over_time, list(errors.values()), colours[name])
        _draw_shares(shares, list(errors.values()), colours[name])
        _draw_nees(nees, list(errors.values()), colours[name])
    _draw_nees_bounds(nees, shown, colours)
    over_time.set(yscale="log", xlabel="time [s]")
    over_time.yaxis.set_major_formatter("{x:g}")
    over_time.set_title("position error [m]: median, shaded: 5 to 95 % of the trials", loc="left", fontsize=9)
    shares.set(xscale="log", xlabel="position error [m]", ylim=(0.0, 1.0))
    shares.xaxis.set_major_formatter("{x:g}")
    shares.set_title("share of instants with less than this error", loc="left", fontsize=9)
    nees.set(yscale="log", xlabel="time [s]")
    nees.yaxis.set_major_formatter("{x:g}")
    nees.set_title(
        f"NEES, mean of {result.trials} trials; dotted: 95 % bounds of its mean", loc="left", fontsize=9
    )
    for ax in picture.axes:
        ax.tick_params(labelsize=8)
        ax.spines[["top", "right"]].set_visible(False)
        ax.set_axisbelow(True)
        ax.grid(color="#E4E4E4", linewidth=0.6)
    handles, labels = tracks.get_legend_handles_labels()
    picture.legend(handles, labels, loc="outside lower center", ncols=7, fontsize=9, frameon=False)
    picture.suptitle(f"{result.scenario}: {result.trials} trials", fontsize=11)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        picture.savefig(path, format="png")
    except OSError as error:
        raise UserError(f"cannot write the picture {path}: {error.strerror}") from error


def _draw_tracks(ax: Axes, result: Evaluation, colours: dict[str, str]) -> None:
    seed = result.worst_seed()
    for wall in result.config.site.walls:
        ax.plot(*np.array(wall).T, color="#404040", linewidth=2.0)
    anchors = np.array(list(result.config.anchors.values()))[:, :2]
    ax.plot(*anchors.T, "^", color="#303030", markersize=7, label="anchors")
    tracks = {name: errors[seed] for name, errors in result.errors.items() if seed in errors}
    for name, errors in tracks.items():
        ax.plot(*errors.pose[:, :2].T, color=colours[name], linewidth=0.9, label=name)
    if tracks:
        truth = max(tracks.values(), key=lambda errors: len(errors.truth)).truth
        ax.plot(*truth[:, :2].T, "--", color="#000000", linewidth=0.9, label="truth")
        # The room decides what is seen, not the wildest pose.
        corners = [anchors, truth[:, :2], *(np.array(wall) for wall in result.config.site.walls)]
        low, high = np.vstack(corners).min(axis=0) - 0.4, np.vstack(corners).max(axis=0) + 0.4
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    ax.set(aspect="equal", xlabel="map x [m]", ylabel="map y [m]")
    ax.set_title(f"tracks of seed {seed}, the worst for {result.decisive}", loc="left", fontsize=9)


def _draw_over_time(ax: Axes, trials: list[Errors], colour: str) -> None:
    times, values = _sampled(trials, [errors.distance for errors in trials])
    low, median, high = np.nanpercentile(values, _SPREAD, axis=0)
    ax.plot(times, np.maximum(median, 1e-3), color=colour, linewidth=1.2)
    ax.fill_between(
        times, np.maximum(low, 1e-3), np.maximum(high, 1e-3), color=colour, alpha=0.2, linewidth=0
    )


def _draw_shares(ax: Axes, trials: list[Errors], colour: str) -> None:
    distances = np.sort(np.concatenate([errors.distance for errors in trials]))
    ax.plot(
        np.maximum(distances, 1e-3),
        np.arange(1, len(distances) + 1) / len(distances),
        color=colour,
        linewidth=1.2,
    )


def _draw_nees(ax: Axes, trials: list[Errors], colour: str) -> None:
    times, values = _sampled(trials, [errors.nees for errors in trials])
    ax.plot(times, np.nanmean(values, axis=0), color=colour, linewidth=1.0)


def _draw_nees_bounds(ax: Axes, shown: dict[str, dict[int, Errors]], colours: dict[str, str]) -> None:
    for name, errors in shown.items():
        for bound in chi2_mean_bounds([each.nees_dof for each in errors.values()]):
            ax.axhline(bound, color=colours[name], linewidth=0.9, linestyle=":")


def _sampled(trials: list[Errors], values: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Times (K,) [s] since the first instant, and the trials' values (trials, K) there, NaN after a trial."""
    begin_ns = min(int(errors.stamps_ns[0]) for errors in trials)
    seconds = [(errors.stamps_ns - begin_ns) * 1e-9 for errors in trials]
    times = np.arange(min(each[0] for each in seconds), max(each[-1] for each in seconds), _STEP)
    sampled = [
        np.interp(times, each, value, left=np.nan, right=np.nan)
        for each, value in zip(seconds, values, strict=True)
    ]
    return times, np.array(sampled)
