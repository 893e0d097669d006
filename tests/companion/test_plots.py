"""The picture of a replay, from poses made up along a circle."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from companion.config import Config
from companion.errors import UserError
from companion.evaluate import Reference, compare
from companion.log import Truth
from companion.plots import figure
from companion.replay import Replay
from estimators.geometry import lift
from estimators.messages import FloatArray, PoseEstimate

BOX = np.array([[3.7, 3.3, 4.3, 3.3], [4.3, 3.3, 4.3, 3.9], [4.3, 3.9, 3.7, 3.9], [3.7, 3.9, 3.7, 3.3]])


def estimates(sigma: float, seed: int, yaw_variance: float = 1e-3) -> list[PoseEstimate]:
    rng = np.random.default_rng(seed)
    cov = np.diag([sigma**2, sigma**2, 1e-2, 1e-2, 1e-2, yaw_variance])
    poses = on_circle() + rng.standard_normal((200, 3)) * [sigma, sigma, 0.03]
    return [PoseEstimate(round(i * 1e8), lift(pose, 0.0), cov, 0) for i, pose in enumerate(poses)]


def on_circle() -> FloatArray:
    angle = np.linspace(0.0, 6.0, 200)
    return np.column_stack([4.0 + 2.0 * np.cos(angle), 3.5 + 2.0 * np.sin(angle), angle + np.pi / 2])


def made_up(config: Config, poses: dict[str, list[PoseEstimate]], yaw_known: bool = True) -> Replay:
    truths = [
        Truth(round(i * 1e8), pose if yaw_known else np.array([*pose[:2], np.nan]))
        for i, pose in enumerate(on_circle())
    ]
    errors = {name: compare(track, Reference(truths), 200) for name, track in poses.items()}
    return Replay(config, list(poses), poses, errors)


def drawn(result: Replay, folder: Path, obstacles: FloatArray | None = BOX) -> FloatArray:
    """The picture's pixels (855, 1500, 3), 0 black to 1 white."""
    path = folder / "new folder" / "picture.png"
    figure(result, path, "a title", obstacles)
    pixels = np.asarray(imread(path), dtype=np.float64)[:, :, :3]
    assert pixels.shape == (855, 1500, 3)
    assert pixels.std() > 0.05
    return pixels


def has_colour(pixels: FloatArray, rgb: tuple[int, int, int]) -> bool:
    near = np.abs(pixels - np.array(rgb) / 255.0).max(axis=2) < 0.15
    return int(near.sum()) > 100


BLUE, PURPLE = (0, 114, 178), (204, 121, 167)


def test_map_at_the_left_and_errors_at_the_right(config: Config, tmp_path: Path) -> None:
    result = made_up(config, {"ekf": estimates(0.03, 1), "least_squares": estimates(0.3, 2, np.inf)})
    pixels = drawn(result, tmp_path)
    for half in (pixels[:, :750], pixels[:, 750:]):
        assert has_colour(half, BLUE)
        assert has_colour(half, PURPLE)


def test_without_truth_there_is_only_the_map(config: Config, tmp_path: Path) -> None:
    result = made_up(config, {"ekf": estimates(0.03, 1)})
    result.errors = {}
    pixels = drawn(result, tmp_path, None)
    assert has_colour(pixels[:, 400:1100], BLUE)
    assert np.all(pixels[100:700, 1250:] == 1.0)


def test_without_heading_its_panel_gives_room_to_the_others(config: Config, tmp_path: Path) -> None:
    with_heading = drawn(made_up(config, {"ekf": estimates(0.03, 1)}), tmp_path)
    without = drawn(made_up(config, {"ekf": estimates(0.03, 1)}, yaw_known=False), tmp_path)
    assert axis_lines(with_heading) == 3
    assert axis_lines(without) == 2


def axis_lines(pixels: FloatArray) -> int:
    """Number of x axes in the right half."""
    dark = (pixels[:, 850:1450].max(axis=2) < 0.3).mean(axis=1) > 0.95
    return int(np.diff(dark.astype(np.int64), prepend=0).clip(min=0).sum())


def test_lost_and_nan_poses_do_not_matter(config: Config, tmp_path: Path) -> None:
    poses = estimates(0.03, 1)
    nan = np.full((6, 6), np.nan)
    poses[50:60] = [PoseEstimate(p.stamp_ns, nan[:4, :4], nan, 0) for p in poses[50:60]]
    del poses[100:120]
    assert has_colour(drawn(made_up(config, {"ekf": poses, "least_squares": []}), tmp_path), BLUE)


def test_no_pose_at_all_still_gives_a_picture(config: Config, tmp_path: Path) -> None:
    drawn(made_up(config, {"ekf": []}), tmp_path)


def test_a_file_that_cannot_be_written_is_the_users_error(config: Config, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    result = made_up(config, {"ekf": estimates(0.03, 1)})
    with pytest.raises(UserError, match=r"cannot write the picture .*a\.png: File exists"):
        figure(result, tmp_path / "file" / "a.png", "a title", None)
