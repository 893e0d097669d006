"""What arrives while the estimators of a live run load is not lost, and is taken as it came."""

import os
import threading
import time
import tty
from pathlib import Path

import numpy as np
import pytest

from companion import live
from companion.config import Config, load_config
from companion.live import LiveRun
from companion.log import Direction, Log, RawChunk
from companion.pipeline import Pipeline, make_pipeline
from companion.replay import config_of, replay, tum_line
from tests.conftest import SITE

LOADING = 1.5
"""How long it takes [s]."""

pytestmark = pytest.mark.realtime


def loading_slowly(config: Config, names: list[str]) -> Pipeline:
    time.sleep(LOADING)
    return make_pipeline(config, names)


def test_ranges_that_come_while_estimators_load_count_from_then_on(
    tmp_path: Path, short_log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_pipeline(load_config(SITE, []), ["ekf"])  # so that loading takes what it takes here
    monkeypatch.setattr(live, "make_pipeline", loading_slowly)
    chunks = [r for r in Log(short_log) if isinstance(r, RawChunk) and r.source == "uwb"][:50]
    master, slave = os.openpty()
    tty.setraw(slave)
    port = f"sensor.uwb.port={os.ttyname(slave)}"
    folder, stop = tmp_path / "run", threading.Event()
    run = LiveRun(load_config(SITE, [port, 'mavlink.url=""']), folder, lambda _: None)
    thread = threading.Thread(target=run.run, args=(stop,))
    thread.start()
    begin = time.monotonic()
    for chunk in chunks:
        time.sleep(max(0.0, begin + 0.1 + (chunk.stamp_ns - chunks[0].stamp_ns) * 1e-9 - time.monotonic()))
        os.write(master, chunk.data)
    assert time.monotonic() - begin > LOADING
    time.sleep(0.3)
    stop.set()
    thread.join()
    os.close(master)
    os.close(slave)

    log = Log(folder / "raw.mcap")
    arrivals = [r.stamp_ns for r in log if isinstance(r, RawChunk) and r.data and r.direction is Direction.IN]
    assert len(arrivals) == len(chunks)
    # Each has the stamp of its arrival, not that of the moment when somebody had time for it.
    spans = np.array([chunk.stamp_ns for chunk in chunks])
    assert np.abs((np.array(arrivals) - arrivals[0]) - (spans - spans[0])).max() < 200_000_000
    assert run.status.stale_ticks == 0
    again = replay(log, config_of(log, []), ["ekf"])
    assert again.late == 0
    assert sum(again.verdicts["ekf"].values()) > 0
    assert (folder / "poses.tum").read_text() == "".join(tum_line(p) for p in again.poses["ekf"])


def test_what_fails_while_loading_closes_what_was_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(config: Config, names: list[str]) -> Pipeline:
        raise RuntimeError("no")

    monkeypatch.setattr(live, "make_pipeline", failing)
    threads = threading.active_count()
    run = LiveRun(load_config(SITE, ['mavlink.url=""']), tmp_path / "run", lambda _: None)
    with pytest.raises(RuntimeError, match="no"):
        run.run(threading.Event())
    assert threading.active_count() == threads
    assert Log(tmp_path / "run" / "raw.mcap").complete
