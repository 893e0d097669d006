"""The commands as a user types them: files out, one clear line and exit code 2 for bad input."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from companion import __version__
from companion.config import default_toml
from tests.conftest import SITE, Command, write_scenario

SITE_TEXT = SITE.read_text(encoding="utf-8")


def test_demo_leaves_everything_it_names(command: Command, tmp_path: Path) -> None:
    done = command("demo", write_scenario(tmp_path), "--out", "demo", "--seed", "2")
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "demo"
    written = {path.name for path in folder.iterdir()}
    assert {"raw.mcap", "poses.tum", "summary.json", "config.toml", "replay.rrd", "demo.png"} <= written
    assert (folder / "demo.png").read_bytes().startswith(b"\x89PNG")
    for name in ("ekf", "least_squares", "lidar_odometry"):
        assert name in done.stdout
    for column in ("RMSE", "max", "95 %", "yaw RMSE", "NEES", "update"):
        assert column in done.stdout
    assert "replay: repeats the poses sent to 0.000 mm" in done.stdout
    assert "covariance all positive definite" in done.stdout
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["version"] == __version__
    assert summary["estimators"]["ekf"]["accuracy"]["rmse"] < 0.1


def test_simulate_then_replay(command: Command, tmp_path: Path) -> None:
    scenario = write_scenario(tmp_path)
    for name in ("a", "b"):
        done = command("simulate", scenario, "--out", f"{name}.mcap", "--seed", "5")
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()

    names = ("--estimator", "least_squares", "--estimator", "ekf")
    done = command("replay", "a.mcap", *names, "--set", "pipeline.rate=10")
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "out" / "a-replay"
    assert json.loads((folder / "summary.json").read_text())["primary"] == "least_squares"
    assert "rate = 10" in (folder / "config.toml").read_text()
    assert (folder / "poses_ekf.tum").exists()
    assert (folder / "replay.rrd").stat().st_size > 10_000

    (tmp_path / "walk").mkdir()
    (tmp_path / "b.mcap").rename(tmp_path / "walk" / "raw.mcap")
    done = command("replay", "walk", *names, "--set", "pipeline.rate=10")
    assert done.returncode == 0, done.stderr
    again = tmp_path / "out" / "walk-replay" / "poses.tum"
    assert again.read_bytes() == (folder / "poses.tum").read_bytes()

    (tmp_path / "moved.toml").write_text(SITE_TEXT.replace("0.15, 6.85, 2.0", "0.15, 4.85, 2.0"))
    done = command("replay", "a.mcap", "--site", "moved.toml", "--out", "moved")
    assert done.returncode == 0, done.stderr
    accepted = [
        json.loads((path / "summary.json").read_text())["estimators"]["ekf"]["anchors"]["1"].get(
            "accepted", 0
        )
        for path in (folder, tmp_path / "moved")
    ]
    assert accepted[1] < 0.5 * accepted[0]


def test_replay_of_a_torn_log_says_so(command: Command, short_log: Path, tmp_path: Path) -> None:
    content = short_log.read_bytes()
    (tmp_path / "torn.mcap").write_bytes(content[: len(content) // 3])
    done = command("replay", "torn.mcap")
    assert done.returncode == 0
    assert "torn.mcap ends abruptly" in done.stderr


def test_dump_config(command: Command, tmp_path: Path) -> None:
    assert command("dump-config").stdout == default_toml()
    done = command("dump-config", "--site", "demo_room", "--set", "pipeline.rate=15")
    (tmp_path / "again.toml").write_text(done.stdout)
    assert command("dump-config", "--site", "again.toml").stdout == done.stdout
    assert "rate = 15.0" in done.stdout


def test_the_version_is_told(command: Command) -> None:
    assert command("--version").stdout.strip() == __version__


def test_a_fresh_interpreter_gives_the_exit_code_and_the_line_to_the_shell(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "companion", "replay", "gone.mcap"]
    environment = {**os.environ, "PYTHONPATH": os.getcwd()}
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, text=True, capture_output=True, timeout=100, check=False
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: cannot read gone.mcap: No such file or directory\n"


BAD_INPUT = {
    "missing log": (["replay", "gone.mcap"], "cannot read gone.mcap: No such file or directory"),
    "no MCAP": (["replay", "text.mcap"], "text.mcap is not an MCAP file"),
    "unknown estimator": (
        ["replay", "LOG", "--estimator", "magic"],
        "--estimator: unknown estimator 'magic', there are: ekf, ",
    ),
    "wrong set": (["replay", "LOG", "--set", "pipeline.rate=999"], "pipeline.rate: Input should be less"),
    "missing site": (["run", "--site", "gone.toml"], "cannot read gone.toml: No such file or directory"),
    "unknown site": (["run", "--site", "gone"], "no file gone and none of that name in params/sites"),
    "unknown site of a log": (["smooth", "LOG", "--site", "gone"], "no file gone and none of that name in"),
    "unknown site of a drive": (
        ["calibrate", "mounting", "LOG", "--site", "gone"],
        "no file gone and none of that name in",
    ),
    "wrong view": (["demo", "--view", "moon"], "--view: 'moon' is none of web, native, off"),
    "unknown key": (["run", "--site", "unknown.toml"], "unknown.toml: site.colour: unknown key"),
    "no TOML": (["run", "--site", "text.mcap"], "text.mcap is not valid TOML"),
    "two anchors": (["run", "--site", "two.toml"], "anchors: 2 anchors given, a position needs at least 3"),
    "anchors in line": (
        ["run", "--site", "line.toml"],
        "anchors: all 3 anchors lie within 0.00 m of one line",
    ),
    "wrong port": (
        ["run", "--site", "demo_room", "--set", "sensor.uwb.port=/dev/ttyUSB0?baud=fast"],
        "sensor.uwb.port: port '/dev/ttyUSB0?baud=fast': baud must be a number from 1200 to 4000000",
    ),
    "wrong link": (
        ["run", "--site", "demo_room", "--mavlink", "udpout:nonsense"],
        "mavlink.url: 'udpout:nonsense' is no device string",
    ),
    "link is a file": (
        ["run", "--site", "demo_room", "--mavlink", "text.mcap"],
        "'text.mcap' is no device string: it is a file",
    ),
    "odometry for EKF-SLAM": (
        [
            *("dump-config", "--site", "demo_room"),
            *("--set", "pipeline.front_end=ekf_slam", "--set", "mavlink.inputs.odometry=10"),
        ],
        "inputs.odometry and inputs.wheels need pipeline.front_end",
    ),
    "unknown scenario": (
        ["emulate", "moon"],
        "no file moon and none of that name in params/scenarios; there are: ",
    ),
    "folder without a log": (["replay", "."], "cannot read raw.mcap"),
    "unwritable log": (["simulate", "square_room", "--out", "text.mcap/log"], "cannot write the log"),
    "unwritable folder": (["demo", "--out", "text.mcap/demo"], "cannot write the log"),
    "set without site": (["dump-config", "--set", "a=1"], "--set: give --site too"),
}


@pytest.mark.parametrize("name", BAD_INPUT)
def test_bad_input_gives_one_line_and_exit_code_2(
    name: str, short_log: Path, tmp_path: Path, command: Command
) -> None:
    (tmp_path / "text.mcap").write_text("just text, no table\n")
    (tmp_path / "unknown.toml").write_text(SITE_TEXT.replace("[site]", '[site]\ncolour = "blue"'))
    third = "2 = [7.85, 6.85, 2.3]\n3 = [7.85, 0.15, 1.9]\n"
    assert third in SITE_TEXT
    (tmp_path / "two.toml").write_text(SITE_TEXT.replace(third, ""))
    (tmp_path / "line.toml").write_text(SITE_TEXT.replace(third, "2 = [0.15, 9.0, 2.3]\n"))
    arguments, said = BAD_INPUT[name]
    before = set(tmp_path.iterdir())
    done = command(*(str(short_log) if word == "LOG" else word for word in arguments))
    assert done.returncode == 2
    assert done.stdout == ""
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("error: ")
    assert set(tmp_path.iterdir()) == before


def test_help_loads_nothing_that_takes_long(tmp_path: Path) -> None:
    slow = "numpy", "scipy", "numba", "pydantic", "pymavlink", "matplotlib", "rerun"
    code = f"import sys, companion.cli; print([name for name in {slow} if name in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.getcwd()},
        text=True,
        capture_output=True,
        timeout=100,
        check=True,
    )
    assert done.stdout == "[]\n"
