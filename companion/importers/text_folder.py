"""Measurements as text: a folder of CSV files and a TUM trajectory, written from a log and read into one.

`ranges.csv`: stamp_ns, tag, anchor, range [m], rx and fp power [dBm]. `scans.csv`: stamp_ns, angle [deg],
range [m], time since the first beam [s], quality, a row a beam. `imu.csv`: stamp_ns, gyro x, y, z [rad/s],
accel x, y, z [m/s^2]. `truth.tum`: TUM poses of the body. A file that is not there holds nothing.
"""

from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path

import numpy as np

from companion.config import Config
from companion.errors import UserError
from companion.importers.recording import Recording
from companion.importers.tables import numbers, read_tum, rows, write_lines, write_tum
from companion.log import Direction, RawChunk, Truth
from companion.pipeline import make_sensors
from estimators.messages import ImuSample, RangeFrame, Scan

RANGES, SCANS, INERTIAL, TRUTH = "ranges.csv", "scans.csv", "imu.csv", "truth.tum"


def read_folder(folder: Path) -> Recording:
    """What the text files of a folder hold.

    Raises:
        UserError: one cannot be read, or a line is wrong.
    """
    recording = Recording()
    if (folder / RANGES).exists():
        for stamp_ns, cells in _by_stamp(folder / RANGES, 6):
            tags, anchors, ranges, rx_power, fp_power = np.array(cells).T
            for tag in np.unique(tags):
                of_tag = tags == tag
                columns = (ranges[of_tag], rx_power[of_tag], fp_power[of_tag])
                recording.ranges.append(
                    RangeFrame(stamp_ns, int(tag), anchors[of_tag].astype(np.int64), *columns)
                )
    if (folder / SCANS).exists():
        for stamp_ns, cells in _by_stamp(folder / SCANS, 5):
            degrees, ranges, times, quality = np.array(cells).T
            recording.scans.append(Scan(stamp_ns, np.deg2rad(degrees), ranges, times, quality))
    if (folder / INERTIAL).exists():
        for stamp_ns, cells in _by_stamp(folder / INERTIAL, 7):
            recording.inertial += [ImuSample(stamp_ns, np.array(c[:3]), np.array(c[3:6])) for c in cells]
    if (folder / TRUTH).exists():
        recording.truths = read_tum(folder / TRUTH)
    return recording


def write_folder(records: Iterable[RawChunk | Truth], config: Config, folder: Path) -> list[Path]:
    """Write what a log holds as text; gives the files that were written.

    Args:
        records: of the log.
        config: of its site.
        folder: to write into.

    Raises:
        UserError: it cannot be written.
    """
    sensors = make_sensors(config)
    truths: list[Truth] = []
    lines = {
        RANGES: ["stamp_ns,tag,anchor,range_m,rx_power_dbm,fp_power_dbm\n"],
        SCANS: ["stamp_ns,angle_deg,range_m,time_s,quality\n"],
        INERTIAL: ["stamp_ns,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z\n"],
    }
    for record in records:
        if isinstance(record, Truth):
            truths.append(record)
        elif record.source in sensors and record.direction is Direction.IN:
            for m in sensors[record.source].feed(record.data, record.stamp_ns):
                if isinstance(m, RangeFrame):
                    columns = (m.anchor_ids, m.ranges, m.rx_power, m.fp_power)
                    lines[RANGES] += _lines(f"{m.stamp_ns},{m.tag_id}", *columns)
                elif isinstance(m, Scan):
                    columns = (np.rad2deg(m.angles), m.ranges, m.beam_times, m.quality)
                    lines[SCANS] += _lines(f"{m.stamp_ns}", *columns)
                elif isinstance(m, ImuSample):
                    lines[INERTIAL] += _lines(f"{m.stamp_ns}", *m.gyro[:, None], *m.accel[:, None])
    written = []
    for name, text in lines.items():
        if len(text) > 1:
            write_lines(folder / name, text)
            written.append(folder / name)
    if truths:
        write_tum(folder / TRUTH, truths)
        written.append(folder / TRUTH)
    return written


def _lines(head: str, *columns: np.ndarray[tuple[int, ...], np.dtype[np.generic]]) -> Iterator[str]:
    for cells in zip(*(column.tolist() for column in columns), strict=True):
        yield f"{head},{','.join('' if cell != cell else f'{cell:.10g}' for cell in cells)}\n"


def _by_stamp(path: Path, least: int) -> Iterator[tuple[int, list[list[float]]]]:
    """Stamps [ns] of consecutive rows that share one, and their other cells."""
    try:
        for stamp_ns, group in groupby(rows(path, least), key=lambda cells: int(cells[0])):
            yield stamp_ns, [numbers(path, cells[1:]) for cells in group]
    except ValueError as error:
        raise UserError(f"{path}: a stamp is no whole number of nanoseconds: {error}") from error
