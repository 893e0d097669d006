"""Three tags of a real trolley by configuration and commands: imported, calibrated, position and heading."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from companion.calibrate_cli import app
from companion.calibration.recording import read_recording
from companion.calibration.reference import poses_from_truth, tags_from_truth
from companion.calibration.tags import carried_over, fit_tags
from companion.config import Config, load_config
from companion.errors import UserError
from companion.importers.sources import import_log
from companion.log import Log, RawChunk
from companion.log_trial import run_records
from companion.shipped_files import params_dir
from companion.smooth import SMOOTHED, smooth_log
from estimators.messages import RangeFrame
from estimators.models.range_bias import BearingBias
from tests.strategies import range_frame

DATA = Path(__file__).parents[2] / "data" / "lias_planar"
SITE = params_dir() / "sites" / "lias_planar_tags.toml"
RANGES, MOTION = "UWB_dynamic_exp_fast.csv", "motion_capture_dynamic_exp_fast.csv"
CALIBRATED = 30.0
EXACT_ANCHOR, EXACT_TAGS = 0.1, [0.05, -0.03, -0.02]
EXACT_PATTERNS = [BearingBias(0.02, -0.05), BearingBias(-0.01, 0.04), BearingBias(0.03, 0.0)]
ANCHORS = {1: np.array([0.0, 0.0, 2.0]), 2: np.array([6.0, 0.0, 2.0]), 3: np.array([0.0, 5.0, 2.0])}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The minute of the data set that we have, under the names of its authors."""
    folder = tmp_path_factory.mktemp("lias")
    _, *rows = (DATA / "uwb_three_tags.csv").read_text().splitlines()
    (folder / RANGES).write_text("\n".join(rows[:295]) + "\n")
    shutil.copy(DATA / "motion_capture.csv", folder / MOTION)
    return folder


def without_bearing(config: Config) -> Config:
    """The calibration with the constants of tags alone."""
    tags = {
        i: bias.model_copy(update={"cosine": 0.0, "sine": 0.0}) for i, bias in config.range_bias.tags.items()
    }
    return config.model_copy(update={"range_bias": config.range_bias.model_copy(update={"tags": tags})})


def test_a_user_gets_position_and_heading_of_three_tags_by_commands(folder: Path) -> None:
    log, site, found = folder / "lias.mcap", folder / "site.toml", folder / "found.json"
    assert import_log(folder, log, SITE) == 3 * 295
    shutil.copy(SITE, site)
    call = ["ranges", str(log), "--site", str(site), "--against", "truth", "--until", str(CALIBRATED)]
    done = CliRunner().invoke(app, [*call, "--picture", str(folder / "a.png"), "--json", str(found)])
    assert done.exit_code == 0, done.output
    assert "tag 0 beyond that" in done.output
    tags = json.loads(found.read_text())["tags"]
    assert sum(tag["bias_m"] for tag in tags.values()) == pytest.approx(0.0, abs=1e-9)
    assert "tag 2 by the bearing b of the anchor: cos 2b" in done.output
    config = load_config(site)
    for tag_id, stored in config.range_bias.tags.items():
        written = (stored.cosine, stored.cosine_sigma, stored.sine, stored.sine_sigma)
        names = ("cosine_m", "cosine_sigma_m", "sine_m", "sine_sigma_m")
        assert written == pytest.approx([tags[str(tag_id)][name] for name in names], abs=1e-4)
        assert np.hypot(stored.cosine, stored.sine) > 0.02
    assert config.tag_biases() == pytest.approx({int(i): tag["bias_m"] for i, tag in tags.items()}, abs=1e-4)
    start_ns = Log(log).start_ns
    known_ns = start_ns + round(CALIBRATED * 1e9)
    records = [r for r in Log(log) if isinstance(r, RawChunk) or r.stamp_ns > known_ns]
    before, level, after = (
        run_records(records, str(log), each, start_ns, ["ekf"])["ekf"]
        for each in (load_config(SITE), without_bearing(config), config)
    )
    assert before is not None
    assert level is not None
    assert after is not None
    assert after.rmse_m < 0.05 < before.rmse_m
    assert after.max_m < 0.25
    assert after.yaw_rmse_deg is not None
    assert level.yaw_rmse_deg is not None
    assert after.yaw_rmse_deg < 5.0 < level.yaw_rmse_deg
    smoothed = []
    for each in (without_bearing(config), config):
        accuracy = smooth_log(Log(log), each, find_anchors=False, find_biases=False).replay.accuracy(SMOOTHED)
        assert accuracy is not None
        assert accuracy.yaw_rmse_deg is not None
        smoothed.append(accuracy.yaw_rmse_deg)
    assert smoothed[1] < 0.9 * smoothed[0]


def write_exact(folder: Path, to: Path) -> None:
    """The drive with ranges that err by biases of anchors, of tags and by bearing, and by nothing else."""
    import_log(folder, folder / "measured.mcap", SITE)
    config = load_config(SITE)
    recording, setup = (
        read_recording(Log(folder / "measured.mcap"), config, None, with_odometry=False, every_tag=True),
        config.setup(),
    )
    poses = poses_from_truth(recording)
    tags = tags_from_truth(recording, poses, config)
    table = np.zeros((295, 8, 3))
    for k, (frame, pose, tag) in enumerate(zip(recording.range_frames, poses, tags, strict=True)):
        tag_id = frame.tag_id
        for i, anchor in setup.anchors.items():
            bias = (
                EXACT_ANCHOR
                + EXACT_TAGS[tag_id]
                + EXACT_PATTERNS[tag_id].at(pose, anchor, setup.arm(tag_id))[0]
            )
            table[k // 3, i, tag_id] = np.nan_to_num(np.linalg.norm(anchor - tag) + bias)
    times = (row.split(",")[0] for row in (folder / RANGES).read_text().splitlines())
    rows = [
        f"{time},{','.join(map(str, row))}" for time, row in zip(times, table.reshape(295, 24), strict=True)
    ]
    to.mkdir()
    (to / RANGES).write_text("\n".join(rows) + "\n")
    shutil.copy(folder / MOTION, to / MOTION)


def test_each_part_of_the_biases_is_found_where_ranges_have_nothing_else(
    folder: Path, tmp_path: Path
) -> None:
    write_exact(folder, tmp_path / "exact")
    log, site = tmp_path / "exact.mcap", tmp_path / "site.toml"
    import_log(tmp_path / "exact", log, SITE)
    shutil.copy(SITE, site)
    call = [
        "ranges",
        str(log),
        "--site",
        str(site),
        "--against",
        "truth",
        "--picture",
        str(tmp_path / "a.png"),
    ]
    assert CliRunner().invoke(app, call).exit_code == 0
    table = load_config(site).range_bias
    assert table.common == pytest.approx(EXACT_ANCHOR, abs=1e-3)
    assert all(abs(bias.constant) < 1e-3 for bias in table.anchors.values())
    for tag_id, bias in table.tags.items():
        true = (EXACT_TAGS[tag_id], EXACT_PATTERNS[tag_id].cosine, EXACT_PATTERNS[tag_id].sine)
        assert (bias.constant, bias.cosine, bias.sine) == pytest.approx(true, abs=1e-3)


def test_a_smoothed_log_has_the_heading_of_three_tags_too(folder: Path) -> None:
    import_log(folder, folder / "smooth.mcap", SITE)
    found = smooth_log(Log(folder / "smooth.mcap"), load_config(SITE), find_anchors=False, find_biases=True)
    accuracy = found.replay.accuracy(SMOOTHED)
    assert accuracy is not None
    assert accuracy.rmse < 0.06
    assert accuracy.yaw_rmse_deg is not None
    assert accuracy.yaw_rmse_deg < 8.0


def test_one_tag_alone_comes_without_a_heading(folder: Path) -> None:
    import_log(folder, folder / "one.mcap")
    config = load_config(params_dir() / "sites" / "lias_planar.toml")
    recording = read_recording(Log(folder / "one.mcap"), config, 5.0, with_odometry=False)
    assert {frame.tag_id for frame in recording.range_frames} == {0}
    assert np.isnan(recording.truths[0].pose[2])


def test_what_knows_one_tag_alone_leaves_the_others_out(folder: Path) -> None:
    import_log(folder, folder / "all.mcap", SITE)
    log, config = Log(folder / "all.mcap"), load_config(SITE)
    for every_tag, expected in ((True, {0, 1, 2}), (False, {0})):
        recording = read_recording(log, config, 5.0, with_odometry=False, every_tag=every_tag)
        assert {frame.tag_id for frame in recording.range_frames} == expected


def drive(biases: dict[int, float], seed: int) -> Iterator[tuple[RangeFrame, list[float]]]:
    """Ranges of tags that move through a room, and where each was."""
    rng = np.random.default_rng(seed)
    of_anchor = {1: 0.10, 2: 0.25, 3: -0.05}
    for k in range(200):
        for tag_id, bias in biases.items():
            tag = [2.0 + np.sin(0.03 * k + tag_id), 2.0 + np.cos(0.05 * k), 0.4]
            slants = [float(np.linalg.norm(a - tag)) + of_anchor[i] for i, a in ANCHORS.items()]
            noisy = (np.array(slants) + bias + 0.05 * rng.standard_normal(3)).tolist()
            yield replace(range_frame(k * 10**8, list(ANCHORS), noisy), tag_id=tag_id), tag


def test_what_a_tag_adds_to_every_anchor_is_found_as_well_as_claimed() -> None:
    true = {4: 0.06, 7: -0.04, 9: -0.02}
    squares = []
    for seed in range(20):
        frames, tags = zip(*drive(true, seed), strict=True)
        found = fit_tags(frames, np.array(tags), ANCHORS, 0)
        assert list(found) == list(true)
        squares += [((found[i].constant - bias) / found[i].sigma) ** 2 for i, bias in true.items()]
    assert 0.5 < np.mean(squares) < 2.0


@pytest.mark.parametrize("seen", [{4}, {4, 9}])
def test_tags_that_a_later_calibration_has_not_seen_keep_what_they_differ_by(seen: set[int]) -> None:
    # The anchors' biases hold the mean of the tags that were seen then.
    true = {4: 0.06, 7: -0.04, 9: 0.01}
    squares = []
    for seed in range(20):
        frames, tags = zip(*drive(true, seed), strict=True)
        kept = carried_over(fit_tags(frames, np.array(tags), ANCHORS, 0), seen)
        assert kept.keys() == true.keys() - seen
        held = np.mean([true[i] for i in seen])
        squares += [((bias.constant - (true[i] - held)) / bias.sigma) ** 2 for i, bias in kept.items()]
    assert 0.5 < np.mean(squares) < 2.0


def test_a_single_tag_has_no_part_of_its_own_and_tags_that_share_no_anchor_are_told() -> None:
    frames, tags = zip(*drive({4: 0.06}, 1), strict=True)
    assert fit_tags(frames, np.array(tags), ANCHORS, 0) == {}
    apart = [replace(f, tag_id=k % 2, anchor_ids=f.anchor_ids + 10 * (k % 2)) for k, f in enumerate(frames)]
    with pytest.raises(UserError, match="no anchor has enough ranges of all 2 tags"):
        fit_tags(apart, np.array(tags), ANCHORS | {i + 10: a for i, a in ANCHORS.items()}, 0)
