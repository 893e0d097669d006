"""How a Rerun recording of a run opens: which views there are, where, and on what scale."""

import numpy as np
import rerun.blueprint as rrb

from companion.config import Config

TIMELINE = "time"
TRAIL = 8.0
"""Length [s] of the bright trail behind the primary's pose."""
_GROUND = 0x101216FF


def blueprint(config: Config, primary: str, plots: dict[str, float | None]) -> rrb.Blueprint:
    """Map large at the left, errors and ranges at the right, health below.

    Args:
        config: of the site.
        primary: estimator in the foreground.
        plots: entities that hold time series -> upper end of the y axis, None to fit everything.
    """
    corners = [position[:2] for position in config.anchors.values()]
    corners += [corner for wall in config.site.walls for corner in wall]
    (left, bottom), (right, top) = np.min(corners, axis=0) - 0.4, np.max(corners, axis=0) + 0.4
    trail = rrb.VisibleTimeRanges(
        timeline=TIMELINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-TRAIL),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    map_view = rrb.Spatial2DView(
        origin="/",
        contents="map/**",
        name=f"map, x right, y up: {primary} (blue), truth (white)",
        background=_GROUND,
        # Seen from outside the mirroring transform of `map`, y runs from -top to -bottom.
        visual_bounds=rrb.VisualBounds2D(x_range=[left, right], y_range=[-top, -bottom]),
        overrides={f"map/estimate/{primary}/trail": trail},
    )
    names = {
        "error/position": "horizontal position error [m]",
        "error/yaw": "heading error [deg], colours as above",
        "ranges/residual": f"range residual in {primary} [m], colours as the anchors",
        "ranges/nis": f"range NIS in {primary}, white: gate",
    }
    views = [_plot(entity, name, plots[entity]) for entity, name in names.items() if entity in plots]
    verdicts = rrb.StateTimelineView(origin="ranges/verdict", name=f"verdict of {primary} on ranges")
    health = rrb.Horizontal(
        rrb.StateTimelineView(origin="health/state", name="health"),
        rrb.TextLogView(
            origin="health/log",
            name="health log",
            columns=rrb.TextLogColumns(text_log_columns=["loglevel", "body"]),
        ),
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(map_view, verdicts, health, row_shares=[4.5, 1.7, 1.0]),
            rrb.Vertical(*views, visible=bool(views)),
            column_shares=[1.5, 1.0],
        ),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        # Following stands at the end of a file: the first look shows the whole run.
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
    )


def _plot(entity: str, name: str, limit: float | None) -> rrb.TimeSeriesView:
    lower = -1.0 if entity == "error/yaw" else 0.0
    return rrb.TimeSeriesView(
        origin=entity,
        name=name,
        axis_y=None if limit is None else rrb.ScalarAxis(range=(lower * limit, limit)),
        # One legend: a plot is small, and anchors keep the colours that they have on the map.
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=entity == "error/position"),
    )
