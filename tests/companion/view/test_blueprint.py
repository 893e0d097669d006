"""How a scene is arranged when it opens."""

from typing import Any

import rerun.blueprint as rrb

from companion.config import Config
from companion.view.blueprint import Layout, comparison_blueprint


def views_below(part: Any) -> list[Any]:
    """All views of a container."""
    return [v for c in part.contents for v in views_below(c)] if isinstance(part, rrb.Container) else [part]


def test_two_runs_are_compared_on_the_scale_of_the_larger(config: Config) -> None:
    limits = {"before": 0.1, "after": 0.4}
    runs = [
        Layout(config, ["ekf"], {"error/position": limit}, True, False, f"{title}/", title)
        for title, limit in limits.items()
    ]
    views = views_below(comparison_blueprint(runs).root_container)
    plots = [view for view in views if isinstance(view, rrb.TimeSeriesView)]
    assert [view.origin for view in plots] == ["before/error/position", "after/error/position"]
    for view in plots:
        axis: Any = view.properties["ScalarAxis"]
        assert axis.range.as_arrow_array().to_pylist() == [[0.0, 0.4]]
