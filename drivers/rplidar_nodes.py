"""RPLIDAR samples that carry their own direction: standard nodes and HQ packets, encoded and decoded.

No I/O and no time. Integers carry their scale as in `drivers.rplidar_protocol`.

Source: Slamtec interface protocol rev 2.2, figure 4-4; rplidar_sdk @99478e5 handler_hqnode.cpp, sl_crc.cpp.
"""

import re
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from estimators.messages import IntArray

BoolArray: TypeAlias = NDArray[np.bool_]
ByteArray: TypeAlias = NDArray[np.uint8]
Numbers: TypeAlias = Sequence[int] | IntArray

TURN_Q6 = 360 << 6
NODE = np.dtype([("flags", "u1"), ("angle", "<u2"), ("distance", "<u2")])
"""A standard node: quality above the guard bits S and not S, angle_q6 above one that is 1, distance_q2."""
NodeArray: TypeAlias = NDArray[np.void]
Angles: TypeAlias = NDArray[np.uint16]
"""Angles within a turn (q6), which 16 bits can hold."""

_GUARDED = np.isin(np.arange(256) & 3, (1, 2))
"""By the first byte of a standard node: whether it is S or not S, and not both."""
_HQ_NODE = np.dtype([("angle", "<u2"), ("distance", "<u4"), ("quality", "u1"), ("flags", "u1")])
_HQ_HEAD_BYTES = 9
_HQ_CRC_BYTES = 4
_HQ_CRC_PADDING = bytes(3)  # the CRC runs over whole words of four bytes
_Q14 = (np.arange(2 * TURN_Q6) % TURN_Q6 << 8) // 90


class Columns(NamedTuple):
    """Consecutive samples, in the order they were taken.

    Attributes:
        angle_q14: (N,) int64 [90/16384 deg], clockwise from forward.
        distance_q2: (N,) int64 [mm/4]; 0 where nothing came back.
        quality: (N,) int64, 0..255 as the SDK gives it: in standard scans the device's 0..63 times 4; in
            express, ultra and dense packets, which carry none, 188 with a return and 0 without.
    """

    angle_q14: IntArray
    distance_q2: IntArray
    quality: IntArray

    def decoded(self) -> "Columns":
        """See `Batch`."""
        return self


class Batch(Protocol):
    """Consecutive samples that may still wait, as packets, to be decoded: all at once costs much less."""

    def decoded(self) -> Columns:
        """The samples that it has; after this it gets no more."""
        ...


@dataclass(slots=True)
class Run:
    """Packets that follow each other.

    Attributes:
        packet: index of the first one.
        batch: has their samples.
        at: index of the first one there.
        count: how many they are.
        starts: indices among them of those that begin a revolution, ascending.
    """

    packet: int
    batch: Batch
    at: int
    count: int
    starts: list[int]


def to_q14(angle_q6: IntArray | Angles) -> IntArray:
    """Angles from -2 to 2 turns [1/64 deg] in [90/16384 deg], wrapped and rounded as the SDK does."""
    return _Q14.take(angle_q6)


def bounded(name: str, values: Numbers, count: int, largest: int) -> IntArray:
    """Values for an encoder, (count,) int64.

    Raises:
        ValueError: another number of them, or one below 0 or above the largest.
    """
    array = np.asarray(values, np.int64)
    if array.shape != (count,):
        raise ValueError(f"{name}: {array.size} values, {count} are needed")
    if array.min() < 0 or array.max() > largest:
        raise ValueError(f"{name}: {array.min()}..{array.max()} is not within 0..{largest}")
    return array


def encode_standard_node(angle_q6: int, distance_q2: int, quality: int, start: bool) -> bytes:
    """One sample of a standard scan; quality is 0..63. Source: protocol figure 4-4."""
    return struct.pack("<BHH", quality << 2 | (1 if start else 2), angle_q6 << 1 | 1, distance_q2)


def node_angles(nodes: NodeArray) -> tuple[Angles, BoolArray]:
    """Angle (q6) of standard nodes, and whether guard bits and angle can be a node's."""
    words = nodes["angle"].copy()  # contiguous: several quick steps follow
    angle_q6: Angles = words // np.uint16(2)  # NumPy is slower at shifts
    return angle_q6, _GUARDED.take(nodes["flags"]) & (words & 1 == 1) & (angle_q6 < TURN_Q6)


def encode_hq_packet(
    device_time: int, angles_q14: Numbers, distances_q2: Numbers, qualities: Numbers, starts: Sequence[bool]
) -> bytes:
    """Packet of an HQ scan.

    Args:
        device_time: the device's own clock, in a unit that the vendor does not tell.
        angles_q14: 96 values of 0..65535 [90/16384 deg].
        distances_q2: 96 values below 2^32 [mm/4].
        qualities: 96 values of 0..255.
        starts: 96 values, True at the first sample of a revolution.

    Raises:
        ValueError: a value out of its limits.

    Source: rplidar_sdk sl_lidar_cmd.h, sl_crc.cpp.
    """
    count = HqPackets.SAMPLES
    nodes = np.empty(count, _HQ_NODE)
    nodes["angle"] = bounded("angles_q14", angles_q14, count, 0xFFFF)
    nodes["distance"] = bounded("distances_q2", distances_q2, count, 0xFFFFFFFF)
    nodes["quality"] = bounded("qualities", qualities, count, 0xFF)
    nodes["flags"] = np.where(starts, 1, 2)
    body = struct.pack("<BQ", 0xA5, device_time) + nodes.tobytes()
    return body + struct.pack("<I", _hq_crc(body))


class HqPackets:
    """Packets of an HQ scan; each is decoded on its own."""

    PACKET_BYTES: ClassVar = 781
    SAMPLES: ClassVar = 96
    WAITING: ClassVar = 0
    BEGINNING: ClassVar = re.compile(rb"\xa5")

    def restart(self) -> None:
        """Forget the packets before."""

    def found(self, data: bytes) -> BoolArray:
        """Whether a packet begins at each byte that has room for one."""
        found: BoolArray = np.zeros(max(0, len(data) - self.PACKET_BYTES + 1), np.bool_)
        at = data.find(0xA5, 0, len(found))
        while at >= 0:
            end = at + self.PACKET_BYTES
            crc = int.from_bytes(data[end - _HQ_CRC_BYTES : end], "little")
            found[at] = crc == _hq_crc(data[at : end - _HQ_CRC_BYTES])
            at = data.find(0xA5, at + 1, len(found))
        return found

    def runs(self, data: bytes) -> list[Run]:
        """Whole packets, as one run."""
        packets = np.frombuffer(data, np.uint8).reshape(-1, self.PACKET_BYTES)
        nodes = packets[:, _HQ_HEAD_BYTES:-_HQ_CRC_BYTES].copy().view(_HQ_NODE).ravel()
        columns = Columns(*(nodes[name].astype(np.int64) for name in ("angle", "distance", "quality")))
        return [Run(0, columns, 0, len(nodes), (nodes["flags"] & 1).nonzero()[0].tolist())]


def _hq_crc(body: bytes) -> int:
    return zlib.crc32(body + _HQ_CRC_PADDING)
