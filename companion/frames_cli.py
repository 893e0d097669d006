"""`companion doctor frames`: a walk forward and a walk to the left, and what they say about the axes."""

import tempfile
from math import degrees
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from companion.terminal import message_console, result_console

EXIT_DISAGREES = 1


def frames(
    site: Annotated[Path, typer.Option("--site", metavar="FILE", help="Site file.")],
    mavlink: Annotated[
        str | None, typer.Option("--mavlink", metavar="URL", help="Device string of the autopilot.")
    ] = None,
    sets: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change a setting of the site.")
    ] = None,
) -> None:
    """Say whether axes and signs agree, from a walk forward and a walk to the left.

    Put the robot on its start mark, disarmed, with some free metres ahead and to its left. It may turn for
    the second walk or go sideways. Poses are sent to the autopilot as in a run; its compass and its own
    position are compared, too.

    Exit codes: 0 all agrees, 1 something does not, 2 the call is wrong or there is no good pose.
    """
    from companion.frame_check import Finding, judge_autopilot, judge_compass, judge_walk
    from companion.frame_walk import Walker
    from companion.mavlink.pose_out import ned_from_map
    from estimators.geometry import wrap_angle

    out, err = result_console(), message_console()
    assignments = [*(sets or []), *([f"mavlink.url={mavlink}"] if mavlink is not None else [])]
    findings: list[Finding] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        Walker(site, assignments, Path(folder), err) as walker,
    ):
        err.print("Put the robot on its start mark and keep it still.")
        for what in ("forward", "left"):
            begin, autopilots_begin = walker.pose(), walker.position
            if what == "forward" and walker.yaw is not None and walker.is_surveyed:
                findings.append(judge_compass(wrap_angle(walker.map_heading - begin[2]), walker.yaw))
            direction = "straight ahead" if what == "forward" else "to the left of where it looks now"
            typer.prompt(
                f"Walk it 1 to 3 m {direction}, stop, and press Enter",
                default="",
                show_default=False,
                err=True,
            )
            end = walker.pose()
            findings.append(judge_walk(what, begin, end))
            if walker.yaw is not None and walker.is_surveyed:
                ours = ned_from_map(walker.map_heading)[:2, :2] @ (end - begin)[:2]
                moved = None
                if autopilots_begin is not None and walker.position is not None:
                    moved = walker.position - autopilots_begin
                findings.append(judge_autopilot(ours, moved))
    for finding in findings:
        mark = {True: "[green]ok[/]    ", False: "[red]wrong[/] ", None: "[yellow]open[/]  "}[finding.agrees]
        out.print(f"{mark} {escape(finding.text)}")
    if not all(finding.agrees is not False for finding in findings):
        raise typer.Exit(EXIT_DISAGREES)
    if walker.is_surveyed:
        out.print(f"map heading {degrees(walker.map_heading) % 360.0:.1f} deg")
