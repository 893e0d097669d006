"""Scans of a real SICK TiM571 against the recording's own scan-to-map reference."""

from pathlib import Path

import numpy as np
import pytest

from estimators.geometry import between, compose, wrap_angles
from estimators.lidar.scan_matching import ScanMatcher
from estimators.messages import Scan

DATA = Path(__file__).parents[2] / "data" / "robotino_uwb"
BEAM_STEP = 0.005817
TURN = 1.0 / 15.0


def real_scans() -> list[Scan]:
    recorded = np.load(DATA / "scans.npz")
    beams = np.arange(recorded["ranges_mm"].shape[1])
    times = beams * BEAM_STEP / (2.0 * np.pi) * TURN
    return [
        Scan(int(stamp_ns), -2.3562 + BEAM_STEP * beams, row * 1e-3, times, np.zeros(len(beams)))
        for stamp_ns, row in zip(recorded["stamps_ns"], recorded["ranges_mm"].astype(np.float64), strict=True)
    ]


@pytest.mark.parametrize("every", [1, 3, 7, 15], ids=["15 Hz", "5 Hz", "2 Hz", "1 Hz"])
def test_real_scans_give_the_path_of_the_reference(every: int) -> None:
    scans = real_scans()[::every]
    matcher = ScanMatcher(ScanMatcher.Config(), np.array([-0.05, 0.0, 0.0]))
    pose, keyframe, stamps, track = np.zeros(3), np.zeros(3), [], []
    for scan in scans:
        increment = matcher.update(scan)
        assert increment is not None
        pose = compose(keyframe, increment.increment)
        if increment.is_keyframe:
            keyframe = pose
        stamps.append(increment.stamp_ns * 1e-9)
        track.append(pose)
    assert matcher.refused == 0

    reference = np.loadtxt(DATA / "reference.csv", delimiter=",")
    middle = scans[0].beam_times[-1] / 2.0
    columns = (reference[:, 1], reference[:, 2], np.unwrap(reference[:, 3]))
    expected = np.column_stack([np.interp(stamps, reference[:, 0] + middle, column) for column in columns])
    ours = np.array([compose(expected[0], between(track[0], pose)) for pose in track])
    # The last instants are beyond the reference.
    error = (ours - expected)[:-1]
    assert np.hypot(*np.ptp(expected[:, :2], axis=0)) > 1.0
    assert np.sqrt((error[:, :2] ** 2).sum(axis=1).mean()) < 0.03
    assert np.rad2deg(np.sqrt((wrap_angles(error[:, 2]) ** 2).mean())) < 1.0
