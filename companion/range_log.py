"""A line for every range: what was measured, and what the estimator made of it, with its reason."""

from estimators.base import Report
from estimators.messages import RangeFrame

HEADER = "stamp_ns,anchor,range_m,residual_m,nis,verdict\n"
"""First line of `ranges.csv`."""


def range_lines(frame: RangeFrame, report: Report) -> str:
    """Lines of `ranges.csv` for one frame; fields that the estimator does not tell stay empty."""
    blank = [""] * len(frame.ranges)
    residuals = [f"{r:.4f}" for r in report.residuals.tolist()] or blank
    nis = [f"{n:.3f}" for n in report.nis.tolist()] or blank
    columns = (frame.anchor_ids.tolist(), frame.ranges.tolist(), residuals, nis, report.verdicts)
    return "".join(
        f"{frame.stamp_ns},{anchor_id},{measured:.3f},{residual},{square},{verdict}\n"
        for anchor_id, measured, residual, square, verdict in zip(*columns, strict=True)
    )
