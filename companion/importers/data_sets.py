"""Public data sets with UWB ranges, as their authors publish them.

Which columns mean what is said in each data set's own README.
"""

from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from companion.config import Config
from companion.errors import UserError
from companion.importers.recording import Recording
from companion.importers.tables import nanoseconds, numbers, rows, single_range
from companion.log import Truth
from estimators.geometry import transform
from estimators.messages import RangeFrame, Scan

_LIAS_RANGES, _LIAS_MOTION = "UWB_dynamic_exp_fast.csv", "motion_capture_dynamic_exp_fast.csv"
_LIAS_TAG, _LIAS_TAGS, _LIAS_ANCHORS = 0, 3, 8
_LIAS_TAG_IN_TROLLEY = np.array([[-0.0689, -0.1423]])
_LIAS_YAW_OFFSET = np.deg2rad(7.0)
_LIAS_CLOCK_OFFSET_NS = 5_000_000
"""UWB clock ahead of the motion capture's: 5.0 +- 3.2 ms by the ranges of all tags in the first 30 s,
3.1 +- 3.7 ms by the whole drive; what depends on the direction to the anchor was fitted along with it."""
_LABYRINTH_MEASURED, _LABYRINTH_TRUTH = "Indoor_UWB_Input.txt", "Indoor_UWB_GT.txt"
_ROBOTINO_TRUTH = "_ref_scanmatch.csv"
_ROBOTINO_BIAS = {177: 0.611, 178: -0.043, 180: -0.607}
"""Additive error of each anchor's ranges [m], fitted together with the anchors' positions."""
_ROBOTINO_FIRST_BEAM, _ROBOTINO_STEP, _ROBOTINO_SCAN_S = -2.3562, 0.005817, 1.0 / 15.0


def lias_planar(folder: Path, config: Config) -> Recording:
    """LIAS-CUHKSZ, ICRA 2023: a trolley among eight anchors at 100 Hz.

    Where the site names further tags on the robot, it gives the ranges of all three and the trolley's pose as
    truth, else those of tag 0 and that tag's position.

    Source: github.com/LIAS-CUHKSZ/Efficient-Pose-Estimation-via-UWB-measurements.
    """
    recording = Recording()
    path = folder / _LIAS_RANGES
    for cells in rows(path, 1 + _LIAS_ANCHORS * _LIAS_TAGS, header=False):
        by_tag = np.array(numbers(path, cells[1:])).reshape(_LIAS_ANCHORS, _LIAS_TAGS).T
        for tag_id in {_LIAS_TAG, *config.body.tags}:
            ids = np.flatnonzero(by_tag[tag_id] > 0.0)
            none = np.full(len(ids), np.nan)
            ranges = by_tag[tag_id, ids]
            recording.ranges.append(RangeFrame(_lias_ns(cells[0]), tag_id, ids, ranges, none, none))
    path = folder / _LIAS_MOTION
    for cells in rows(path, 8):
        x, y, _, qw, qx, qy, qz = numbers(path, cells[1:8])
        # The tracked body hangs upside down.
        yaw = float(Rotation.from_quat([qx, qy, qz, qw]).as_euler("ZYX")[0]) + _LIAS_YAW_OFFSET
        pose = np.array([x, y, yaw])
        if not config.body.tags:
            pose = np.array([*transform(pose, _LIAS_TAG_IN_TROLLEY)[0], np.nan])
        recording.truths.append(Truth(_lias_ns(cells[0]) + _LIAS_CLOCK_OFFSET_NS, pose))
    return recording


def _lias_ns(text: str) -> int:
    since = datetime.strptime(text, "%Y-%m-%d %H:%M:%S.%f") - datetime(2022, 8, 15)
    return round(since.total_seconds() * 1e6) * 1000


def labyrinth_uwb(folder: Path, config: Config) -> Recording:  # noqa: ARG001
    """TU Chemnitz, Labyrinth: a small robot, one range a row to four anchors; wheel speeds are not taken.

    Source: github.com/TUC-ProAut/libRSF.
    """
    recording = Recording()
    path = folder / _LABYRINTH_MEASURED
    for cells in rows(path, 3, delimiter=" ", header=False):
        if cells[0] == "range2":
            _, distance, _, _, _, anchor_id, *_ = numbers(path, cells[1:])
            recording.ranges.append(single_range(nanoseconds(cells[1]), int(anchor_id), distance))
    path = folder / _LABYRINTH_TRUTH
    for cells in rows(path, 4, delimiter=" ", header=False):
        _, x, y, *_ = numbers(path, cells[1:])
        recording.truths.append(Truth(nanoseconds(cells[1]), np.array([x, y, np.nan])))
    return recording


def robotino_uwb(folder: Path, config: Config) -> Recording:  # noqa: ARG001
    """Robotino, 2017: scans of 270 deg at 15 Hz and single ranges to three anchors; odometry is not taken.

    The reference is scan matching to a map: not independent of the scans.

    Source: github.com/albertkasdorf/ro_slam_with_uwb.
    """
    recording = Recording()
    truth_path = _robotino_truth(folder)
    stem = truth_path.name.removesuffix(_ROBOTINO_TRUTH)
    path = folder / f"{stem}_uwb.csv"
    for cells in rows(path, 4):
        anchor_id, distance = int(cells[2]), float(cells[3])
        if distance > 0.0:
            bias = _ROBOTINO_BIAS.get(anchor_id, 0.0)
            recording.ranges.append(single_range(nanoseconds(cells[0]), anchor_id, distance - bias))
    path = folder / f"{stem}_scan.csv"
    for cells in rows(path, 100):
        ranges = np.nan_to_num(np.array(numbers(path, cells[2:])), posinf=0.0)
        number = np.arange(len(ranges), dtype=np.float64)
        turn = 2.0 * np.pi / _ROBOTINO_STEP
        recording.scans.append(
            Scan(
                stamp_ns=nanoseconds(cells[0]),
                angles=_ROBOTINO_FIRST_BEAM + _ROBOTINO_STEP * number,
                ranges=ranges,
                beam_times=_ROBOTINO_SCAN_S / turn * number,
                quality=np.zeros(len(ranges)),
            )
        )
    for cells in rows(truth_path, 4, header=False):
        recording.truths.append(Truth(nanoseconds(cells[0]), np.array(numbers(truth_path, cells[1:4]))))
    return recording


def _robotino_truth(folder: Path) -> Path:
    found = sorted(folder.glob(f"*{_ROBOTINO_TRUTH}"))
    if not found:
        raise UserError(f"{folder}: no file *{_ROBOTINO_TRUTH}")
    return found[0]


DATA_SETS: dict[str, tuple[str, Callable[[Path, Config], Recording]]] = {
    "lias_planar": (_LIAS_RANGES, lias_planar),
    "labyrinth_uwb": (_LABYRINTH_MEASURED, labyrinth_uwb),
    "robotino_uwb": (f"*{_ROBOTINO_TRUTH}", robotino_uwb),
}
"""Name, that of the site file in `params/sites` too -> file by which its folder is known, what reads it."""


def data_set_in(folder: Path) -> str | None:
    """Name of the data set that a folder holds; None when it is none of them."""
    return next((name for name, (mark, _) in DATA_SETS.items() if any(folder.glob(mark))), None)
