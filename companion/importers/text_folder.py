"""Measurements as text: a folder of CSV files and a TUM trajectory, written from a log and read into one.

`ranges.csv`: stamp_ns, tag, anchor, range [m], rx and fp power [dBm]. `scans.csv`: stamp_ns, angle [deg],
range [m], time since the first beam [s], quality, a row a beam. `imu.csv`: stamp_ns, gyro x, y, z [rad/s],
accel x, y, z [m/s^2]. `truth.tum`: TUM poses of the body. A file that is not there holds nothing.
"""

from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from itertools import groupby
from pathlib import Path
from typing import TextIO

import numpy as np

from companion.config import Config
from companion.errors import UserError
from companion.importers.recording import Recording
from companion.importers.tables import numbers, read_tum, rows, write_tum
from companion.log import Direction, RawChunk, Truth
from companion.pipeline import make_sensors
from estimators.messages import ImuSample, Measurement, RangeFrame, Scan

RANGES, SCANS, INERTIAL, TRUTH = "ranges.csv", "scans.csv", "imu.csv", "truth.tum"
_HEADINGS = {
    RANGES: "stamp_ns,tag,anchor,range_m,rx_power_dbm,fp_power_dbm\n",
    SCANS: "stamp_ns,angle_deg,range_m,time_s,quality\n",
    INERTIAL: "stamp_ns,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z\n",
}


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
    files: dict[str, TextIO] = {}
    try:
        with ExitStack() as opened:
            for record in records:
                if isinstance(record, Truth):
                    truths.append(record)
                elif record.source in sensors and record.direction is Direction.IN:
                    for m in sensors[record.source].feed(record.data, record.stamp_ns):
                        name, lines = _text_of(m)
                        if not name:
                            continue
                        if name not in files:
                            folder.mkdir(parents=True, exist_ok=True)
                            files[name] = opened.enter_context((folder / name).open("w", encoding="utf-8"))
                            files[name].write(_HEADINGS[name])
                        files[name].writelines(lines)
    except OSError as error:
        raise UserError(f"cannot write {error.filename or folder}: {error.strerror}") from error
    written = [folder / name for name in _HEADINGS if name in files]
    if truths:
        write_tum(folder / TRUTH, truths)
        written.append(folder / TRUTH)
    return written


def _text_of(measurement: Measurement) -> tuple[str, Iterator[str]]:
    """File for a measurement, empty for what has none, and its lines there."""
    match measurement:
        case RangeFrame(stamp_ns, tag_id, anchor_ids, ranges, rx_power, fp_power):
            return RANGES, _lines(f"{stamp_ns},{tag_id}", anchor_ids, ranges, rx_power, fp_power)
        case Scan(stamp_ns, angles, ranges, beam_times, quality):
            return SCANS, _lines(f"{stamp_ns}", np.rad2deg(angles), ranges, beam_times, quality)
        case ImuSample(stamp_ns, gyro, accel):
            return INERTIAL, _lines(f"{stamp_ns}", *gyro[:, None], *accel[:, None])
    return "", iter(())


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
