"""The process that draws a live scene: ticks come through a pipe, Rerun's viewer and files get them."""

import os
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeAlias

from companion.config import Config, config_from_toml
from companion.errors import UserError
from companion.log import RawChunk, Truth
from companion.pipeline import Tick
from companion.view.line import Line
from companion.view.viewer import Shown, Viewer

if TYPE_CHECKING:
    from companion.view.files import RerunFiles
    from companion.view.scene import Scene

Item: TypeAlias = Tick | RawChunk | Line | Truth


@dataclass(frozen=True, slots=True)
class Drawing:
    """What to draw, and for whom.

    Attributes:
        config_toml: of the site.
        names: estimators, the primary first.
        start_ns: of the run.
        mode: where it is shown.
        files: first `.rrd` file to write; None for none.
    """

    config_toml: str
    names: list[str]
    start_ns: int
    mode: Shown
    files: Path | None


class Outlet(Protocol):
    """Takes a live run's items."""

    def take(self, items: list[Item]) -> None:
        """Show them.

        Raises:
            UserError: it cannot any more.
        """
        ...

    def close(self) -> None:
        """Finish."""
        ...


def draw(pipe: Connection, drawing: Drawing) -> None:
    """Draw what comes through a pipe, until None comes or it breaks; what is to be said goes back.

    Args:
        pipe: gives lists of items.
        drawing: what to draw.
    """
    # A session of its own: Ctrl-C is for the run, and the run can end all that belongs to the view.
    os.setsid()
    # Rerun would tell of every viewer that was closed, on the operator's terminal.
    os.environ.setdefault("RUST_LOG", "off")
    config = config_from_toml(drawing.config_toml, "the run")
    outlets: list[Outlet] = []
    with suppress(EOFError, OSError):
        try:
            if drawing.mode != "off":
                viewer = Viewer(drawing.mode, config.view)
                outlets.append(_LiveScene(config, drawing, viewer))
                pipe.send(f"open {viewer.page}" if viewer.page else "window open")
            if drawing.files is not None:
                outlets.append(_Files(config, drawing, drawing.files))
            while outlets and (items := pipe.recv()) is not None:
                for outlet in list(outlets):
                    try:
                        outlet.take(items)
                    except UserError as error:
                        pipe.send(str(error))
                        outlets.remove(outlet)
        except UserError as error:
            pipe.send(str(error))
        finally:
            for outlet in outlets:
                outlet.close()


class _LiveScene:
    """A live scene in a viewer."""

    def __init__(self, config: Config, drawing: Drawing, viewer: Viewer) -> None:
        # Rerun loads slowly: only the process that draws waits for it.
        from companion.view.blueprint import LIVE_TRAIL, run_blueprint
        from companion.view.scene import Scene
        from companion.view.window import Window

        self._window = Window(viewer, f"{config.site.name}, live")
        self._scene = Scene(config, drawing.names, self._window.stream, drawing.start_ns, ends=False)
        self._run_blueprint, self._trail = run_blueprint, LIVE_TRAIL
        self._plots: set[str] = set()

    def take(self, items: list[Item]) -> None:
        if not self._window.is_open:
            raise UserError("the viewer was closed")
        if not self._window.is_ready():
            return
        _show(self._scene, items)
        self._scene.send()
        plots = set(self._scene.layout().plots)
        if plots != self._plots:
            self._plots = plots
            blueprint = self._run_blueprint(self._scene.layout(), self._trail, False)
            self._window.stream.send_blueprint(blueprint)
        self._window.take()

    def close(self) -> None:
        self._window.close()


class _Files:
    """A live scene in `.rrd` files."""

    def __init__(self, config: Config, drawing: Drawing, path: Path) -> None:
        from companion.view.files import RerunFiles

        self._files = RerunFiles(config, drawing.names, path, drawing.start_ns)

    def take(self, items: list[Item]) -> None:
        _show(self._files, items)

    def close(self) -> None:
        self._files.close()


def _show(shown: "Scene | RerunFiles", items: list[Item]) -> None:
    truth: Truth | None = None
    for item in items:
        if isinstance(item, Tick):
            shown.tick(item, truth)
        elif isinstance(item, RawChunk):
            shown.chunk(item)
        elif isinstance(item, Line):
            shown.say(item)
        else:
            truth = item
