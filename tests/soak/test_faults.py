"""A short soak; `python -m tests.soak.faults` walks for an hour."""

from pathlib import Path

from tests.conftest import write_scenario
from tests.soak.faults import soak


def test_nothing_unsound_reaches_the_autopilot_whatever_the_sensors_do(tmp_path: Path) -> None:
    outcome = soak(minutes=0.2, seed=2, folder=tmp_path, base=write_scenario(tmp_path), pause=1.0)
    assert outcome.faults == []
    assert outcome.poses > 60
    assert outcome.losses >= 1
