"""A short soak; `python -m tests.soak.faults` walks for an hour."""

from pathlib import Path

from tests.conftest import write_scenario
from tests.soak.faults import soak


def test_nothing_unsound_reaches_the_autopilot_whatever_the_sensors_do(tmp_path: Path) -> None:
    # Two walks: to the autopilot the second goes on where the first ended, with some 150 poses each.
    outcome = soak(minutes=0.3, seed=2, folder=tmp_path, base=write_scenario(tmp_path), pause=1.0)
    assert outcome.faults == []
    assert outcome.poses > 240
    assert outcome.losses >= 1
