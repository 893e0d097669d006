"""Nooploop LinkTrack UWB modules: the NLink byte stream to ranges, inertial samples and attitude.

A module streams by itself (921600 baud, 8N1), several frame types on one port, perhaps with NMEA-0183 text
between them. Every known frame is decoded whole, so that nothing it carries is taken for a frame; those that
hold ranges become measurements.

Source: LinkTrack User Manual V2.3, chapters 7 and 8.
"""

import logging
import math
from collections.abc import Iterable, Sequence
from typing import ClassVar, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from drivers.clock import DeviceClock
from drivers.framing import ByteBuffer, DecodeStats
from drivers.linktrack_frames import FRAME_START, LAYOUT_OF_MARK
from drivers.linktrack_types import (
    VOID_ID,
    AnchorFrame0,
    AoaNodeFrame0,
    AoaNodeRange,
    Frame,
    NodeFrame2,
    NodeFrame3,
    NodeFrame4,
    NodeFrame5,
    NodeRange,
    Role,
    TagFrame0,
    TagState,
)
from estimators.messages import Attitude, ImuSample, Measurement, RangeFrame

_NodeList: TypeAlias = NodeFrame2 | NodeFrame3 | NodeFrame5 | AoaNodeFrame0
_Measuring: TypeAlias = _NodeList | TagFrame0 | AnchorFrame0 | NodeFrame4
_HEARING_TAGS = (Role.ANCHOR, Role.CONSOLE)
_logger = logging.getLogger(__name__)


class LinkTrack:
    """Sensor: ranges, and from models with an inertial chip its samples and attitude."""

    class Config(BaseModel):
        """Settings of one module."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        latency_ms: float = Field(
            0.0, ge=0, le=1000, description="time from the ranging to the arrival of its frame [ms]"
        )
        tag_id: int | None = Field(
            None,
            ge=0,
            lt=2**32,
            description="take ranges of this tag alone; for a module that hears several, as a console does",
        )

    MEASURES: ClassVar[frozenset[type]] = frozenset({RangeFrame, ImuSample, Attitude})
    DTR_STOPS: ClassVar[bool] = False
    BAUDS: ClassVar[tuple[int, ...]] = (
        921_600,
        115_200,
        460_800,
        1_000_000,
        230_400,
        1_200_000,
        1_500_000,
        2_000_000,
        3_000_000,
    )

    def __init__(self, config: Config) -> None:
        self.stats = DecodeStats()
        self._latency_ns = round(config.latency_ms * 1e6)
        self._tag_id = config.tag_id
        self._first_tag_id: int | None = None
        self._second_tag_told = False
        self._clock = DeviceClock(tick_ns=1_000_000, wrap=2**32)
        self._buffer = ByteBuffer(self.stats)
        self._awaited = 0  # bytes without which nothing is to be said about those that wait

    def feed(self, data: bytes, stamp_ns: int) -> list[Measurement]:
        """Measurements of the frames that `data` completes; `stamp_ns` is its arrival."""
        found: list[Measurement] = []
        for frame in self.frames(data):
            if isinstance(frame, _Measuring):
                measured_ns = self._clock.stamp(frame.local_time_ms, stamp_ns) - self._latency_ns
                found += measurements(frame, measured_ns)
        if self._tag_id is not None:
            return [m for m in found if not isinstance(m, RangeFrame) or m.tag_id == self._tag_id]
        self._look_for_second_tag(found)
        return found

    def frames(self, data: bytes) -> list[Frame]:
        """The whole frames that `data` completes, in order; for those who want more than measurements."""
        self._buffer.push(data)
        waiting = self._buffer.view
        found: list[Frame] = []
        if len(waiting) < self._awaited:
            return found
        while start := FRAME_START.search(waiting):
            mark = start[0]  # to be read before the buffer changes
            self._buffer.skip(start.start())
            if len(mark) < 2:
                self._awaited = 2
                return found
            layout = LAYOUT_OF_MARK[mark]
            length = layout.extent(waiting)
            if length is not None:
                if length > len(waiting):
                    self._awaited = length
                    return found
                frame = layout.decode(waiting[:length])
                if frame is not None:
                    self.stats.good += 1
                    self._buffer.take(length)
                    found.append(frame)
                    continue
            # A good frame may start inside this false one, so only its first byte goes.
            self.stats.bad += 1
            self._buffer.skip(1)
        self._buffer.skip(len(waiting))
        self._awaited = 0
        return found

    def connected(self, now_ns: int) -> None:
        """Nothing to start: the module streams by itself. A replay does not see this, so nothing changes."""

    def poll(self, now_ns: int) -> bytes:  # noqa: ARG002
        """Nothing to ask; a wrong write can disable a module."""
        return b""

    def closing(self) -> list[bytes]:
        """Nothing to stop."""
        return []

    def _look_for_second_tag(self, found: list[Measurement]) -> None:
        if self._second_tag_told:
            return
        for measurement in found:
            if not isinstance(measurement, RangeFrame):
                continue
            if self._first_tag_id is None:
                self._first_tag_id = measurement.tag_id
            elif measurement.tag_id != self._first_tag_id:
                self._second_tag_told = True
                tags = {self._first_tag_id} | {m.tag_id for m in found if isinstance(m, RangeFrame)}
                _logger.warning(
                    "LinkTrack: ranges of tags %s on one port are taken for those of one tag; "
                    "set tag_id to the tag on this robot",
                    ", ".join(map(str, sorted(tags))),
                )
                return


def measurements(frame: Frame, stamp_ns: int) -> list[Measurement]:
    """What a frame measured at `stamp_ns`: usable ranges, inertial sample, attitude.

    A range counts when it is above zero and its ids are not void. What an anchor or a console measures to
    tags are ranges of these tags, a RangeFrame for each; everything else are ranges of the sender. Apart from
    that roles are not asked for: in DR modes they are free, and ArduPilot's simulator leaves them 0.

    Tag_Frame0 and Anchor_Frame0 repeat the last distance when a range fails and do not say so: to find
    that out is left to the estimator.

    Args:
        frame: any frame; those without ranges give nothing.
        stamp_ns: when it was measured.

    Source: LinkTrack User Manual V2.3, chapter 7.
    """
    found: list[Measurement] = []
    if isinstance(frame, _NodeList):
        found += _ranges_to_nodes(frame, stamp_ns)
    elif isinstance(frame, TagFrame0):
        found += _ranges_to_anchors(frame.id, enumerate(frame.dis), stamp_ns)
    elif isinstance(frame, AnchorFrame0):
        for tag in frame.nodes:
            found += _ranges_to_anchors(tag.id, enumerate(tag.dis), stamp_ns)
    elif isinstance(frame, NodeFrame4):
        for ranges in frame.tags:
            if ranges.id != VOID_ID:
                found += _ranges_to_anchors(ranges.id, ranges.anchors, stamp_ns)
    if isinstance(frame, TagState):
        found += _inertial(frame, stamp_ns)
    return found


def _ranges_to_nodes(frame: _NodeList, stamp_ns: int) -> list[RangeFrame]:
    # Of 32 bits, 255 is an id like any other.
    void_id = None if isinstance(frame, NodeFrame5) else VOID_ID
    nodes = [node for node in frame.nodes if node.dis > 0 and node.id != void_id]
    found: list[RangeFrame] = []
    if frame.role in _HEARING_TAGS:
        heard = [node for node in nodes if node.role == Role.TAG]
        nodes = [node for node in nodes if node.role != Role.TAG]
        found = [_range_frame(stamp_ns, tag.id, [frame.id], [tag]) for tag in heard]
    if nodes:
        found.append(_range_frame(stamp_ns, frame.id, [node.id for node in nodes], nodes))
    return found


def _range_frame(
    stamp_ns: int, tag_id: int, anchor_ids: Sequence[int], ranges: Sequence[NodeRange | AoaNodeRange]
) -> RangeFrame:
    # Both kinds begin with role, id and distance and end in the powers.
    _, _, dis, *_, fp_rssi, rx_rssi = zip(*ranges, strict=True)
    return RangeFrame(
        stamp_ns, tag_id, np.array(anchor_ids), np.array(dis), np.array(rx_rssi), np.array(fp_rssi)
    )


def _ranges_to_anchors(tag_id: int, ranges: Iterable[tuple[int, float]], stamp_ns: int) -> list[RangeFrame]:
    usable = [(id_, dis) for id_, dis in ranges if dis > 0 and id_ != VOID_ID]
    if not usable:
        return []
    ids, distances = zip(*usable, strict=True)
    no_power = np.full((2, len(usable)), math.nan)
    return [RangeFrame(stamp_ns, tag_id, np.array(ids), np.array(distances), *no_power)]


def _inertial(state: TagState, stamp_ns: int) -> list[ImuSample | Attitude]:
    found: list[ImuSample | Attitude] = []
    inertial = state.gyro + state.acc
    # The sum of float32 is finite when each of them is.
    if math.isfinite(sum(inertial)) and any(inertial):
        found.append(ImuSample(stamp_ns, np.array(state.gyro), np.array(state.acc)))
    w, x, y, z = state.quat_wxyz
    norm = math.hypot(w, x, y, z)
    if abs(norm - 1) <= 1e-2:  # false for NaN
        found.append(Attitude(stamp_ns, np.array((w / norm, x / norm, y / norm, z / norm))))
    return found
