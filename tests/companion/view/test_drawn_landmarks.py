"""Landmarks of the EKF-SLAM are drawn where the room has them: at the corners of the column."""

from pathlib import Path

import numpy as np

from companion.log import Log
from companion.replay import config_of, replay
from companion.view.files import RerunFiles
from tests.companion.view.recordings import Recording, read

CORNERS = np.array([[3.7, 3.3], [4.3, 3.3], [4.3, 3.9], [3.7, 3.9]])


def shown(log: Log, path: Path, front_end: str) -> Recording:
    config = config_of(log, [f"pipeline.front_end={front_end}"])
    view = RerunFiles(config, ["ekf"], path, log.start_ns)
    replay(log, config, ["ekf"], view.tick, on_chunk=lambda _: None)
    view.close()
    return read(path)


def test_corners_are_drawn_where_they_are(short_log: Path, tmp_path: Path) -> None:
    landmarks = shown(Log(short_log), tmp_path / "run.rrd", "ekf_slam")["map/landmarks"]
    clouds = [np.array(rows) for rows in landmarks["Points2D:positions"] if rows]
    assert len(clouds) > 10
    nearest = np.linalg.norm(np.vstack(clouds)[:, None] - CORNERS, axis=2).min(axis=1)
    assert nearest.max() < 0.2


def test_a_matcher_has_no_landmarks(short_log: Path, tmp_path: Path) -> None:
    assert "map/landmarks" not in shown(Log(short_log), tmp_path / "run.rrd", "scan_matcher")
