"""Ctrl-C as an event: it ends what waits for it, whenever it comes, and leaves nothing behind."""

import os
import signal
import subprocess
import sys
import textwrap
import threading

import pytest

from companion.interrupt import set_by_signals


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_sets_the_event_and_the_next_means_what_it_did_before(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    open_files = len(os.listdir("/proc/self/fd"))
    threads = threading.active_count()
    with set_by_signals() as stop:
        assert not stop.is_set()
        signal.raise_signal(number)
        assert stop.wait(5.0)
        assert signal.getsignal(number) == before
    assert signal.getsignal(number) == before
    assert len(os.listdir("/proc/self/fd")) == open_files
    assert threading.active_count() == threads


def test_the_main_thread_may_wait_for_it_at_any_pace() -> None:
    # The signal finds the main thread at every step of its wait, also while it holds the event's lock.
    program = """
        import os, signal, threading, time
        from companion.interrupt import set_by_signals

        for turn in range(60):
            with set_by_signals() as stop:
                threading.Timer(0.003, os.kill, (os.getpid(), signal.SIGINT)).start()
                while not stop.wait(1e-6):
                    pass
        print("ended")
    """
    command = [sys.executable, "-c", textwrap.dedent(program)]
    assert subprocess.run(command, capture_output=True, text=True, timeout=60).stdout == "ended\n"
