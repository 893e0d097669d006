"""`companion calibrate` on logs: what is found, what the site file becomes, and what replay makes of it."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from companion.calibrate_cli import app
from companion.calibration.drive import calibrate_on_drive, mounting_on_drive
from companion.calibration.recording import Recording, read_recording
from companion.config import Config, load_config
from companion.config_tables import TagBiasTable
from companion.errors import UserError
from companion.log import Log, RawChunk, Truth
from companion.log_edit.edit import edit_log
from companion.log_edit.faults import parse_fault
from companion.pipeline import Chain, make_pipeline
from companion.sim.scenario import load_scenario
from estimators.messages import RangeFrame
from tests.conftest import SITE, write_log

DRIVE = (
    "[trajectory]\nwaypoints = [[1.5, 1.2], [4.0, 1.2], [4.0, 3.4], [1.8, 3.4]]\nlaps = 0\nrest = 1.0\n"
    "speed = 0.8\n[uwb]\nrate = 20\nsigma = 0.05\n[lidar]\nmodel = 'A1'\n"
)
BIASES = {0: 0.10, 1: 0.25, 2: 0.18, 3: 0.30}


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Log of a drive round a room without obstacles."""
    folder = tmp_path_factory.mktemp("drive")
    scenario = folder / "drive.toml"
    scenario.write_text(f'site = "{SITE}"\n{DRIVE}', encoding="utf-8")
    return write_log(load_scenario(scenario, 5, []), folder / "drive.mcap")


@pytest.fixture(scope="module")
def recording(log: Path) -> Recording:
    return read_recording(Log(log), load_config(SITE), None, with_odometry=True)


def changed(recording: Recording, delay_ns: int = 0) -> Recording:
    """The recording with biased and late ranges."""
    frames = [
        RangeFrame(
            frame.stamp_ns + delay_ns,
            frame.tag_id,
            frame.anchor_ids,
            frame.ranges + [BIASES[i] for i in frame.anchor_ids.tolist()],
            frame.rx_power,
            frame.fp_power,
        )
        for frame in recording.range_frames
    ]
    return Recording(recording.start_ns, frames, recording.increments, recording.truths)


def with_tag(config: Config, x: float, y: float) -> Config:
    body = config.body.model_copy(update={"tag": (x, y, config.body.tag[2])})
    return config.model_copy(update={"body": body})


def test_biases_are_found_against_the_lidar_within_their_sigmas(recording: Recording) -> None:
    found = calibrate_on_drive(changed(recording), load_config(SITE))
    for anchor_id, bias in BIASES.items():
        fit = found.anchors[anchor_id]
        assert abs(fit.bias.constant - bias) < 4.0 * fit.constant_sigma
        assert fit.constant_sigma < 0.02
    assert abs(found.common - np.mean(list(BIASES.values()))) < 4.0 * found.common_sigma


def test_place_and_delay_of_the_tag_are_found_within_their_sigmas(recording: Recording) -> None:
    config = load_config(SITE)
    x, y, _ = config.body.tag
    found = mounting_on_drive(changed(recording, delay_ns=80_000_000), with_tag(config, x + 0.2, y - 0.1))
    assert found.arm_sigma[0] < 0.02
    assert abs(found.arm[0] - x) < 4.0 * found.arm_sigma[0]
    assert abs(found.arm[1] - y) < 4.0 * found.arm_sigma[1]
    assert found.delay_sigma < 0.03
    assert abs(found.delay - 0.08) < 4.0 * found.delay_sigma


def test_without_odometry_there_is_no_calibration_on_a_drive(recording: Recording) -> None:
    blind = Recording(recording.start_ns, recording.range_frames, [], [])
    with pytest.raises(UserError, match="no LiDAR odometry"):
        calibrate_on_drive(blind, load_config(SITE))


def invoke(*args: str) -> str:
    result = CliRunner().invoke(app, list(args))
    assert result.exception is None, result.exception
    return result.output


def test_the_site_file_keeps_its_comments_and_takes_the_biases(log: Path, tmp_path: Path) -> None:
    site, figures = tmp_path / "site.toml", tmp_path / "figures.json"
    original = SITE.read_text(encoding="utf-8")
    site.write_text(original, encoding="utf-8")
    options = ["--site", str(site), "--against", "truth", "--picture", str(tmp_path / "p.png")]
    invoke("ranges", str(log), *options, "--json", str(figures))
    text = site.read_text(encoding="utf-8")
    assert text.startswith(original.rstrip("\n"))
    assert (tmp_path / "p.png").stat().st_size > 10_000
    stored, told = load_config(site), json.loads(figures.read_text(encoding="utf-8"))
    for anchor_id, bias in stored.range_biases().items():
        assert bias.constant == pytest.approx(told["anchors"][str(anchor_id)]["bias_m"], abs=2e-4)
        assert abs(bias.constant) < 0.03
    assert stored.range_bias.common_sigma > 0.0
    # Simulated ranges have no bias by bearing, so the single tag gets no row.
    assert not stored.range_bias.tags
    # A second calibration replaces the first, and what another drive said of the tag. Of a tag that it has
    # not seen there stays what it differs by.
    tag_id = read_recording(Log(log), stored, 1.0, with_odometry=False).range_frames[0].tag_id
    with site.open("a", encoding="utf-8") as file:
        file.write(f"[range_bias.tags]\n{tag_id} = {{ constant = 0.1, cosine = 0.05 }}\n")
        file.write("77 = { constant = 0.3, constant_sigma = 0.01, cosine = 0.02 }\n")
    invoke("ranges", str(log), *options, "--until", "5")
    assert site.read_text(encoding="utf-8").count("common_sigma") == 1
    again = load_config(site).range_bias
    assert again.common != stored.range_bias.common
    other = TagBiasTable(constant=0.2, constant_sigma=0.01, cosine=0.02)
    assert again.tags == {tag_id: TagBiasTable(), 77: other}


def test_a_hidden_anchor_lets_nothing_be_written_that_was_found_against_the_lidar(
    log: Path, tmp_path: Path
) -> None:
    opened, site = Log(log), tmp_path / "site.toml"
    config = load_config(SITE)
    blocked = [parse_fault("nlos:anchor=1,at=3,for=9,least=0.4,mean=0.6", config)]
    edit_log(opened, config, blocked, 1, tmp_path / "hidden.mcap")
    site.write_text(SITE.read_text(encoding="utf-8"), encoding="utf-8")
    options = ["--site", str(site), "--until", "14", "--picture", str(tmp_path / "p.png")]
    result = CliRunner().invoke(app, ["ranges", str(tmp_path / "hidden.mcap"), *options])
    assert result.exit_code == 1
    assert "anchor 1: its errors scatter too much" in result.output
    assert "nothing written" in result.output
    assert site.read_text(encoding="utf-8") == SITE.read_text(encoding="utf-8")
    # Known positions do not depend on any anchor: there the others' biases are as good as ever.
    against_truth = CliRunner().invoke(
        app, ["ranges", str(tmp_path / "hidden.mcap"), "--against", "truth", *options]
    )
    assert against_truth.exit_code == 0
    assert load_config(site).range_biases()[2].constant == pytest.approx(0.0, abs=0.03)


def test_surveyed_points_tell_the_biases_too(log: Path, recording: Recording, tmp_path: Path) -> None:
    config = load_config(SITE)
    first, last = recording.truths[0], recording.truths[-1]
    rows = ["begin,end,x,y,z"]
    for truth, begin, end in ((first, 0.0, 0.8), (last, 0.0, 0.0)):
        if truth is last:
            end = (last.stamp_ns - recording.start_ns) * 1e-9
            begin = end - 0.8
        x, y = tag_of(truth, config)
        rows.append(f"{begin},{end},{x},{y},{config.body.height + config.body.tag[2]}")
    points, site = tmp_path / "points.csv", tmp_path / "site.toml"
    points.write_text("\n".join(rows) + "\n", encoding="utf-8")
    out = invoke(
        *("ranges", str(log), "--site", str(SITE), "--against", str(points)),
        *("--out", str(site), "--picture", str(tmp_path / "p.png")),
    )
    assert "common bias" in out
    assert all(abs(bias.constant) < 0.1 for bias in load_config(site).range_biases().values())


def tag_of(truth: Truth, config: Config) -> tuple[float, float]:
    x, y, yaw = truth.pose
    arm = config.body.tag
    return x + np.cos(yaw) * arm[0] - np.sin(yaw) * arm[1], y + np.sin(yaw) * arm[0] + np.cos(yaw) * arm[1]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("x,y\n", "the first line must be begin,end,x,y,z"),
        ("begin,end,x,y,z\n1,2,three,4,5\n", "line 2: could not convert"),
        ("begin,end,x,y,z\n2,1,3,4,5\n", "begin before end"),
        ("begin,end,x,y,z\n9000,9001,3,4,5\n", "no range was measured"),
    ],
)
def test_wrong_point_files_are_named(log: Path, tmp_path: Path, text: str, reason: str) -> None:
    points = tmp_path / "points.csv"
    points.write_text(text, encoding="utf-8")
    result = CliRunner().invoke(app, ["ranges", str(log), "--site", str(SITE), "--against", str(points)])
    assert isinstance(result.exception, UserError)
    assert str(points) in str(result.exception)
    assert reason in str(result.exception)


def first_ranges(log: Path, config: Config) -> list[float]:
    """Ranges of the first two seconds as the estimators get them."""
    opened = Log(log)
    chain = Chain(config, opened.start_ns, make_pipeline(config, ["least_squares"]), "least_squares")
    found: list[float] = []
    for record in opened:
        if record.stamp_ns > opened.start_ns + 2 * 10**9:
            break
        if isinstance(record, RawChunk):
            for tick in chain.feed(record):
                for outcome in tick.outcomes:
                    if isinstance(outcome.measurement, RangeFrame):
                        found += outcome.measurement.ranges.tolist()
    return found


def test_the_chain_takes_the_bias_off_and_a_calibration_sees_the_ranges_as_measured(log: Path) -> None:
    plain, told = load_config(SITE), load_config(SITE, ["range_bias.common=0.5"])
    np.testing.assert_allclose(np.array(first_ranges(log, plain)) - 0.5, first_ranges(log, told), atol=1e-12)
    frames = [
        read_recording(Log(log), config, 2.0, with_odometry=False).range_frames[0] for config in (plain, told)
    ]
    np.testing.assert_array_equal(frames[0].ranges, frames[1].ranges)
