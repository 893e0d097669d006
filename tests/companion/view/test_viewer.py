"""Rerun's own viewers draw our scene: the native one without a screen, the web one in a real browser."""

import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from companion.config import load_config
from companion.log import Log
from companion.replay import config_of, replay
from companion.view.files import RerunFiles
from companion.view.viewer import Viewer, free_port
from estimators.messages import FloatArray
from tests.conftest import SITE

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
XVFB = shutil.which("xvfb-run")
VULKAN = list(Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json"))
SKY, GREEN, VERMILION = (0x56, 0xB4, 0xE9), (0x00, 0x9E, 0x73), (0xD5, 0x5E, 0x00)

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


def check_picture(path: Path) -> None:
    picture = imread(path)
    height, width = picture.shape[:2]
    left, right = picture[:, : width // 2], picture[:, width * 3 // 5 :]
    # The map: the track, good ranges, refused ones; the lanes below it.
    assert share_of(left, SKY) > 1e-4
    assert share_of(left, GREEN) > 1e-3
    # Every quarter of the column of plots holds data: none of the four is empty.
    for k in range(4):
        rows = right[height * (k + 1) // 6 + height // 24 : height * (k + 2) // 6 + height // 12]
        assert (rows[:, :, :3].std(axis=2) > 0.08).mean() > 1e-4, f"plot {k} is empty"


@pytest.mark.skipif(XVFB is None or not VULKAN, reason="needs xvfb and mesa-vulkan-drivers")
def test_the_native_viewer_draws_map_lanes_and_plots(recording: Path, tmp_path: Path) -> None:
    shot = tmp_path / "shot.png"
    command = [str(XVFB), "-a", "-s", "-screen 0 1600x1000x24", sys.executable, "-m", "rerun_cli"]
    command += ["--renderer=vulkan", "--bind", "127.0.0.1", "--port", "auto", "--window-size", "1600x1000"]
    subprocess.run([*command, "--screenshot-to", str(shot), str(recording)], check=True, timeout=90)
    check_picture(shot)


@pytest.fixture
def served(recording: Path) -> Iterator[str]:
    """Address of a page that shows the recording."""
    web_port, data_port = free_port(), free_port()
    command = [sys.executable, "-m", "rerun_cli", "--serve-web", "--bind", "127.0.0.1"]
    command += ["--web-viewer-port", str(web_port), "--port", str(data_port), str(recording)]
    server = subprocess.Popen(command, start_new_session=True)
    time.sleep(2.0)
    yield f"http://127.0.0.1:{web_port}/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{data_port}%2Fproxy"
    subprocess.run(["kill", "-KILL", "--", f"-{server.pid}"], check=True)
    server.wait()


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_a_browser_draws_the_page(served: str, tmp_path: Path) -> None:
    shot = tmp_path / "page.png"
    command = [str(CHROMIUM), "--headless", "--no-sandbox", "--use-angle=swiftshader"]
    command += ["--enable-unsafe-swiftshader", "--window-size=1600,1000", "--virtual-time-budget=40000"]
    command += [f"--user-data-dir={tmp_path / 'profile'}", f"--screenshot={shot}", served]
    subprocess.run(command, check=True, timeout=120, capture_output=True)
    check_picture(shot)


def test_a_page_is_served_on_the_loopback_interface_alone() -> None:
    sets = [f"view.web_port={free_port()}", f"view.data_port={free_port()}"]
    viewer = Viewer("web", load_config(SITE, sets).view)
    try:
        viewer.wait_until_ready()
        listening = [
            line.split()[1]
            for table in ("/proc/net/tcp", "/proc/net/tcp6")
            for line in Path(table).read_text().splitlines()[1:]
            if line.split()[3] == "0A"
        ]
        ports = {f"{int(text.partition('=')[2]):04X}" for text in sets}
        addresses = {entry.partition(":")[0] for entry in listening if entry.partition(":")[2] in ports}
        assert addresses == {"0100007F"}
    finally:
        viewer.kill()
    assert not viewer.is_running
