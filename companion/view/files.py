"""A run as `.rrd` files: another one is begun when one is large enough or holds long enough."""

from collections.abc import Callable
from pathlib import Path
from uuid import uuid4

import rerun as rr

from companion.config import Config
from companion.errors import UserError
from companion.log import RawChunk, Truth
from companion.pipeline import Tick
from companion.view.blueprint import REVIEW_TRAIL, run_blueprint
from companion.view.line import Line
from companion.view.scene import Scene

APPLICATION = "companion"
BATCH = 600
"""Ticks that are drawn together."""


class RerunFiles:
    """Collects the ticks of a run and writes them as `.rrd` files that open arranged, each by itself.

    Args:
        config: of the site.
        names: estimators, the primary first: its pose, covariance and verdicts are shown; of the others,
            tracks and errors.
        path: first file; those after it are called NAME-2.rrd and so on.
        start_ns: of the run; times and frames count from here in all files.

    Raises:
        UserError: the file cannot be written.
    """

    def __init__(self, config: Config, names: list[str], path: Path, start_ns: int) -> None:
        self._config, self._names = config, names
        self._first, self._path, self._start_ns = path, path, start_ns
        self._count = 0
        self._begin_ns = start_ns
        self._open(path)

    def tick(self, tick: Tick, truth: Truth | None) -> None:
        """Take one tick; fits `on_tick` of `companion.replay.replay`.

        Args:
            tick: as the pipeline gives it.
            truth: newest true pose before it, None without truth.

        Raises:
            UserError: a file cannot be written, as on a full disk.
        """
        if self._is_full(tick.stamp_ns):
            self.close()
            self._begin_ns = tick.stamp_ns
            self._open(self._first.with_stem(f"{self._first.stem}-{self._count + 1}"))
        self._scene.tick(tick, truth)
        if self._scene.waiting >= BATCH:
            self._write(self._scene.send)

    def chunk(self, chunk: RawChunk) -> None:
        """Take bytes that crossed a port; fits `on_chunk` of `companion.replay.replay`."""
        self._scene.chunk(chunk)

    def say(self, line: Line) -> None:
        """Take a line for the text log."""
        self._scene.say(line)

    def close(self) -> None:
        """Write everything and finish the file.

        Raises:
            UserError: the file cannot be written, as on a full disk.
        """
        # After an error a stream waits for its broken writer for ever: it is left as it is.
        self._write(self._end)
        self._stream.disconnect()

    def _end(self) -> None:
        self._scene.close()
        self._stream.send_blueprint(run_blueprint(self._scene.layout(), REVIEW_TRAIL, compares=False))

    def _open(self, path: Path) -> None:
        self._path = path
        self._count += 1
        self._size = 0
        self._stream = rr.RecordingStream(APPLICATION, recording_id=uuid4())
        save(self._stream, path)
        part = f", part {self._count}" if self._count > 1 else ""
        self._stream.send_recording_name(f"{self._config.site.name}, {self._names[0]}{part}")
        self._scene = Scene(self._config, self._names, self._stream, self._start_ns)

    def _is_full(self, now_ns: int) -> bool:
        view = self._config.view
        return (
            now_ns - self._begin_ns
        ) * 1e-9 >= 60.0 * view.file_minutes or self._size >= 1e6 * view.file_mb

    def _write(self, write: Callable[[], None]) -> None:
        try:
            write()
            self._stream.flush()
            self._size = self._path.stat().st_size
        except (OSError, RuntimeError) as error:
            raise UserError(f"cannot write the view {self._path}: {error}") from error


def save(stream: rr.RecordingStream, path: Path) -> None:
    """Let a stream write to a file.

    Raises:
        UserError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("wb").close()
        stream.save(path)
    except (OSError, RuntimeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise UserError(f"cannot write the view {path}: {reason}") from error
