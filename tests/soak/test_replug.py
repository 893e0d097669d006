"""A short soak; `python tests/soak/replug.py` runs a long one."""

from pathlib import Path

import pytest

from tests.soak.replug import RECOVERY, soak


@pytest.mark.realtime
def test_pulled_plugs_are_taken_up_again_and_leave_nothing_behind(tmp_path: Path) -> None:
    outcome = soak(cycles=3, seed=1, folder=tmp_path)
    assert outcome.faults == []
    assert len(outcome.recoveries) >= 3
    assert max(outcome.recoveries) <= RECOVERY
