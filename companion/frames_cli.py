"""`companion doctor frames`: a walk forward and a walk to the left, and what they say about the axes."""

import tempfile
import threading
import time
from math import degrees
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape

from companion.config import load_config
from companion.errors import UserError
from companion.frame_check import Finding, judge_autopilot, judge_compass, judge_walk
from companion.live import LiveRun
from companion.mavlink.contact import Watch
from companion.mavlink.pose_out import ned_from_map
from drivers.mavlink_frames import MavlinkMessage
from estimators.geometry import wrap_angle
from estimators.messages import FloatArray

EXIT_DISAGREES = 1
PATIENCE = 60.0
"""How long good health is waited for before each walk [s]."""
RATES = {"ATTITUDE": 10.0, "LOCAL_POSITION_NED": 10.0}


class _Walker:
    """A live run in a thread, and the autopilot's view beside it."""

    def __init__(self, site: Path, sets: list[str], folder: Path, console: Console) -> None:
        self._config = load_config(site, sets)
        self._console = console
        self.yaw: float | None = None
        self.position: FloatArray | None = None
        self._stop = threading.Event()
        self._live = LiveRun(self._config, folder, self._say, Watch(RATES, self._hear))
        self._thread = threading.Thread(target=self._live.run, args=(self._stop,))

    def __enter__(self) -> "_Walker":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    @property
    def map_heading(self) -> float:
        return self._config.map_heading()

    def pose(self) -> FloatArray:
        """The pose (3,) as soon as it is good.

        Raises:
            UserError: it does not get good.
        """
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            status = self._live.status
            if status.pose is not None and status.health is not None and status.health.sends:
                return np.array([*status.pose.xy, status.pose.yaw])
            time.sleep(0.05)
        health = self._live.status.health
        raise UserError(
            f"no good pose within {PATIENCE:.0f} s: {health.reason if health else 'nothing measured'}"
        )

    def _say(self, line: str) -> None:
        self._console.print(f"[dim]{escape(line)}[/]", soft_wrap=True)

    def _hear(self, message: MavlinkMessage, _: int) -> None:
        if message.get_type() == "ATTITUDE":
            self.yaw = message.yaw
        elif message.get_type() == "LOCAL_POSITION_NED":
            self.position = np.array([message.x, message.y])


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
    out, err = Console(highlight=False, soft_wrap=True), Console(stderr=True, highlight=False)
    assignments = [*(sets or []), *([f"mavlink.url={mavlink}"] if mavlink is not None else [])]
    findings: list[Finding] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        _Walker(site, assignments, Path(folder), err) as walker,
    ):
        err.print("Put the robot on its start mark and keep it still.")
        for what in ("forward", "left"):
            begin, autopilots_begin = walker.pose(), walker.position
            if what == "forward" and walker.yaw is not None:
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
            if autopilots_begin is not None and walker.position is not None:
                ours = ned_from_map(walker.map_heading)[:2, :2] @ (end - begin)[:2]
                findings.append(judge_autopilot(ours, walker.position - autopilots_begin))
    for finding in findings:
        mark = {True: "[green]ok[/]    ", False: "[red]wrong[/] ", None: "[yellow]open[/]  "}[finding.agrees]
        out.print(f"{mark} {escape(finding.text)}")
    if not all(finding.agrees is not False for finding in findings):
        raise typer.Exit(EXIT_DISAGREES)
    out.print(f"map heading {degrees(walker.map_heading) % 360.0:.1f} deg")
