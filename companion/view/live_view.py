"""The scene of a run while it runs. Nothing here may make a pose late.

The loop of the run only puts ticks into a mailbox that forgets the oldest; a thread hands what is there to
a process of its own, which draws (`companion.view.drawing`). A viewer that stalls makes that process wait,
its pipe fill and the mailbox forget; a viewer that dies ends the view, never the run.
"""

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from time import sleep

from companion.config import Config
from companion.view.drawing import Drawing, Item, draw
from companion.view.viewer import Shown, check_viewer

PERIOD = 0.1
"""The mailbox is emptied so often [s]."""
MAILBOX = 600
"""Items that it holds: some 5 s of a run."""
CLOSING = 30.0
"""The drawing process has so long [s] to begin, if it has not yet, and to finish its files."""


class LiveView:
    """A run's mailbox, and the thread that empties it.

    Args:
        config: of the site.
        names: estimators, the primary first.
        start_ns: of the run.
        mode: "web", "native", or "off" to only write files.
        files: first `.rrd` file to write; None for none.
        say: takes one line for the operator.

    Raises:
        UserError: no screen for a window, or a port is in use.
    """

    def __init__(
        self,
        config: Config,
        names: list[str],
        start_ns: int,
        mode: Shown,
        files: Path | None,
        say: Callable[[str], None],
    ) -> None:
        if mode != "off":
            check_viewer(mode, config.view)
        self._say = say
        self._mailbox: deque[Item] = deque(maxlen=MAILBOX)
        self._closing = threading.Event()
        self._is_open = True
        spawning = multiprocessing.get_context("spawn")
        self._pipe, far_end = spawning.Pipe()
        drawing = Drawing(config.to_toml(), names, start_ns, mode, files)
        # Spawned: a fork would copy the ports and the threads of the run.
        self._process = spawning.Process(target=draw, args=(far_end, drawing), daemon=False)
        self._process.start()
        far_end.close()
        self._thread = threading.Thread(target=self._run, name="view", daemon=True)
        self._thread.start()

    @property
    def process_id(self) -> int:
        """Of the process that draws."""
        assert self._process.pid is not None
        return self._process.pid

    @property
    def waiting(self) -> int:
        """Items in the mailbox."""
        return len(self._mailbox)

    def put(self, item: Item) -> None:
        """Take something to be shown, or to be forgotten when the viewer is slow; never waits."""
        if self._is_open:
            self._mailbox.append(item)

    def close(self) -> None:
        """Let files be finished and end the view."""
        self._closing.set()
        self._thread.join(CLOSING)
        if not self._thread.is_alive():
            self._process.join(CLOSING)
        if self._process.is_alive():
            # It waits for a viewer that has stalled.
            with suppress(ProcessLookupError):
                os.killpg(self.process_id, signal.SIGKILL)
            self._process.kill()
        self._process.join()

    def _run(self) -> None:
        try:
            while not self._closing.is_set():
                sleep(PERIOD)
                self._hand_over()
            self._hand_over()
            self._pipe.send(None)
        except (OSError, EOFError):
            self._hear()
            self._say("view: ended; the run goes on without it")
        finally:
            self._is_open = False
            self._mailbox.clear()

    def _hand_over(self) -> None:
        items = []
        while self._mailbox:
            items.append(self._mailbox.popleft())
        self._hear()
        if items:
            self._pipe.send(items)

    def _hear(self) -> None:
        with suppress(OSError, EOFError):
            while self._pipe.poll():
                self._say(f"view: {self._pipe.recv()}")
