"""The truth of an emulated walk in Rerun: the world, the robot, and which anchors it really sees."""

import threading
import time
from collections.abc import Callable

import numpy as np
import rerun as rr

from companion.sim.robot import Robot
from companion.view.blueprint import walk_blueprint
from companion.view.entities import Entities
from companion.view.map_scene import ARROW
from companion.view.palette import GREEN, GREY, ORANGE, VERMILION, WHITE, rgba, screen
from companion.view.viewer import Mode, Viewer
from companion.view.window import KEEPS_UP, Window
from estimators.geometry import transform

PERIOD = 0.1
"""Time between pictures [s]."""


class WalkScene:
    """Draws a robot whose true pose is known.

    Args:
        stream: of Rerun.
        robot: that walks, or is going to.
        start_ns: when the picture begins.
    """

    def __init__(self, stream: rr.RecordingStream, robot: Robot, start_ns: int) -> None:
        self._robot = robot
        self._entities = Entities(stream, start_ns, 1.0 / PERIOD)
        self._setup = robot.scenario.config.setup()
        self._last: tuple[float, float] | None = None
        anchors = self._setup.anchors
        self._anchors = np.array(list(anchors.values()))
        put = self._entities.static
        put("map", rr.Transform3D(scale=[1.0, -1.0, 1.0]))
        walls = list(robot.scenario.world.segments.reshape(-1, 2, 2))
        put("map/walls", rr.LineStrips2D(walls, colors=GREY, radii=screen(1.5)))
        labels = [f"A{i}" for i in anchors]
        marks = rr.Points2D(
            self._anchors[:, :2], colors=ORANGE, labels=labels, radii=screen(5.0), draw_order=46.0
        )
        put("map/anchors", marks)
        put("map/truth/heading", rr.Arrows2D.from_fields(colors=WHITE, radii=screen(1.5), draw_order=32.0))
        put("map/sight", rr.LineStrips2D.from_fields(radii=screen(1.0), draw_order=10.0))

    def send(self, now_ns: int) -> None:
        """Draw the robot where it is at one instant."""
        entities, stamps_ns = self._entities, np.array([now_ns])
        pose = self._robot.motion(now_ns).pose[0]
        x, y, yaw = pose.tolist()
        entities.points("map/truth/position", stamps_ns, pose[None, :2], WHITE, 4.0, 32.0)
        arrow = rr.Arrows2D.columns(vectors=[[ARROW * np.cos(yaw), ARROW * np.sin(yaw)]], origins=[[x, y]])
        entities.columns("map/truth/heading", stamps_ns, arrow)
        if self._last is not None:
            way = np.array([self._last, (x, y)])
            entities.strips(
                "map/truth/trail", np.array([now_ns, now_ns]), way, WHITE & ~0x60, width=1.5, layer=31.0
            )
        self._last = (x, y)
        self._send_sight(now_ns)

    def _send_sight(self, now_ns: int) -> None:
        """Lines from the tag to every anchor, in another colour where something stands between."""
        setup, robot = self._setup, self._robot
        tag_xy = transform(robot.motion(now_ns).pose[0], setup.tag_in_body[None, :2])[0]
        tag = np.array([*tag_xy, setup.height + setup.tag_in_body[2]])
        clear = robot.scenario.sees(tag, robot.seconds(now_ns))
        strips = np.stack([np.broadcast_to(tag_xy, (len(clear), 2)), self._anchors[:, :2]], axis=1)
        lines = rr.LineStrips2D.columns(
            strips=strips.astype(np.float32), colors=rgba(np.where(clear, GREEN, VERMILION).tolist())
        )
        self._entities.columns("map/sight", np.array([now_ns]), lines.partition([len(clear)]))


class WalkView:
    """Shows an emulated robot in a viewer, from a thread of its own.

    Args:
        robot: to show.
        mode: a page or a window.
        say: takes one line for the user.

    Raises:
        UserError: no screen for a window, a port is in use, or the viewer does not start.
    """

    def __init__(self, robot: Robot, mode: Mode, say: Callable[[str], None]) -> None:
        self._say = say
        config = robot.scenario.config
        viewer = Viewer(mode, config.view)
        self._window = Window(viewer, f"{config.site.name}, truth of {robot.scenario.name}")
        self._scene = WalkScene(self._window.stream, robot, time.monotonic_ns())
        self._window.stream.send_blueprint(walk_blueprint(config))
        say(f"view: open {viewer.page}" if viewer.page else "view: window open")
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="view", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the view."""
        self._closing.set()
        # Not for ever: a viewer that dies in the middle may leave it waiting.
        self._thread.join(2.0 * KEEPS_UP)
        self._window.close()

    def _run(self) -> None:
        while not self._closing.wait(PERIOD):
            if not self._window.is_open:
                self._say("view: the viewer was closed; the emulation goes on")
                return
            if self._window.is_ready():
                self._scene.send(time.monotonic_ns())
                self._window.take()
