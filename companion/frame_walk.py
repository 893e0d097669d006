"""A live run in the background of a check: where the robot is, and where the autopilot thinks that it is."""

import threading
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape

from companion.config import load_config
from companion.errors import UserError
from companion.live import LiveRun
from companion.mavlink.contact import Watch
from companion.shipped_files import named_file
from drivers.mavlink_frames import MavlinkMessage
from estimators.messages import FloatArray

PATIENCE = 60.0
"""How long good health is waited for before each walk [s]."""
RATES = {"ATTITUDE": 10.0, "LOCAL_POSITION_NED": 10.0}


class Walker:
    """A live run in a thread, and the autopilot's view beside it; a context manager.

    Attributes:
        yaw: heading [rad] that the autopilot told last, clockwise from north; None before.
        position: (2,) north and east [m] that it told last; None before.

    Args:
        site: file.
        sets: `--set` assignments.
        folder: for the log.
        console: for what the run has to say.
    """

    def __init__(self, site: Path, sets: list[str], folder: Path, console: Console) -> None:
        self._config = load_config(named_file(site, "sites"), sets)
        self._console = console
        self.yaw: float | None = None
        self.position: FloatArray | None = None
        self._stop = threading.Event()
        self._live = LiveRun(self._config, folder, self._say, Watch(RATES, self._hear))
        self._thread = threading.Thread(target=self._live.run, args=(self._stop,))

    def __enter__(self) -> "Walker":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    @property
    def is_surveyed(self) -> bool:
        """Whether the map's heading is the site's; the compass tells nothing of one that came from it."""
        return self._config.mavlink.align == "site"

    @property
    def map_heading(self) -> float:
        """Compass heading of the map's x axis [rad]."""
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
