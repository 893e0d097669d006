"""CARMEN logs: laser scans with the pose that the log gives them."""

from pathlib import Path

import numpy as np

from companion.errors import UserError
from companion.importers.recording import Recording
from companion.importers.tables import nanoseconds
from companion.log import Truth
from companion.text_file import read_text
from estimators.messages import FloatArray, Scan

_OLD, _NEW = ("FLASER", "RLASER"), ("ROBOTLASER1", "ROBOTLASER2")
_OLD_MOST_RANGE = 80.0
"""The lasers of FLASER lines report what they do not see as 81.9 m or so."""
_OLD_FIELD = np.pi
_SCAN_S = 0.013
"""Time of one scan: the SICK lasers of these logs turn at 75 Hz and look half the way."""


def read_carmen(path: Path) -> Recording:
    """Scans of the front laser of a CARMEN log; poses of the laser as reference.

    In a corrected log the poses are those of a SLAM, in a raw one those of the odometry: what an
    evaluation against them means is for the user to say.

    Args:
        path: text file.

    Raises:
        UserError: it cannot be read, or a line is wrong.

    Source: CARMEN log format, as in the logs of Freiburg and MIT (FLASER and ROBOTLASER1 lines).
    """
    recording = Recording()
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.split()
        if not words or words[0] not in (_OLD[0], _NEW[0]):
            continue
        try:
            scan, truth = _old(words) if words[0] in _OLD else _new(words)
        except (ValueError, IndexError) as error:
            raise UserError(f"{path}, line {number}: {words[0]} is not complete: {error}") from error
        recording.scans.append(scan)
        recording.truths.append(truth)
    return recording


def _old(words: list[str]) -> tuple[Scan, Truth]:
    """FLASER n r1 .. rn x y theta odom_x odom_y odom_theta time host logger_time."""
    count = int(words[1])
    ranges = np.array([float(word) for word in words[2 : 2 + count]])
    x, y, yaw = (float(word) for word in words[2 + count : 5 + count])
    stamp_ns = nanoseconds(words[8 + count])
    step = _OLD_FIELD / (count if count % 2 == 0 else count - 1)
    angles = -_OLD_FIELD / 2.0 + step * np.arange(count, dtype=np.float64)
    return _scan(stamp_ns, angles, ranges, _OLD_MOST_RANGE), Truth(stamp_ns, np.array([x, y, yaw]))


def _new(words: list[str]) -> tuple[Scan, Truth]:
    """ROBOTLASER1 type start field step max accuracy mode n r1 .. rn m i1 .. im x y theta and ten more."""
    start, step, most = float(words[2]), float(words[4]), float(words[5])
    count = int(words[8])
    ranges = np.array([float(word) for word in words[9 : 9 + count]])
    after = 10 + count + int(words[9 + count])
    x, y, yaw = (float(word) for word in words[after : after + 3])
    stamp_ns = nanoseconds(words[after + 11])
    angles = start + step * np.arange(count, dtype=np.float64)
    return _scan(stamp_ns, angles, ranges, most), Truth(stamp_ns, np.array([x, y, yaw]))


def _scan(stamp_ns: int, angles: FloatArray, ranges: FloatArray, most: float) -> Scan:
    seen = np.isfinite(ranges) & (ranges < most)
    times = np.linspace(0.0, _SCAN_S, len(angles))
    return Scan(stamp_ns, angles, np.where(seen, ranges, 0.0), times, np.zeros(len(angles)))
