"""True positions of the tag at the times of the ranges: from the log's truth, or from surveyed points."""

import csv
from pathlib import Path

import numpy as np

from companion.calibration.recording import Recording
from companion.config import Config
from companion.errors import UserError
from companion.evaluate import Reference
from companion.text_file import read_text
from estimators.geometry import transform_each
from estimators.messages import FloatArray

POINT_COLUMNS = ["begin", "end", "x", "y", "z"]


def poses_from_truth(recording: Recording) -> FloatArray:
    """Poses (N, 3) x [m], y [m], yaw [rad] at the range frames by the log's truth; NaN outside of it.

    Raises:
        UserError: there is no truth.
    """
    if not recording.truths:
        raise UserError("--against truth: the log holds none; give surveyed points or lidar")
    reference = Reference(recording.truths)
    stamps = [frame.stamp_ns for frame in recording.range_frames]
    poses = reference.at(stamps)
    poses[[not reference.covers(stamp_ns) for stamp_ns in stamps]] = np.nan
    return poses


def tags_from_truth(recording: Recording, poses: FloatArray, config: Config) -> FloatArray:
    """Positions (N, 3) [m] of each range frame's tag.

    Args:
        recording: of the frames.
        poses: (N, 3) as of `poses_from_truth`.
        config: of the site.

    Raises:
        UserError: the poses lack the heading that the tag's place on the robot needs.
    """
    setup = config.setup()
    arms = np.array([setup.arm(frame.tag_id) for frame in recording.range_frames])
    tags = np.column_stack([poses[:, :2], config.body.height + arms[:, 2]])
    if arms[:, :2].any():
        if not np.isfinite(poses[np.isfinite(poses[:, 0]), 2]).all():
            raise UserError("--against truth: it has no heading, and body.tag is not at the body's origin")
        tags[:, :2] = transform_each(poses, arms[:, :2])
    tags[~np.isfinite(poses[:, 0])] = np.nan
    return tags


def tags_from_points(path: Path, recording: Recording) -> FloatArray:
    """Positions (N, 3) [m] of the tag at the range frames, where it stood on surveyed points.

    The file is CSV with a header: begin and end of the stay [s since the log began] and the position of the
    tag's antenna x, y, z [m] in the map.

    Raises:
        UserError: the file is missing or wrong.
    """
    rows = list(csv.reader(read_text(path).splitlines()))
    if not rows or [cell.strip() for cell in rows[0]] != POINT_COLUMNS:
        raise UserError(f"{path}: the first line must be {','.join(POINT_COLUMNS)}")
    times = np.array([(frame.stamp_ns - recording.start_ns) * 1e-9 for frame in recording.range_frames])
    tags = np.full((len(times), 3), np.nan)
    for number, row in enumerate(rows[1:], start=2):
        try:
            begin, end, *position = map(float, row)
        except ValueError as error:
            raise UserError(f"{path}, line {number}: {error}") from error
        if len(position) != 3 or not np.isfinite([begin, end, *position]).all() or begin >= end:
            raise UserError(
                f"{path}, line {number}: five finite numbers, begin before end, got {','.join(row)}"
            )
        tags[(times >= begin) & (times <= end)] = position
    if not np.isfinite(tags).any():
        raise UserError(f"{path}: no range was measured during any of its stays")
    return tags
