"""`companion smooth`: a simulated log as a whole, its anchors, and logs that cannot be smoothed."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from companion.cli import app
from companion.config import load_config
from companion.errors import UserError
from companion.log import Log
from companion.replay import config_of
from companion.smooth import SMOOTHED, anchors_toml, smooth_log
from tests.conftest import SITE


def test_smoothing_a_log_beats_the_filter_that_ran_live(short_log: Path, tmp_path: Path) -> None:
    ran = CliRunner().invoke(app, ["smooth", str(short_log), "--out", str(tmp_path)])
    assert ran.exit_code == 0, ran.output
    summary = json.loads((tmp_path / "summary.json").read_text())
    rmse = summary["rmse_m"]
    assert rmse[SMOOTHED] < rmse["ekf"]
    assert "known anchors hold the frame" in " ".join(ran.output.split())
    lines = (tmp_path / "poses.tum").read_text().splitlines()
    stamps = [float(line.split()[0]) for line in lines]
    assert stamps == sorted(stamps)
    assert (tmp_path / "smooth.png").stat().st_size > 20_000
    assert not (tmp_path / "anchors.toml").exists()


def test_a_survey_says_where_anchors_are_and_how_sure(short_log: Path, tmp_path: Path) -> None:
    options = ["--anchors", "--biases", "--out", str(tmp_path)]
    ran = CliRunner().invoke(app, ["smooth", str(short_log), *options])
    assert ran.exit_code == 0, ran.output
    pasted = tomllib.loads((tmp_path / "anchors.toml").read_text())["anchors"]
    site = load_config(SITE)
    assert list(map(int, pasted)) == list(site.anchors)
    summary = json.loads((tmp_path / "summary.json").read_text())
    for anchor_id, place in site.anchors.items():
        found = summary["anchors"][str(anchor_id)]
        assert pasted[str(anchor_id)][2] == place[2]
        np.testing.assert_allclose(pasted[str(anchor_id)][:2], found["position"], atol=6e-4)
        # What was found is as far off as it says that it may be: the walk is short, and its start uncertain.
        error = np.array(found["position"]) - place[:2]
        assert error @ np.linalg.solve(found["position_cov"], error) < 16.0
        assert found["bias"] == pytest.approx(0.0, abs=5 * found["bias_sigma"])
    assert "start mark (0.05 m, 2 deg) and anchors of the site file" in " ".join(ran.output.split())


def test_anchors_are_found_where_the_site_file_has_one_wrong(short_log: Path) -> None:
    sets = ["anchors.2=[7.35, 6.85, 2.3]"]  # half a metre off
    log = Log(short_log)
    config = config_of(log, sets)
    found = smooth_log(log, config, find_anchors=True, find_biases=False)
    assert found.moved[2][0] > 0.2
    assert "2 = [7." in anchors_toml(found)


def test_a_log_without_anything_to_smooth_is_one_line(short_log: Path) -> None:
    config = load_config(SITE)
    other = config.model_copy(update={"sensor": {"other": config.sensor["uwb"]}})
    with pytest.raises(UserError, match=r"no bytes of the site's sensors"):
        smooth_log(Log(short_log), other, find_anchors=False, find_biases=False)


def test_an_anchor_that_no_range_tells_is_one_line(short_log: Path) -> None:
    log = Log(short_log)
    config = config_of(log, ["anchors.9=[1.0, 2.0, 2.0]"])
    with pytest.raises(UserError, match="cannot be smoothed: anchor 9: no range determines it"):
        smooth_log(log, config, find_anchors=True, find_biases=False)
