"""Ctrl-C and SIGTERM as an event that any thread may wait for, the main one too."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def set_by_signals() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set; outside of it they mean what they did before.

    A handler in Python runs between two steps of the main thread. Where that thread waits for the event it
    may hold the event's own lock just then, and a handler that sets the event waits for it forever. So the
    signal is written to a pipe by the interpreter, and a thread that reads the pipe sets the event.
    """
    event = threading.Event()
    ended, awake = os.pipe()
    os.set_blocking(awake, False)

    def wait() -> None:
        os.read(ended, 1)
        event.set()

    waiting = threading.Thread(target=wait, daemon=True)
    waiting.start()
    before = {number: signal.signal(number, lambda *_: None) for number in SIGNALS}
    descriptor = signal.set_wakeup_fd(awake, warn_on_full_buffer=False)
    try:
        yield event
    finally:
        signal.set_wakeup_fd(descriptor)
        for number, handler in before.items():
            signal.signal(number, handler)
        os.write(awake, b"\0")
        waiting.join()
        os.close(awake)
        os.close(ended)
