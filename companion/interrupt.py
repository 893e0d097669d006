"""Ctrl-C and SIGTERM as an event that any thread may wait for, the main one too."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def set_by_signals() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set; a second one means what it did before, as it does outside.

    It is there before anything slow is loaded: what compiles or imports may swallow a KeyboardInterrupt.

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

    def hand_back(number: int, _: object) -> None:
        signal.signal(number, before[number])

    waiting = threading.Thread(target=wait, daemon=True)
    waiting.start()
    before = {int(number): signal.getsignal(number) for number in SIGNALS}
    for number in SIGNALS:
        signal.signal(number, hand_back)
    descriptor = signal.set_wakeup_fd(awake, warn_on_full_buffer=False)
    try:
        yield event
    finally:
        signal.set_wakeup_fd(descriptor)
        for number in SIGNALS:
            signal.signal(number, before[number])
        os.write(awake, b"\0")
        waiting.join()
        os.close(awake)
        os.close(ended)
