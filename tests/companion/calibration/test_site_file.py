"""A calibration finds its place in a site file, however the table is written there."""

from pathlib import Path

import numpy as np
import pytest

from companion.calibration.ranges import AnchorFit, Calibration, Ranges
from companion.calibration.site_file import write_range_bias
from companion.config import load_config
from estimators.models.range_bias import RangeBias
from tests.conftest import SITE

SITE_TEXT = SITE.read_text(encoding="utf-8")
NO_RANGES = Ranges(np.empty(0), np.empty(0), np.empty(0))
FIT = AnchorFit(RangeBias(0.5, 0.01, 4.0), 0.02, 0.001, 0.1, np.ones(0, dtype=bool), NO_RANGES)
WRITTEN = {
    "none": SITE_TEXT,
    "table": f"{SITE_TEXT}\n[range_bias]\ncommon = 0.1\n[range_bias.anchors]\n3 = {{ constant = 0.25 }}\n",
    "one line": f"range_bias = {{ common = 0.1, anchors = {{ 3 = {{ constant = 0.25 }} }} }}\n{SITE_TEXT}",
    "anchors in one line": f"{SITE_TEXT}\n[range_bias]\nanchors = {{ 3 = {{ constant = 0.25 }} }}\n",
    "in two places": f"[range_bias]\ncommon = 0.1\n{SITE_TEXT}\n[range_bias.anchors.3]\nconstant = 0.25\n",
    "dotted": f"range_bias.common = 0.1\nrange_bias.anchors.3.constant = 0.25\n{SITE_TEXT}",
}


@pytest.mark.parametrize("written", WRITTEN)
def test_what_was_found_is_written_and_what_was_not_is_kept(written: str, tmp_path: Path) -> None:
    site = tmp_path / "site.toml"
    site.write_text(WRITTEN[written], encoding="utf-8")
    before = load_config(site)
    write_range_bias(site, Calibration(0.3, 0.015, {0: FIT}), {}, {}, site)
    after = load_config(site)
    assert (after.range_bias.common, after.range_bias.common_sigma) == (0.3, 0.015)
    assert after.range_bias.anchors[0].constant == pytest.approx(0.2)
    assert after.range_bias.anchors.get(3) == before.range_bias.anchors.get(3)
    assert after.model_copy(update={"range_bias": before.range_bias}) == before
    comments = [line for line in SITE_TEXT.splitlines() if line.startswith("#")]
    assert comments
    assert set(comments) <= set(site.read_text(encoding="utf-8").splitlines())
