"""Faults put into the records of a log: bytes held back, frames and scans decoded, changed, encoded again."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import isfinite
from pathlib import Path

import numpy as np

from companion.config import Config
from companion.errors import UserError
from companion.evaluate import Reference
from companion.log import Direction, Log, LogWriter, RawChunk, Truth
from companion.log_edit.faults import ChunkFault, Fault, FrameFault, ScanFault, Scene, TagPosition
from companion.raw_scans import ScanEncoder
from drivers import make_sensor
from drivers.linktrack import LinkTrack
from drivers.linktrack_frames import encode
from estimators.geometry import transform
from estimators.messages import FloatArray, Scan

Record = RawChunk | Truth


def edit_log(log: Log, config: Config, faults: Sequence[Fault], seed: int, path: Path) -> None:
    """Write a log as it would be had something gone wrong.

    Args:
        log: to read.
        config: of its site.
        faults: all at once.
        seed: of everything random in them.
        path: log to write; must not be the one that is read.

    Raises:
        UserError: it is, cannot be written, or a fault needs a truth that the log does not have.
    """
    if path.exists() and path.samefile(log.path):
        raise UserError(f"--out {path} is the log that is read")
    records = edit_records(log, config, log.start_ns, faults, np.random.default_rng(seed))
    write_log(path, config, log.start_ns, records)


def write_log(path: Path, config: Config, start_ns: int, records: Iterable[Record]) -> None:
    """Write records as a log.

    Raises:
        UserError: it cannot be written.
    """
    writer = LogWriter(path, config.to_toml(), start_ns)
    for record in records:
        if isinstance(record, Truth):
            writer.truth(record)
        else:
            writer.raw(record)
    writer.close()


def edit_records(
    records: Iterable[Record],
    config: Config,
    start_ns: int,
    faults: Sequence[Fault],
    rng: np.random.Generator,
) -> list[Record]:
    """Records as they would be had something gone wrong, in the order of their stamps.

    Frames are edited first, then scans, then what arrives when. Bytes of sensors without a fault stay as
    they are.

    Args:
        records: of a log, in order.
        config: of its site.
        start_ns: time of the first pose, from which faults count.
        faults: all at once.
        rng: source of everything random in them.

    Raises:
        UserError: a fault needs a truth that is not among the records.
    """
    found = list(records)
    frame_faults = [fault for fault in faults if isinstance(fault, FrameFault)]
    scan_faults = [fault for fault in faults if isinstance(fault, ScanFault)]
    chunk_faults = [fault for fault in faults if isinstance(fault, ChunkFault)]
    for name, table in config.sensor.items():
        if table.driver == "linktrack" and frame_faults:
            found = _with_frames(found, name, config, start_ns, frame_faults, rng)
        elif table.driver == "rplidar" and scan_faults:
            found = _with_scans(found, name, config, start_ns, scan_faults)
    if chunk_faults:
        found = _with_chunks(found, start_ns, chunk_faults)
    return sorted(found, key=lambda record: record.stamp_ns)


def _with_frames(
    records: list[Record],
    source: str,
    config: Config,
    start_ns: int,
    faults: Sequence[FrameFault],
    rng: np.random.Generator,
) -> list[Record]:
    """Every frame decoded and encoded again: what of it no fault changes comes out as it was."""
    tag_at = _tag_position(records, config, any(fault.NEEDS_TRUTH for fault in faults))
    decoder = LinkTrack(LinkTrack.Config())
    out: list[Record] = []
    for record in records:
        if not _is_from(record, source):
            out.append(record)
            continue
        assert isinstance(record, RawChunk)
        data = b""
        scene = Scene(record.stamp_ns, tag_at, config, rng)
        for whole in decoder.frames(record.data):
            frame = whole
            for fault in faults:
                if fault.active((record.stamp_ns - start_ns) * 1e-9):
                    frame = fault.edit_frame(frame, scene)
            data += encode(frame)
        if data:
            out.append(replace(record, data=data))
    return out


def _with_scans(
    records: list[Record], source: str, config: Config, start_ns: int, faults: Sequence[ScanFault]
) -> list[Record]:
    """All scans decoded and written again in a mode that can hold any scan; answers to requests go."""
    table = config.sensor[source]
    sensor = make_sensor(table.driver, table.settings)
    out = [record for record in records if not _is_from(record, source)]
    encoder = ScanEncoder(round(table.settings.latency_ms * 1e6))
    packets: list[tuple[int, bytes]] = []
    for record in records:
        if not _is_from(record, source):
            continue
        assert isinstance(record, RawChunk)
        for scan in sensor.feed(record.data, record.stamp_ns):
            assert isinstance(scan, Scan)
            changed = scan
            for fault in faults:
                if fault.active((scan.stamp_ns - start_ns) * 1e-9):
                    changed = fault.edit_scan(changed)
            packets += encoder.add(changed)
    packets += encoder.flush()
    out += [RawChunk(source, Direction.IN, stamp_ns, data) for stamp_ns, data in packets]
    return out


def _with_chunks(records: list[Record], start_ns: int, faults: Sequence[ChunkFault]) -> list[Record]:
    """Bytes of one sensor never overtake each other."""
    out: list[Record] = []
    newest_ns: dict[str, int] = {}
    for record in records:
        if isinstance(record, Truth) or record.direction is Direction.OUT:
            out.append(record)
            continue
        chunk: RawChunk | None = record
        for fault in faults:
            if chunk is not None and fault.active((record.stamp_ns - start_ns) * 1e-9):
                chunk = fault.edit_chunk(chunk)
        if chunk is not None:
            stamp_ns = max(chunk.stamp_ns, newest_ns.get(chunk.source, chunk.stamp_ns))
            newest_ns[chunk.source] = stamp_ns
            out.append(replace(chunk, stamp_ns=stamp_ns))
    return out


def _is_from(record: Record, source: str) -> bool:
    return isinstance(record, RawChunk) and record.source == source and record.direction is Direction.IN


def _tag_position(records: list[Record], config: Config, needed: bool) -> TagPosition:
    truths = [record for record in records if isinstance(record, Truth)]
    if needed and not (truths and all(isfinite(truth.pose[2]) for truth in truths)):
        raise UserError("--fault moved: the log has no truth with heading, where the tag was is not known")
    reference = Reference(truths)
    lever_arm = np.array(config.body.tag)

    def tag_at(stamp_ns: int) -> FloatArray:
        pose = reference.at([stamp_ns])[0]
        return np.array([*transform(pose, lever_arm[None, :2])[0], config.body.height + lever_arm[2]])

    return tag_at
