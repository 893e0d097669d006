"""The whole chain where the LiDAR does not know how far along it is, or nothing at all."""

from pathlib import Path

import numpy as np
import pytest

from companion.evaluate import Reference, compare
from companion.log import Truth
from companion.pipeline import Chain, make_pipeline
from companion.shipped_files import params_dir
from companion.sim.scenario import load_scenario
from companion.sim.simulate import START_NS, converse
from estimators.messages import PoseIncrement

CORRIDOR = ("corridor", [16.0, 1.2], [22.0, 1.2], 6.0)
"""Its middle: two bare walls, seen 6 m far."""
HALL = ("hall", [18.0, 10.0], [22.0, 15.0], 12.0)
"""From one wall to where nothing is within the 12 m that the scanner sees."""


@pytest.mark.parametrize(("site", "begin", "end", "reach"), [CORRIDOR, HALL], ids=["corridor", "hall"])
def test_the_fused_pose_stays_within_three_sigma(
    site: str, begin: list[float], end: list[float], reach: float, tmp_path: Path
) -> None:
    path = tmp_path / "walk.toml"
    path.write_text(
        f'site = "{params_dir() / "sites" / site}.toml"\n'
        f"[trajectory]\nwaypoints = [{begin}, {end}]\nlaps = 0\nspeed = 1.0\nrest = 0.5\n"
        f"[lidar]\nmax_range = {reach}\n",
        encoding="utf-8",
    )
    heading = np.rad2deg(np.arctan2(end[1] - begin[1], end[0] - begin[0]))
    sets = [f"start.x={begin[0]}", f"start.y={begin[1]}", f"start.yaw_deg={heading}"]
    scenario = load_scenario(path, 1, sets)
    chain = Chain(scenario.config, START_NS, make_pipeline(scenario.config, ["ekf"]), "ekf")
    truths, poses, widest, narrowest = [], [], 0.0, np.inf
    for item in converse(scenario, chain.sensors):
        if isinstance(item, Truth):
            truths.append(item)
            continue
        for tick in chain.feed(item):
            poses += [pose for pose in tick.poses.values() if pose is not None]
            for outcome in tick.outcomes:
                m = outcome.measurement
                if isinstance(m, PoseIncrement) and m.from_stamp_ns < m.stamp_ns:
                    spread = np.sqrt(np.linalg.eigvalsh(m.cov[:2, :2]))
                    widest, narrowest = max(widest, spread[1]), min(narrowest, spread[0])
    # The LiDAR says what it does not know, and only that.
    assert widest > 0.5
    assert narrowest < 0.02
    errors = compare(poses, Reference(truths), len(poses))
    sigmas = np.sqrt(errors.cov.diagonal(axis1=1, axis2=2))
    assert len(sigmas) > 200
    assert (np.abs(errors.error) / sigmas).max() < 3.0
    accuracy = errors.accuracy()
    assert accuracy is not None
    assert accuracy.rmse < 0.15
