"""What a log holds for a calibration: ranges as measured, odometry, truth."""

from collections.abc import Iterator

from companion.config import Config
from companion.errors import UserError
from companion.log import Direction, Log, Truth
from companion.pipeline import make_front_end, make_sensors
from estimators.immutable import immutable
from estimators.messages import Measurement, PoseIncrement, RangeFrame, Scan


@immutable
class Recording:
    """Measurements of a drive.

    Attributes:
        start_ns: beginning of the log.
        range_frames: as measured, no bias taken off, in stamp order.
        increments: of the scan matcher, in stamp order.
        truths: in stamp order; empty where the log has none.
    """

    start_ns: int
    range_frames: list[RangeFrame]
    increments: list[PoseIncrement]
    truths: list[Truth]


def read_recording(
    log: Log, config: Config, until: float | None, *, with_odometry: bool, every_tag: bool = False
) -> Recording:
    """Decode a log.

    Args:
        log: to read.
        config: of the site.
        until: leave out what arrived later than this after the beginning [s]; None: take all.
        with_odometry: match the scans, too.
        every_tag: with the ranges of tags in `body.tags`.

    Raises:
        UserError: there is no range in it.
    """
    end_ns = None if until is None else log.start_ns + round(until * 1e9)
    recording = Recording(log.start_ns, [], [], [])
    front_end, _ = make_front_end(config, [])
    for measurement in _measurements(log, config, end_ns):
        if isinstance(measurement, Scan):
            increment = front_end.update(measurement) if with_odometry else None
            if increment is not None:
                recording.increments.append(increment)
        elif isinstance(measurement, Truth):
            recording.truths.append(measurement)
        elif isinstance(measurement, RangeFrame) and (
            every_tag or measurement.tag_id not in config.body.tags
        ):
            recording.range_frames.append(measurement)
    if not recording.range_frames:
        raise UserError(f"{log.path}: no ranges of the site's sensors in it")
    for found in (recording.range_frames, recording.increments, recording.truths):
        found.sort(key=lambda each: each.stamp_ns)
    return recording


def _measurements(log: Log, config: Config, end_ns: int | None) -> Iterator[Measurement | Truth]:
    sensors = make_sensors(config)
    for record in log:
        if end_ns is not None and record.stamp_ns > end_ns:
            return
        if isinstance(record, Truth):
            yield record
        elif record.direction is Direction.IN and record.source in sensors:
            yield from sensors[record.source].feed(record.data, record.stamp_ns)
