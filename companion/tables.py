"""Figures as tables for a terminal."""

from rich.table import Table

from companion.replay import Replay
from estimators.base import Verdict

LABELS = {
    "ekf": "ekf: UWB + LiDAR",
    "least_squares": "least_squares: UWB",
    "lidar_odometry": "lidar_odometry: LiDAR",
}


def accuracy_table(result: Replay, title: str) -> Table:
    """Errors against truth, consistency and time of every estimator of a replay."""
    table = Table(title=title, title_justify="left")
    table.add_column("estimator", no_wrap=True)
    for heading in ("RMSE\nm", "max\nm", "95 %\nm", "yaw RMSE\ndeg", "NEES\n(expect)", "update\nms"):
        table.add_column(heading, justify="right")
    for name in result.names:
        accuracy = result.accuracy(name)
        label = LABELS.get(name, name)
        update_ms = f"{result.update_times[name].mean_ms:.2f}"
        if accuracy is None:
            table.add_row(label, "-", "-", "-", "-", "-", update_ms)
            continue
        yaw = f"{accuracy.yaw_rmse_deg:.2f}" if accuracy.yaw_rmse_deg is not None else "none"
        table.add_row(
            label,
            f"{accuracy.rmse:.3f}",
            f"{accuracy.max:.3f}",
            f"{accuracy.p95:.3f}",
            yaw,
            f"{accuracy.nees:.1f} ({accuracy.nees_dof})",
            update_ms,
        )
    return table


def anchor_table(result: Replay) -> Table:
    """What the primary estimator made of the ranges of each anchor."""
    by_anchor = result.anchor_verdicts[result.names[0]]
    given = [verdict for verdict in Verdict if any(counts[verdict] for counts in by_anchor.values())]
    table = Table(title=f"ranges by {result.names[0]}", title_justify="left")
    table.add_column("anchor", no_wrap=True)
    for verdict in given:
        table.add_column(verdict, justify="right", max_width=14)
    for anchor_id, counts in sorted(by_anchor.items()):
        table.add_row(f"A{anchor_id}", *(str(counts[verdict]) for verdict in given))
    return table


def sensor_lines(result: Replay) -> list[str]:
    """What the decoders counted and what became of the measurements, a line each."""
    lines = [
        f"{name}: {stats.good} good frames, {stats.bad} bad, {stats.skipped_bytes} bytes skipped"
        for name, stats in result.sensors.items()
    ]
    verdicts = result.verdicts[result.names[0]]
    counted = ", ".join(f"{verdicts[v]} {v}" for v in Verdict if verdicts[v])
    lines += [
        f"{name}: height unobservable in {count} of {len(result.poses[name])} poses; the site's is kept"
        for name in result.names
        if (count := result.without_height(name))
    ]
    lines.append(f"{result.names[0]}: ranges and increments: {counted or 'none'}; {result.late} late")
    return lines
