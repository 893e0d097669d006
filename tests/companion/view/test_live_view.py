"""A live view never makes its run wait, whatever becomes of the viewer."""

import os
import signal
import socket
import time
from pathlib import Path

import pytest
from rerun.chunk import RrdReader

from companion.config import Config, load_config
from companion.errors import UserError
from companion.health import Health, State
from companion.pipeline import Tick
from companion.view.drawing import Item
from companion.view.line import Line
from companion.view.live_view import MAILBOX, LiveView
from companion.view.viewer import check_viewer, free_port
from tests.conftest import SITE

PERIOD_NS = 33_333_333


def ticks(count: int) -> list[Item]:
    health = Health(State.STARTING, "no pose yet")
    return [Tick(k * PERIOD_NS, [], {"ekf": None}, health) for k in range(count)]


@pytest.fixture
def site() -> Config:
    return load_config(SITE, [f"view.web_port={free_port()}", f"view.data_port={free_port()}"])


def test_files_hold_what_was_put(site: Config, tmp_path: Path) -> None:
    said: list[str] = []
    view = LiveView(site, ["ekf"], 0, "off", tmp_path / "view.rrd", said.append)
    for item in [*ticks(30), Line(PERIOD_NS, "lidar: open")]:
        view.put(item)
    view.close()
    chunks = RrdReader(tmp_path / "view.rrd").stream().to_chunks()
    texts = [
        t for c in chunks if c.entity_path == "/log" for t in c.to_record_batch().to_pydict()["TextLog:text"]
    ]
    assert ["0.03 s  lidar: open"] in texts
    assert said == []


def test_the_mailbox_forgets_the_oldest_while_nobody_empties_it(site: Config, tmp_path: Path) -> None:
    view = LiveView(site, ["ekf"], 0, "off", tmp_path / "view.rrd", lambda _: None)
    os.kill(view.process_id, signal.SIGSTOP)
    try:
        for _ in range(20):
            for item in ticks(MAILBOX):
                view.put(item)
        assert view.waiting <= MAILBOX
    finally:
        os.kill(view.process_id, signal.SIGCONT)
        view.close()


def test_a_killed_drawing_process_ends_the_view_and_nothing_else(site: Config, tmp_path: Path) -> None:
    said: list[str] = []
    view = LiveView(site, ["ekf"], 0, "off", tmp_path / "view.rrd", said.append)
    os.kill(view.process_id, signal.SIGKILL)
    end = time.monotonic() + 20.0
    while not said and time.monotonic() < end:
        view.put(ticks(1)[0])
        time.sleep(0.02)
    assert said == ["view: ended; the run goes on without it"]
    view.put(ticks(1)[0])
    view.close()


def test_a_port_in_use_is_the_users_error(site: Config) -> None:
    check_viewer("web", site.view)
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", site.view.web_port))
        busy.listen()
        with pytest.raises(
            UserError, match=rf"view\.web_port: cannot listen at 127\.0\.0\.1:{site.view.web_port}"
        ):
            check_viewer("web", site.view)


def test_a_window_needs_a_screen(site: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(UserError, match="--view native: this computer has no screen"):
        check_viewer("native", site.view)
