"""A real recording through the whole chain: encoded as LinkTrack frames, logged, replayed, compared."""

import csv
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from companion.config import load_config
from companion.log import Direction, Log, LogWriter, RawChunk, Truth
from companion.replay import Replay, config_of, replay
from drivers.linktrack_frames import encode
from drivers.linktrack_types import NodeFrame3, NodeRange
from estimators.base import Verdict

DATA = Path(__file__).parent.parent / "data" / "lias_planar"
TAG_IN_TROLLEY = np.array([-0.0750, 0.1402])
YAW_OFFSET = np.deg2rad(7.0)
CLOCK_OFFSET_NS = 5_000_000
"""UWB clock ahead of the motion capture's."""
MEASURED_RMSE = 0.172
"""Non-linear least squares on the same kind of frames, as the data set's summary has it [m]."""


def stamp_ns(text: str) -> int:
    """Nanoseconds from the recording's first full minute; one epoch for both clocks."""
    since = datetime.strptime(text, "%Y-%m-%d %H:%M:%S.%f") - datetime(2022, 8, 15, 9, 42)
    return round(since.total_seconds() * 1e6) * 1000


def rows(name: str) -> list[list[str]]:
    with (DATA / name).open(newline="", encoding="utf-8") as file:
        return list(csv.reader(file))[1:]


def truth(row: list[str]) -> Truth:
    """The tag, from the pose of the trolley; the tracked body hangs upside down."""
    x, y, _, qw, qx, qy, qz = map(float, row[1:])
    yaw = Rotation.from_quat([qx, qy, qz, qw]).as_euler("ZYX")[0] + YAW_OFFSET
    c, s = np.cos(yaw), np.sin(yaw)
    tag = np.array([x, y]) + np.array([[c, -s], [s, c]]) @ TAG_IN_TROLLEY
    return Truth(stamp_ns(row[0]) + CLOCK_OFFSET_NS, np.array([*tag, np.nan]))


def chunk(row: list[str]) -> RawChunk:
    """One row of ranges as the frame that a LinkTrack tag would have sent; empty cells are failed ranges."""
    nodes = [NodeRange(1, anchor, float(text), -80.0, -79.0) for anchor, text in enumerate(row[1:]) if text]
    stamp = stamp_ns(row[0])
    frame = NodeFrame3(
        id=1,
        role=2,
        local_time_ms=stamp // 1_000_000,
        system_time_ms=stamp // 1_000_000,
        voltage=5.0,
        nodes=tuple(nodes),
    )
    return RawChunk("uwb", Direction.IN, stamp, encode(frame))


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Replay:
    records: list[RawChunk | Truth] = [chunk(row) for row in rows("uwb_tag1.csv")]
    records += [truth(row) for row in rows("motion_capture.csv")]
    records.sort(key=lambda record: record.stamp_ns)
    path = tmp_path_factory.mktemp("lias") / "lias.mcap"
    writer = LogWriter(path, load_config(DATA / "site.toml").to_toml(), stamp_ns(rows("uwb_tag1.csv")[0][0]))
    for record in records:
        if isinstance(record, Truth):
            writer.truth(record)
        else:
            writer.raw(record)
    writer.close()
    log = Log(path)
    return replay(log, config_of(log, []), ["ekf", "least_squares"])


def test_every_frame_and_range_is_taken(result: Replay) -> None:
    table = rows("uwb_tag1.csv")
    assert result.sensors["uwb"].good == len(table)
    assert result.sensors["uwb"].skipped_bytes == 0
    # The last frames are still held back by the sequencer when the log ends.
    ranges = sum(bool(cell) for row in table for cell in row[1:])
    assert sum(result.verdicts["ekf"].values()) == pytest.approx(ranges, abs=3 * 8)
    assert result.verdicts["ekf"][Verdict.ACCEPTED] > 0.99 * ranges


def test_position_error_against_motion_capture(result: Replay) -> None:
    fused, alone = result.accuracy("ekf"), result.accuracy("least_squares")
    assert fused is not None
    assert alone is not None
    assert fused.availability > 0.99
    # Frame by frame we do what others measured; the filter is no worse and has no outliers.
    assert alone.rmse == pytest.approx(MEASURED_RMSE, abs=0.02)
    assert fused.rmse < MEASURED_RMSE
    assert fused.max < 0.8 * alone.max


def test_without_a_lidar_the_heading_is_not_sent(result: Replay) -> None:
    # Ranges alone do not observe the heading: its sigma is past any limit, and the pose is not sent.
    assert set(result.health) == {"starting", "lost"}
