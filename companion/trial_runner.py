"""Trials spread over processes of this machine or over a Dask cluster; what is done survives an interrupt."""

import multiprocessing
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from typing import TypeVar

from companion.errors import UserError

R = TypeVar("R")
CONNECT_TIMEOUT = 10.0
"""A scheduler that does not answer for so long [s] is not there."""


def run_trials(
    trial: Callable[[int], R],
    seeds: Sequence[int],
    workers: int = 1,
    scheduler: str | None = None,
    on_trial: Callable[[], None] = lambda: None,
) -> dict[int, R]:
    """Run a trial for every seed; an interrupt (Ctrl-C) ends it and keeps what is done.

    Args:
        trial: to run; it and what it gives must pickle.
        seeds: its argument.
        workers: processes of this machine; 1 runs the trials here.
        scheduler: address of a Dask scheduler, instead of processes here. Its workers need this program and
            the same files.
        on_trial: called after each.

    Returns:
        Result by seed, in the order of the seeds.

    Raises:
        UserError: no scheduler at this address, or the extra `cluster` is missing.
    """
    done: dict[int, R] = {}
    if scheduler is None and workers == 1:
        try:
            for seed in seeds:
                done[seed] = trial(seed)
                on_trial()
        except KeyboardInterrupt:
            pass
        return done
    with _executor(min(workers, len(seeds)), scheduler) as executor:
        futures: dict[Future[R], int] = {executor.submit(trial, seed): seed for seed in seeds}
        try:
            for _ in _results(futures):
                on_trial()
        except KeyboardInterrupt:
            _stop(futures)
        for future, seed in futures.items():
            if future.done() and not future.cancelled() and future.exception() is None:
                done[seed] = future.result()
    return done


def _results(futures: Iterable[Future[R]]) -> Iterator[R]:
    """Results as they come; a trial that fails ends all."""
    try:
        for future in as_completed(futures):
            yield future.result()
    except Exception:
        _stop(futures)
        raise


def _stop(futures: Iterable[Future[R]]) -> None:
    """End trials at once: the processes here (whose pool then gives up what waits), or a cluster's queue."""
    workers = multiprocessing.active_children()
    for worker in workers:
        worker.terminate()
    if not workers:
        for future in futures:
            future.cancel()


@contextmanager
def _executor(workers: int, scheduler: str | None) -> Iterator[Executor]:
    if scheduler is None:
        # Spawned, not forked: this process has threads, of the progress display for one. Ctrl-C reaches the
        # whole process group; only this process is to act on it.
        with ProcessPoolExecutor(
            workers, multiprocessing.get_context("spawn"), signal.signal, (signal.SIGINT, signal.SIG_IGN)
        ) as pool:
            yield pool
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise UserError("--scheduler needs distributed: pip install companion[cluster]") from error
    try:
        client = Client(scheduler, timeout=CONNECT_TIMEOUT)
    except (OSError, ValueError) as error:
        raise UserError(f"--scheduler {scheduler}: no Dask scheduler there: {error}") from error
    with client, client.get_executor(pure=False) as executor:
        yield executor
