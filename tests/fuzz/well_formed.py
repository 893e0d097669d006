"""What must hold for anything a decoder gives out, whatever it was fed."""

import math
import sys
import types
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.rplidar_protocol import Samples
from estimators.messages import Attitude, ImuSample, Measurement, RangeFrame, Scan

_LONGEST_RANGE = 2**23 / 1000  # 24 bits of millimetres [m]
_SAMPLE_ENDS = {"angle_q14": 1 << 16, "distance_q2": 1 << 32, "quality": 1 << 8}  # HQ distances have 32 bits
_LONGEST_TEXT = 500


class FindingError(Exception):
    """A decoder did what it must not do."""


def require(holds: bool | np.bool, what: str) -> None:
    """Raise a finding unless it holds."""
    if not holds:
        raise FindingError(what)


def require_well_formed(measurement: Measurement, now_ns: int) -> None:
    """Check a measurement that was given out at `now_ns`."""
    try:
        match measurement:
            case RangeFrame():
                _require_ranges(measurement)
            case Scan():
                _require_scan(measurement)
            case ImuSample(gyro=gyro, accel=accel):
                require(gyro.shape == accel.shape == (3,), "not vectors")
                require(np.isfinite([gyro, accel]).all(), "not finite")
            case Attitude(quat_wxyz=quaternion):
                require(quaternion.shape == (4,), "not a quaternion")
                require(abs(float(np.linalg.norm(quaternion)) - 1) < 1e-6, "not of unit length")
            case _:
                raise FindingError("no measurement of a sensor")
        if not isinstance(measurement, Scan):  # a scan's last beams may share the stamp of its bytes
            require(measurement.stamp_ns <= now_ns, f"from the future, it is {now_ns}")
    except FindingError as error:
        raise FindingError(f"{error}: {str(measurement)[:_LONGEST_TEXT]}") from error


def require_well_formed_samples(samples: Samples, fed: int) -> None:
    """Check samples that were given out after `fed` bytes."""
    try:
        columns = samples.columns
        _require_equal_lengths(columns)
        require(len(columns[0]) == samples.count, "count is wrong")
        require(samples.starts == sorted(set(samples.starts)), "starts are out of order")
        require(set(samples.starts) <= set(range(samples.count)), "starts are none of these")
        for name, column in columns._asdict().items():
            last = _SAMPLE_ENDS[name] - 1
            require((column >= 0).all() and (column <= last).all(), f"{name} is not within 0..{last}")
        require(0 < samples.end <= fed, f"end {samples.end} is not within 1..{fed}")
    except FindingError as error:
        raise FindingError(f"{error}: {str(samples)[:_LONGEST_TEXT]}") from error


def _require_ranges(frame: RangeFrame) -> None:
    _require_equal_lengths((frame.anchor_ids, frame.ranges, frame.rx_power, frame.fp_power))
    require(frame.anchor_ids.dtype == np.int64, "ids are no integers")
    require((frame.ranges > 0).all() and (frame.ranges <= _LONGEST_RANGE).all(), "impossible range")
    powers = np.concatenate((frame.rx_power, frame.fp_power))
    require((np.isnan(powers) | (powers <= 0)).all(), "impossible power")


def _require_scan(scan: Scan) -> None:
    columns = (scan.angles, scan.ranges, scan.beam_times, scan.quality)
    _require_equal_lengths(columns)
    require(np.isfinite(columns).all(), "not finite")
    require((abs(scan.angles) <= math.pi).all(), "angle beyond half a turn")
    require((scan.ranges >= 0).all() and (scan.quality >= 0).all(), "negative")
    require(
        scan.beam_times[0] == 0 and (np.diff(scan.beam_times) > 0).all(), "beam times do not ascend from 0"
    )


def _require_equal_lengths(columns: Sequence[NDArray[Any]]) -> None:
    require(len(columns[0]) > 0, "empty")
    require({column.shape for column in columns} == {(len(columns[0]),)}, "shapes differ")


def held_bytes(root: object) -> int:
    """Size of an object with all that it refers to, but for classes, functions and modules [bytes]."""
    seen: set[int] = set()
    waiting: list[object] = [root]
    total = 0
    while waiting:
        each = waiting.pop()
        if id(each) in seen or isinstance(each, type | types.ModuleType | types.FunctionType):
            continue
        seen.add(id(each))
        total += sys.getsizeof(each)
        waiting += _referred(each)
    return total


def _referred(each: Any) -> Iterable[object]:
    if isinstance(each, str | bytes | bytearray | int | float | np.generic):
        return ()
    if isinstance(each, np.ndarray):
        return () if each.base is None else (each.base,)
    if isinstance(each, dict):
        return (*each.keys(), *each.values())
    if isinstance(each, list | tuple | set | frozenset | deque):
        return tuple(each)
    slots = (name for kind in type(each).__mro__ for name in getattr(kind, "__slots__", ()))
    return (getattr(each, "__dict__", None), *(getattr(each, name, None) for name in slots))
