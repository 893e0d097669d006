"""Rerun's own viewers draw our scene: the native one without a screen, the web one in a real browser."""

import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from companion.config import load_config
from companion.config_tables import ViewTable
from companion.log import Log
from companion.replay import config_of, replay
from companion.view.files import RerunFiles
from companion.view.viewer import Viewer, free_port
from estimators.messages import FloatArray
from tests.companion.view.browser import browser
from tests.conftest import SITE

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
XVFB = shutil.which("xvfb-run")
VULKAN = list(Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json"))
SKY, GREEN = (0x56, 0xB4, 0xE9), (0x00, 0x9E, 0x73)

PATIENCE = 60.0
"""A browser that has not drawn the scene after so long [s], on however busy a machine, will not."""

pytestmark = pytest.mark.viewer


@pytest.fixture(scope="module")
def recording(short_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("viewer") / "run.rrd"
    log = Log(short_log)
    config = config_of(log, [])
    view = RerunFiles(config, ["ekf"], path, log.start_ns)
    replay(log, config, ["ekf"], view.tick, on_chunk=view.chunk)
    view.close()
    return path


def share_of(picture: FloatArray, colour: tuple[int, int, int]) -> float:
    """Share of the pixels that have a colour."""
    near = np.abs(picture[:, :, :3] * 255.0 - np.array(colour)).max(axis=2) < 12.0
    return float(near.mean())


def has_map(picture: FloatArray) -> bool:
    """Whether there is the primary's track and a used range, in their colours."""
    left = picture[:, : picture.shape[1] * 3 // 5]
    return share_of(left, SKY) > 1e-4 and share_of(left, GREEN) > 1e-4


@pytest.mark.skipif(XVFB is None or not VULKAN, reason="needs xvfb and mesa-vulkan-drivers")
def test_the_native_viewer_draws_map_lanes_and_plots(recording: Path, tmp_path: Path) -> None:
    shot = tmp_path / "shot.png"
    command = [str(XVFB), "-a", "-s", "-screen 0 1600x1000x24", sys.executable, "-m", "rerun_cli"]
    command += ["--renderer=vulkan", "--bind", "127.0.0.1", "--port", "auto", "--window-size", "1600x1000"]
    subprocess.run([*command, "--screenshot-to", str(shot), str(recording)], check=True, timeout=90)
    picture = imread(shot)
    assert has_map(picture)
    # Every quarter of the column of plots holds coloured data: none of the four is empty.
    height, width = picture.shape[:2]
    right = picture[height // 12 : height * 11 // 12, width * 13 // 20 :, :3]
    shares = [(quarter.std(axis=2) > 0.08).mean() for quarter in np.array_split(right, 4)]
    assert min(shares) > 5e-4, shares


@pytest.fixture
def table() -> ViewTable:
    return load_config(SITE, [f"view.web_port={free_port()}", f"view.data_port={free_port()}"]).view


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_a_browser_draws_the_page(recording: Path, table: ViewTable, tmp_path: Path) -> None:
    viewer = Viewer("web", table, recording)
    try:
        viewer.wait_until_ready()
        shot = tmp_path / "page.png"
        with browser(str(CHROMIUM), tmp_path / "profile") as page:
            page.open(viewer.page)
            end = time.monotonic() + PATIENCE
            while True:
                page.picture(shot)
                if has_map(imread(shot)) or time.monotonic() > end:
                    break
                time.sleep(0.5)
    finally:
        viewer.kill()
    picture = imread(shot)
    assert has_map(picture)
    # Where the browser prefers a light page, too, which this one does.
    assert np.median(picture[:, :, :3]) < 0.3


def test_a_page_is_served_on_the_loopback_interface_alone(table: ViewTable) -> None:
    viewer = Viewer("web", table)
    try:
        viewer.wait_until_ready()
        listening = [
            line.split()[1].split(":")
            for name in ("/proc/net/tcp", "/proc/net/tcp6")
            for line in Path(name).read_text().splitlines()[1:]
            if line.split()[3] == "0A"
        ]
        ports = {f"{table.web_port:04X}", f"{table.data_port:04X}"}
        assert {address for address, port in listening if port in ports} == {"0100007F"}
    finally:
        viewer.kill()
    assert not viewer.is_running
