"""RPLIDAR capsules of the modes ultra (boost, sensitivity, stability) and ultra-dense, encoded and decoded.

No I/O and no time. Integers carry their scale as in `drivers.rplidar_protocol`.

Source: rplidar_sdk @99478e5 handler_capsules.cpp; Slamtec interface protocol rev 2.2, figures 4-15 to 4-17.
"""

import struct

import numpy as np

from drivers.rplidar_capsules import Capsules, framed, quality_of, start_word
from drivers.rplidar_nodes import BoolArray, ByteArray, Numbers, bounded
from estimators.messages import IntArray

# Distances of 12 bits: from each of these codes on, steps of 1, 2, 4, 8, 16 mm (level 0 to 4).
_LEVEL_CODE = np.array([0, 512, 1280, 1792, 3328])
_LEVEL_MM = np.array([0, 512, 2048, 4096, 16384])
_MAJOR = np.arange(4096)
_MAJOR_LEVEL = np.searchsorted(_LEVEL_CODE, _MAJOR, side="right") - 1
_MAJOR_MM = _LEVEL_MM[_MAJOR_LEVEL] + ((_MAJOR - _LEVEL_CODE[_MAJOR_LEVEL]) << _MAJOR_LEVEL)
_LEVEL_BITS, _LEVEL_MASK = 3, 7
_MAJOR_PACKED = _MAJOR_MM << _LEVEL_BITS | _MAJOR_LEVEL  # both in one look-up; 0 stands for no return alone
_MAJOR_MIDDLES = (_MAJOR_MM[:-1] + _MAJOR_MM[1:]) / 2
_NO_RETURN = -512  # the difference that says so; 511 does too
_MAX_DIFFERENCE = 510

# Distances of ultra-dense packets: steps of 2, 3, 4, 5 mm (scale 0 to 3) from each of these on.
_SCALE_MM = np.array([0, 2046, 8187, 24567])
_SCALE_Q2 = _SCALE_MM << 2
_SCALE_END_MM = 65522
_SMOOTHED_Q2 = 8  # the SDK takes the mean of a near distance and the one before if they differ by no more
_ULTRA_BODY = 4  # where the samples begin, after sync, checksum and direction
_ULTRA_WORDS = 32
_ULTRA_DENSE_BODY = 10  # the same, after device time and status as well
_ULTRA_DENSE_CABIN = np.dtype([("words", "<u2", (2,)), ("high", "u1")])  # two samples


class UltraCapsules(Capsules):
    """Ultra: 96 samples in threes, one rounded and two told by their difference to a rounded one."""

    PACKET_BYTES = 132
    SAMPLES = 96
    _SLOWEST_SAMPLE_US = 200

    def measure(
        self,
        packets: ByteArray,
        before_q2: int,  # noqa: ARG002
    ) -> tuple[IntArray, IntArray, IntArray | None]:
        """See `Capsules`."""
        words = packets[:, _ULTRA_BODY:].copy().view("<i4").ravel()
        words = words[: (len(packets) - 1) * _ULTRA_WORDS + 1].astype(np.int64)
        rounded = _MAJOR_PACKED.take(words & 0xFFF)
        own, following = rounded[:-1], rounded[1:]
        # The last of three comes just before the next rounded one, and is told from that.
        base, difference = np.empty((2, 2, len(own)), np.int64)
        base[0] = np.where(own == 0, following, own)
        base[1] = following
        np.left_shift(words[:-1], 42, out=difference[0])
        difference[0] >>= 54
        np.right_shift(words[:-1], 22, out=difference[1])
        predicted = (base >> _LEVEL_BITS) + (difference << (base & _LEVEL_MASK))
        predicted[(difference ^ difference >> 63) == ~_NO_RETURN] = 0
        threes = np.empty((len(own), 3), np.int64)
        threes[:, 0] = own >> _LEVEL_BITS
        # Below 0 cannot be.
        np.maximum(predicted.T, 0, out=threes[:, 1:])
        distance_mm = threes.ravel()
        distance_q2 = distance_mm << 2
        return distance_q2, quality_of(distance_q2), ultra_offset_q16(distance_mm)


def _offsets_q16(distance_mm: IntArray) -> IntArray:
    k = 98361 // np.maximum(4 * distance_mm, 200)
    radians_q16 = np.where(distance_mm < 50, 8578, 9150 - (k << 6) - k**3 // 98304)
    return np.trunc(radians_q16 * 180 / 3.14159265).astype(np.int64)


_OFFSET_Q16 = _offsets_q16(np.arange(_MAJOR_MM[-1] + (_MAX_DIFFERENCE << 4) + 1))


def ultra_offset_q16(distance_mm: IntArray) -> IntArray:
    """Angle by which the beam of an ultra sample is behind the head's direction [1/65536 deg].

    Args:
        distance_mm: (N,) 0..36816.

    Returns:
        (N,): 8 deg for far targets, less for near ones, below 0 for those nearer than 0.17 m; 7.5 deg for
        no return.

    Source: rplidar_sdk handler_capsules.cpp.
    """
    return _OFFSET_Q16[distance_mm]


def encode_ultra_capsule(
    start_angle_q6: int, start_flag: bool, distances_mm: Numbers, next_distance_mm: int
) -> bytes:
    """Packet of 96 samples of an ultra scan.

    Steps grow with the distance from 1 to 16 mm. Where two of the three distances that share a word lie too
    far apart (0.5 m for targets within 0.5 m, 4 m for those beyond 4 m), one becomes 0, no return.

    Args:
        start_angle_q6: 0..23039, direction of the head when its first sample was taken.
        start_flag: True on the first packet after a request, or after the encoder was restarted.
        distances_mm: 96 values of 0..28656.
        next_distance_mm: the first one of the next packet.

    Raises:
        ValueError: a value out of its limits.

    Source: rplidar_sdk handler_capsules.cpp; protocol figures 4-15 to 4-17.
    """
    largest = int(_MAJOR_MM[-1])
    distances = bounded("distances_mm", distances_mm, UltraCapsules.SAMPLES, largest).reshape(-1, 3)
    following = bounded("next_distance_mm", [next_distance_mm], 1, largest)
    major = np.searchsorted(_MAJOR_MIDDLES, np.append(distances[:, 0], following))
    mm, level = _MAJOR_MM[major], _MAJOR_LEVEL[major]
    base = np.where(mm[:-1] == 0, mm[1:], mm[:-1])
    base_level = np.where(mm[:-1] == 0, level[1:], level[:-1])
    predict1 = _differences(distances[:, 1], base, base_level)
    predict2 = _differences(distances[:, 2], mm[1:], level[1:])
    words = major[:-1] | (predict1 & 0x3FF) << 12 | (predict2 & 0x3FF) << 22
    return framed(start_word(start_angle_q6, start_flag) + words.astype("<u4").tobytes())


def _differences(distance_mm: IntArray, base: IntArray, level: IntArray) -> IntArray:
    difference = np.rint((distance_mm - base) / (1 << level)).astype(np.int64)
    told = (distance_mm > 0) & (np.abs(difference) <= _MAX_DIFFERENCE)
    return np.where(told, difference, _NO_RETURN)


class UltraDenseCapsules(Capsules):
    """Ultra-dense: 64 samples with quality, in steps that grow with the distance."""

    PACKET_BYTES = 170
    SAMPLES = 64
    _ANGLE_AT = 8
    _SLOWEST_SAMPLE_US = 125

    def measure(self, packets: ByteArray, before_q2: int) -> tuple[IntArray, IntArray, IntArray | None]:
        """See `Capsules`."""
        cabins = packets[:-1, _ULTRA_DENSE_BODY:].copy().view(_ULTRA_DENSE_CABIN).ravel()
        values = cabins["words"].astype(np.int64)
        high = cabins["high"].astype(np.int64)
        values[:, 0] |= (high & 15) << 16
        values[:, 1] |= (high >> 4) << 16
        values = values.ravel()
        scale = values & 3
        quality = (values >> (12 + scale)) << scale
        distance_q2 = (values & ((0x1000 << scale) - 4)) * (2 + scale) + _SCALE_Q2[scale]
        _smooth(distance_q2, scale == 0, before_q2)
        return distance_q2, quality, None


def _smooth(distance_q2: IntArray, near: BoolArray, before_q2: int) -> None:
    """Take the mean with the (smoothed) distance before where it differs little; in place."""
    # Near distances are told in steps of the limit, and smoothing moves them by half of it at most: what
    # is farther from the one before as it was told is also farther from it as it was smoothed.
    steps = np.abs(np.diff(distance_q2, prepend=before_q2))
    candidates = np.flatnonzero(near & (steps <= _SMOOTHED_Q2)).tolist()
    if candidates:
        values = distance_q2.tolist()
        values.append(before_q2)  # it is before the first one, at index -1
        for i in candidates:
            if values[i - 1] and abs(values[i] - values[i - 1]) <= _SMOOTHED_Q2:
                values[i] = (values[i] + values[i - 1]) >> 1
        distance_q2[:] = values[:-1]


def encode_ultra_dense_capsule(
    start_angle_q6: int, start_flag: bool, distances_mm: Numbers, qualities: Numbers, device_time: int
) -> bytes:
    """Packet of 64 samples of an ultra-dense scan.

    Steps grow with the distance from 2 to 5 mm for distances and from 1 to 8 for qualities.

    Args:
        start_angle_q6: 0..23039, direction when its first sample was taken.
        start_flag: True on the first packet after a request, or after the encoder was restarted.
        distances_mm: 64 values of 0..65522.
        qualities: 64 values of 0..255.
        device_time: the device's own clock (u32), in a unit that the vendor does not tell.

    Raises:
        ValueError: a value out of its limits.

    Source: rplidar_sdk handler_capsules.cpp.
    """
    count = UltraDenseCapsules.SAMPLES
    distances = bounded("distances_mm", distances_mm, count, _SCALE_END_MM)
    quality = bounded("qualities", qualities, count, 0xFF)
    scale = np.searchsorted(_SCALE_MM[1:], distances, side="left")
    codes = np.rint((distances - _SCALE_MM[scale]) / (2 + scale)).astype(np.int64)
    values = (scale | codes << 2 | (quality >> scale) << (12 + scale)).reshape(-1, 2)
    cabins = np.empty(count // 2, _ULTRA_DENSE_CABIN)
    cabins["words"] = values & 0xFFFF
    cabins["high"] = values[:, 0] >> 16 | (values[:, 1] >> 16) << 4
    head = struct.pack("<IH", device_time, 0) + start_word(start_angle_q6, start_flag)
    return framed(head + cabins.tobytes())
