"""Nooploop LinkTrack UWB modules: the NLink byte stream to ranges, inertial samples and attitude.

A module streams by itself (921600 baud, 8N1), several frame types on one port. The three types that hold a
node's own ranges become measurements; every other known type is skipped as a whole, so that nothing it
carries is taken for a frame.

Source: LinkTrack User Manual V2.3, chapters 7 and 8.
"""

import math
from typing import ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from drivers.framing import ByteBuffer, DecodeStats
from drivers.linktrack_frames import (
    FRAME_START,
    VOID_ID,
    Frame,
    TagFrame0,
    TagState,
    decode_checked,
    extent,
    has_right_end,
)
from estimators.messages import Attitude, ImuSample, Measurement, RangeFrame


class LinkTrack:
    """Sensor: ranges, and from models with an inertial chip its samples and attitude."""

    class Config(BaseModel):
        """Settings of one module."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        latency_ms: float = Field(
            0.0, ge=0, le=1000, description="time from the ranging to the arrival of its frame [ms]"
        )

    MEASURES: ClassVar[frozenset[type]] = frozenset({RangeFrame, ImuSample, Attitude})

    def __init__(self, config: Config) -> None:
        self.stats = DecodeStats()
        self._latency_ns = round(config.latency_ms * 1e6)
        self._buffer = ByteBuffer(self.stats)

    def feed(self, data: bytes, stamp_ns: int) -> list[Measurement]:
        """Measurements of the frames that `data` completes; `stamp_ns` is its arrival."""
        measured_ns = stamp_ns - self._latency_ns
        return [m for frame in self.frames(data) for m in measurements(frame, measured_ns)]

    def frames(self, data: bytes) -> list[Frame]:
        """The whole frames that `data` completes, in order; for those who want more than measurements."""
        self._buffer.push(data)
        found: list[Frame] = []
        while True:
            waiting = self._buffer.view
            start = FRAME_START.search(waiting)
            self._buffer.skip(start.start() if start else len(waiting))
            length = extent(waiting)
            if length is not None and length > len(waiting):
                return found
            if length is None or not has_right_end(waiting[:length]):
                # A good frame may start inside this false one, so only its first byte goes.
                self.stats.bad += 1
                self._buffer.skip(1)
                continue
            frame = decode_checked(self._buffer.take(length))
            if frame is None:
                self.stats.other += 1
            else:
                self.stats.good += 1
                found.append(frame)

    def connected(self, now_ns: int) -> None:
        """Nothing to start: the module streams by itself."""

    def poll(self, now_ns: int) -> bytes:  # noqa: ARG002
        """Nothing to ask; a wrong write can disable a module."""
        return b""

    def closing(self) -> bytes:
        """Nothing to stop."""
        return b""


def measurements(frame: Frame, stamp_ns: int) -> list[Measurement]:
    """What a frame measured at `stamp_ns`: usable ranges, inertial sample, attitude.

    A range counts when it is above zero and its block is not void. The role is not asked for: in DR modes it
    is free, and ArduPilot's simulator leaves it 0.
    """
    if isinstance(frame, TagFrame0):
        rows = [(k, dis, math.nan, math.nan) for k, dis in enumerate(frame.dis)]
    else:
        rows = [(n.id, n.dis, n.rx_rssi, n.fp_rssi) for n in frame.nodes if n.id != VOID_ID]
    rows = [row for row in rows if row[1] > 0]
    found: list[Measurement] = []
    if rows:
        ids, ranges, rx_power, fp_power = (np.array(column) for column in zip(*rows, strict=True))
        found.append(RangeFrame(stamp_ns, frame.id, ids, ranges, rx_power, fp_power))
    if isinstance(frame, TagState):
        inertial = frame.gyro + frame.acc
        if all(map(math.isfinite, inertial)) and any(inertial):
            found.append(ImuSample(stamp_ns, np.array(frame.gyro), np.array(frame.acc)))
        norm = math.hypot(*frame.quat_wxyz)
        if abs(norm - 1) <= 1e-2:  # false for NaN
            found.append(Attitude(stamp_ns, np.array(frame.quat_wxyz) / norm))
    return found
