"""Tables of numbers in text files, with errors that name the line."""

import csv
from collections.abc import Iterator
from math import cos, sin
from pathlib import Path

import numpy as np

from companion.errors import UserError
from companion.log import Truth
from companion.text_file import read_text
from estimators.messages import FloatArray, RangeFrame


def rows(path: Path, least: int, delimiter: str = ",", header: bool = True) -> Iterator[list[str]]:
    """Rows of a text table, blank lines and those that begin with # left out.

    Args:
        path: file.
        least: number of columns that every row must have.
        delimiter: between columns; a blank stands for any number of them.
        header: whether the first row names the columns.

    Raises:
        UserError: it cannot be read, or a row is too short.
    """
    lines = enumerate(csv.reader(read_text(path).splitlines(), delimiter=delimiter, skipinitialspace=True), 1)
    for number, row in lines:
        cells = [cell for cell in row if cell] if delimiter == " " else row
        if not cells or cells[0].startswith("#"):
            continue
        if header:
            header = False
            continue
        if len(cells) < least:
            raise UserError(f"{path}, line {number}: {len(cells)} columns, {least} are needed")
        yield cells


def numbers(path: Path, cells: list[str]) -> list[float]:
    """Cells as numbers; an empty one is NaN.

    Raises:
        UserError: one is none.
    """
    try:
        return [float(cell) if cell.strip() else np.nan for cell in cells]
    except ValueError as error:
        raise UserError(f"{path}: {error}") from error


def nanoseconds(seconds: str) -> int:
    """Decimal seconds to whole nanoseconds, of which a float of seconds since 1970 loses the last hundred.

    Raises:
        ValueError: no number.
    """
    whole, _, fraction = seconds.strip().partition(".")
    if not (fraction or whole).isdigit():
        return round(float(seconds) * 1e9)
    sign = -1 if whole.startswith("-") else 1
    return int(whole or 0) * 1_000_000_000 + sign * int((fraction + "000000000")[:9])


def single_range(stamp_ns: int, anchor_id: int, distance: float) -> RangeFrame:
    """A range that was taken alone."""
    none = np.full(1, np.nan)
    return RangeFrame(stamp_ns, 1, np.array([anchor_id]), np.array([distance]), none, none)


def read_tum(path: Path) -> list[Truth]:
    """Poses of a TUM trajectory: seconds, position [m], quaternion x y z w.

    Raises:
        UserError: it cannot be read, or a line is wrong.
    """
    truths = []
    for cells in rows(path, 8, delimiter=" ", header=False):
        x, y, _, *quat_xyzw = numbers(path, cells[1:8])
        try:
            stamp_ns = nanoseconds(cells[0])
        except ValueError as error:
            raise UserError(f"{path}: {cells[0]!r} is no time") from error
        truths.append(Truth(stamp_ns, np.array([x, y, yaw_of(quat_xyzw)])))
    return truths


def write_tum(path: Path, truths: list[Truth]) -> None:
    """Write poses as a TUM trajectory; an unknown heading as 0.

    Raises:
        UserError: it cannot be written.
    """
    lines = []
    for truth in truths:
        x, y, yaw = np.nan_to_num(truth.pose).tolist()
        seconds, rest = divmod(truth.stamp_ns, 1_000_000_000)
        lines.append(f"{seconds}.{rest:09d} {x:.9f} {y:.9f} 0 0 0 {sin(yaw / 2):.12f} {cos(yaw / 2):.12f}\n")
    write_lines(path, lines)


def write_lines(path: Path, lines: list[str]) -> None:
    """Write lines that end in a line break.

    Raises:
        UserError: it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(lines), encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error


def yaw_of(quat_xyzw: list[float] | FloatArray) -> float:
    """Heading [rad] of a quaternion."""
    x, y, z, w = quat_xyzw
    return float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
