"""How a scene opens: which views there are, where, and on what scale."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import rerun.blueprint as rrb

from companion.config import Config
from companion.view.entities import TIME
from companion.view.palette import GROUND
from estimators.immutable import immutable

REVIEW_TRAIL, LIVE_TRAIL = 8.0, 120.0
"""Length [s] of the bright trail behind a pose: in review the whole track is there too."""
_MARGIN = 0.4
"""Between the outermost wall or anchor and the border of the map [m]."""
_ERRORS = ("error/position", "error/yaw")
_BY_ANCHOR = ("ranges/residual", "ranges/nis")


@immutable
class Layout:
    """What the views of one run are made from.

    Attributes:
        config: of the site.
        names: estimators, the primary first.
        plots: entities that hold time series -> upper end of the y axis, None to fit everything.
        has_truth: errors are known, not only sigmas.
        has_autopilot: the autopilot's own position is on the map.
        root: entity below which all of the run is.
        title: of the run when there are several, else empty.
    """

    config: Config
    names: Sequence[str]
    plots: dict[str, float | None]
    has_truth: bool
    has_autopilot: bool
    root: str = ""
    title: str = ""

    @property
    def primary(self) -> str:
        """Estimator in the foreground."""
        return self.names[0]


def run_blueprint(run: Layout, trail: float, compares: bool) -> rrb.Blueprint:
    """Tabs of one run: the run itself, estimators beside each other, sensors.

    Args:
        run: to show.
        trail: length of the bright trail [s].
        compares: open with the tab of the estimators.
    """
    errors = ["error/position", "error/yaw", "ranges/residual", "ranges/nis"]
    tabs: list[rrb.Container] = [
        rrb.Horizontal(
            rrb.Vertical(
                _map(run, trail),
                _lanes(run),
                _log(run),
                row_shares=[4.0, _lanes_share(run), 1.4],
            ),
            rrb.Vertical(*_plots(run, errors)),
            column_shares=[1.5, 1.0],
            name="run",
        )
    ]
    compared = [*_plots(run, _ERRORS, fits=True), *_plots(run, ["apart"])]
    if len(run.names) > 1 and compared:
        tabs.append(
            rrb.Horizontal(
                _map(run, trail), rrb.Vertical(*compared), column_shares=[1.2, 1.0], name="estimators"
            )
        )
    sensors = _plots(run, ["sensors/age", "sensors/rate", "sensors/latency"])
    if sensors:
        tabs.append(rrb.Vertical(*sensors, name="sensors"))
    return _blueprint(rrb.Tabs(*tabs, active_tab=int(compares and len(run.names) > 1)))


def comparison_blueprint(runs: Sequence[Layout]) -> rrb.Blueprint:
    """Runs beside each other, under one time cursor: maps, verdicts, errors, health."""
    columns = []
    compared = ("error/position", "ranges/residual")
    # One scale for all: what is larger is to look larger.
    limits = {e: max((run.plots.get(e) or 0.0 for run in runs), default=0.0) or None for e in compared}
    for run in runs:
        run = replace(run, plots={e: limits[e] for e in compared if e in run.plots})
        plots = _plots(run, compared)
        shares = [3.2, 1.25 * _lanes_share(run), *(1.2 for _ in plots), 1.5]
        parts = [_map(run, REVIEW_TRAIL), _lanes(run), *plots, _log(run)]
        columns.append(rrb.Vertical(*parts, row_shares=shares, name=run.title))
    return _blueprint(rrb.Horizontal(*columns))


def _blueprint(root: rrb.Container | rrb.View) -> rrb.Blueprint:
    return rrb.Blueprint(
        root,
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        # Following stands at the end of a file: the first look shows the whole run.
        rrb.TimePanel(state="collapsed", timeline=TIME, play_state="following"),
    )


def walk_blueprint(config: Config) -> rrb.Blueprint:
    """The map alone, of a robot whose true walk is known."""
    title = "truth, x right, y up: robot white, free lines of sight green, blocked vermilion"
    return _blueprint(_map_view(config, "", title, ["truth"], LIVE_TRAIL))


def _map(run: Layout, trail: float) -> rrb.Spatial2DView:
    shown = [f"{run.primary} blue"]
    shown += ["truth white"] if run.has_truth else []
    shown += ["autopilot orange"] if run.has_autopilot else []
    title = f"{_title(run)}map, x right, y up: {', '.join(shown)}"
    return _map_view(run.config, run.root, title, [f"estimate/{name}" for name in run.names], trail)


def _map_view(
    config: Config, root: str, title: str, moving: Iterable[str], trail: float
) -> rrb.Spatial2DView:
    """The map below `root`, with a trail of so many seconds behind what moves, and all its past closures."""
    corners = [position[:2] for position in config.anchors.values()]
    corners += [corner for wall in config.site.walls for corner in wall]
    (left, bottom), (right, top) = np.min(corners, axis=0) - _MARGIN, np.max(corners, axis=0) + _MARGIN
    visible = rrb.VisibleTimeRanges(
        timeline=TIME,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-trail),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    past = rrb.VisibleTimeRanges(
        timeline=TIME, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
    )
    return rrb.Spatial2DView(
        origin=root or "/",
        contents=f"/{root}map/**",
        name=title,
        background=GROUND,
        # Seen from outside the mirroring transform of `map`, y runs from -top to -bottom.
        visual_bounds=rrb.VisualBounds2D(x_range=[left, right], y_range=[-top, -bottom]),
        overrides={
            **{f"/{root}map/{name}/trail": visible for name in moving},
            **{f"/{root}map/{name}/closures": past for name in moving},
        },
    )


def _lanes(run: Layout) -> rrb.StateTimelineView:
    return rrb.StateTimelineView(
        origin=run.root or "/",
        contents=[f"+ /{run.root}health/state", f"+ /{run.root}ranges/verdict/**"],
        name=f"{_title(run)}health, and verdict of {run.primary} on ranges",
    )


def _lanes_share(run: Layout) -> float:
    """Of the height: a lane for health and one for each anchor, up to half of what the map takes."""
    return min(0.4 * (1.3 + len(run.config.anchors)), 3.0)


def _log(run: Layout) -> rrb.TextLogView:
    return rrb.TextLogView(
        origin=f"{run.root}log",
        name=f"{_title(run)}log",
        # The time stands in the text: a column of its own would be too narrow for it.
        columns=rrb.TextLogColumns(timeline_columns=[], text_log_columns=["loglevel", "body"]),
    )


def _plots(run: Layout, entities: Iterable[str], fits: bool = False) -> list[rrb.TimeSeriesView]:
    names = {
        "error/position": "horizontal position error [m]" if run.has_truth else "position, 3 sigma [m]",
        "error/yaw": "heading error [deg]" if run.has_truth else "heading, 3 sigma [deg]",
        "apart": f"distance from {run.primary} [m]",
        "ranges/residual": f"range residual in {run.primary} [m], colours as the anchors",
        "ranges/nis": f"range NIS in {run.primary}, white: gate",
        "sensors/age": "age of the newest measurement [ms]",
        "sensors/rate": "measurements in the last second",
        "sensors/latency": "age of a pose when it was sent [ms]",
    }
    views = []
    for entity in entities:
        if entity not in run.plots:
            continue
        limit = None if fits else run.plots[entity]
        lower = -1.0 if entity == "error/yaw" else 0.0
        views.append(
            rrb.TimeSeriesView(
                origin=run.root + entity,
                name=_title(run) + names[entity],
                axis_y=None if limit is None else rrb.ScalarAxis(range=(lower * limit, limit)),
                # Few legends: a plot is small, and anchors keep the colours that they have on the map.
                plot_legend=rrb.PlotLegend(
                    corner=rrb.Corner2D.LeftTop, visible=entity not in ("error/yaw", *_BY_ANCHOR)
                ),
            )
        )
    return views


def _title(run: Layout) -> str:
    return f"{run.title}: " if run.title else ""
