"""`companion review` as a user types it."""

from pathlib import Path

import pytest
from rerun.chunk import RrdReader

from tests.conftest import Command


def entities(path: Path) -> dict[str, list[float]]:
    """Entity -> seconds of its rows."""
    found: dict[str, list[float]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        times = chunk.to_record_batch().to_pydict().get("time", [])
        found.setdefault(chunk.entity_path, []).extend(time.total_seconds() for time in times)
    return found


def test_review_draws_the_named_part_with_estimators_side_by_side(
    command: Command, short_log: Path, tmp_path: Path
) -> None:
    names = "ekf,lidar_odometry"
    part = ("--from", "4", "--to", "7", "--save", "part.rrd")
    done = command("review", short_log, "--estimator", names, *part)
    assert done.returncode == 0, done.stderr
    assert "worst error" in done.stdout
    found = entities(tmp_path / "part.rrd")
    for name in names.split(","):
        seconds = found[f"/map/estimate/{name}/position"]
        assert 4.0 <= min(seconds) < 4.1
        assert 6.9 < max(seconds) <= 7.0


def test_two_logs_stand_side_by_side(command: Command, short_log: Path, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "raw.mcap").write_bytes(short_log.read_bytes())
    done = command("review", short_log, "run", "--to", "3", "--save", "both.rrd")
    assert done.returncode == 0, done.stderr
    found = entities(tmp_path / "both.rrd")
    for root in ("before", "after"):
        assert found[f"/{root}/map/estimate/ekf/position"]
    assert " ".join(done.stdout.split()).count("replayed and drawn") == 2


BAD_CALLS = {
    "three logs": (["LOG", "LOG", "LOG"], "3 logs given, at most 2 can be compared"),
    "empty part": (["LOG", "--from", "5", "--to", "4"], "--to 4: must be above --from 5"),
    "after the end": (["LOG", "--from", "900", "--save", "x.rrd"], "--from 900: "),
    "unknown estimator": (["LOG", "--estimator", "ekf,magic"], "--estimator: unknown estimator 'magic'"),
    "file and page": (["LOG", "--save", "x.rrd", "--web"], "--save and --web: a file is not served"),
    "no screen": (["LOG"], "this computer has no screen (DISPLAY is not set); use --web or --save FILE"),
    "no log": (["gone.mcap"], "cannot read gone.mcap: No such file or directory"),
}


def test_bad_calls_are_one_line_and_exit_code_2(
    command: Command, short_log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    for arguments, said in BAD_CALLS.values():
        words = [str(short_log) if word == "LOG" else word for word in arguments]
        done = command("review", *words)
        assert done.returncode == 2
        assert done.stderr.count("\n") == 1
        assert f"error: {said}" in done.stderr
