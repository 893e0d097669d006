"""A recording as measurements, and the log that our sensors would have written of it."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from companion.config import Config
from companion.errors import UserError
from companion.log import Direction, RawChunk, Truth
from companion.log_edit.edit import write_log
from companion.raw_scans import ScanEncoder
from drivers.linktrack_frames import encode
from drivers.linktrack_types import VOID_ID, NodeFrame2, NodeFrame3, NodeFrame5, NodeRange, Role
from estimators.messages import ImuSample, RangeFrame, Scan

_NO_POWER = -80.0
"""Of ranges that were recorded without one [dBm]."""
_LEAST_BEAMS, _MOST_ID = 30, 2**32


@dataclass(slots=True)
class Recording:
    """What was measured, each list in any order, all stamps on one clock."""

    ranges: list[RangeFrame] = field(default_factory=list)
    scans: list[Scan] = field(default_factory=list)
    inertial: list[ImuSample] = field(default_factory=list)
    truths: list[Truth] = field(default_factory=list)


def write_recording(recording: Recording, config: Config, path: Path) -> int:
    """Write a recording as a log that replays like one of ours.

    Args:
        recording: to encode.
        config: of the site where it was made; says which sensor stands for which.
        path: log to write.

    Returns:
        Number of measurements in the log.

    Raises:
        UserError: the site has no sensor for what was measured, nothing was, or the log cannot be written.
    """
    by_tag: dict[int | None, list[tuple[int, bytes]]] = {}
    for m in recording.ranges:
        by_tag.setdefault(m.tag_id, []).append((m.stamp_ns, _range_bytes(m)))
    if recording.inertial:
        by_tag[None] = [(m.stamp_ns, _inertial_bytes(m)) for m in recording.inertial]
    scans = sorted(recording.scans, key=lambda scan: scan.stamp_ns)
    scans = [scan for scan in scans if len(scan.angles) >= _LEAST_BEAMS]
    records: list[RawChunk | Truth] = list(recording.truths)
    for tag_id, frames in by_tag.items():
        name, latency_ns = _sensor(config, "linktrack", tag_id)
        records += _chunks(name, ((stamp_ns + latency_ns, data) for stamp_ns, data in frames))
    if scans:
        name, latency_ns = _sensor(config, "rplidar")
        encoder = ScanEncoder(latency_ns)
        packets = [packet for scan in scans for packet in encoder.add(scan)]
        records += _chunks(name, packets + encoder.flush())
    measured = [record.stamp_ns for record in records if isinstance(record, RawChunk)]
    if not measured:
        raise UserError(f"cannot write {path}: the recording holds no range, scan or inertial sample")
    records.sort(key=lambda record: record.stamp_ns)
    write_log(path, config, min(measured), records)
    return len(recording.ranges) + len(recording.inertial) + len(scans)


def _sensor(config: Config, driver: str, tag_id: int | None = None) -> tuple[str, int]:
    """Name of the site's sensor with a driver, and by how much that takes stamps back [ns].

    Of several the one that is set to take that tag alone, else the first.
    """
    own = [(name, table.settings) for name, table in config.sensor.items() if table.driver == driver]
    if not own:
        raise UserError(
            f"the site {config.site.name!r} has no sensor with driver {driver!r}, which is needed here"
        )
    name, settings = min(own, key=lambda sensor: getattr(sensor[1], "tag_id", None) != tag_id)
    return name, round(settings.latency_ms * 1e6)


def _chunks(name: str, packets: Iterable[tuple[int, bytes]]) -> list[RawChunk]:
    return [RawChunk(name, Direction.IN, stamp_ns, data) for stamp_ns, data in packets]


def _range_bytes(frame: RangeFrame) -> bytes:
    nodes = [
        NodeRange(Role.ANCHOR, anchor_id, dis, fp if fp == fp else _NO_POWER, rx if rx == rx else _NO_POWER)
        for anchor_id, dis, rx, fp in zip(
            frame.anchor_ids.tolist(),
            frame.ranges.tolist(),
            frame.rx_power.tolist(),
            frame.fp_power.tolist(),
            strict=True,
        )
        if 0.0 < dis < 8000.0 and 0 <= anchor_id < _MOST_ID
    ]
    clock_ms = frame.stamp_ns // 1_000_000 % 2**32
    wide = frame.tag_id >= VOID_ID or any(node.id >= VOID_ID for node in nodes)
    kind = NodeFrame5 if wide else NodeFrame3
    return encode(kind(frame.tag_id, Role.TAG, clock_ms, clock_ms, 5.0, tuple(nodes)))


def _inertial_bytes(sample: ImuSample) -> bytes:
    clock_ms = sample.stamp_ns // 1_000_000 % 2**32
    none = (0.0, 0.0, 0.0)
    gx, gy, gz = sample.gyro.tolist()
    ax, ay, az = sample.accel.tolist()
    return encode(
        NodeFrame2(
            id=1,
            role=Role.TAG,
            local_time_ms=clock_ms,
            system_time_ms=clock_ms,
            voltage=5.0,
            pos=none,
            vel=none,
            eop=none,
            gyro=(gx, gy, gz),
            acc=(ax, ay, az),
            angle_deg=none,
            quat_wxyz=(0.0, 0.0, 0.0, 0.0),
            nodes=(),
        )
    )
