"""What an emulated RPLIDAR measured, in the packets of each of its scan modes."""

import numpy as np

from drivers.rplidar_capsules import encode_dense_capsule, encode_express_capsule
from drivers.rplidar_nodes import TURN_Q6, BoolArray, encode_hq_packet, encode_standard_node
from drivers.rplidar_protocol import PACKET_SAMPLES, AnswerType
from drivers.rplidar_ultra import encode_ultra_capsule, encode_ultra_dense_capsule, ultra_offset_q16
from estimators.messages import FloatArray, IntArray

OPTICS_Q3 = 60
"""Offset of every express sample: about what the optics of an A2 give beyond a metre or two [1/8 deg]."""
OPTICS = float(np.deg2rad(OPTICS_Q3 / 8))
"""The same [rad]; in ultra mode the head is ahead of the nominal direction by it."""
_NODE_QUALITY, _QUALITY = 15, 188
_FARTHEST_MM = {  # what the packets can tell
    AnswerType.STANDARD_SCAN: 16_383,
    AnswerType.EXPRESS_SCAN: 16_383,
    AnswerType.ULTRA_SCAN: 28_656,
    AnswerType.DENSE_SCAN: 65_535,
    AnswerType.ULTRA_DENSE_SCAN: 65_522,
    AnswerType.HQ_SCAN: 100_000,
}


def ultra_offset(distances: FloatArray) -> FloatArray:
    """Angle from the beam of an ultra sample to the head's direction [rad], for distances [m]."""
    offset: FloatArray = np.deg2rad(ultra_offset_q16(_millimetres(AnswerType.ULTRA_SCAN, distances)) / 65536)
    return offset


def encode_samples(kind: AnswerType, turns: FloatArray, distances: FloatArray, is_first: bool) -> bytes:
    """Packets of consecutive samples.

    Args:
        kind: of the packets.
        turns: (N + 1,) turns of the head, clockwise from forward, before the first sample and at each one;
            N is a multiple of the packet's samples.
        distances: (N,) [m], 0 = no return; for ultra one more, the first of the packet after.
        is_first: whether these are the first samples of the scan.
    """
    directions = 360.0 * (turns[1:] % 1.0)
    starts = np.diff(np.floor(turns)) > 0.0
    if kind is AnswerType.STANDARD_SCAN:
        quarters = np.rint(np.where(distances * 1000 <= _FARTHEST_MM[kind], distances, 0.0) * 4000).astype(
            int
        )
        return b"".join(
            encode_standard_node(
                int(direction * 64) % TURN_Q6, quarter, _NODE_QUALITY if quarter else 0, start
            )
            for direction, quarter, start in zip(
                directions.tolist(), quarters.tolist(), starts.tolist(), strict=True
            )
        )
    group = PACKET_SAMPLES[kind]
    millimetres = _millimetres(kind, distances)
    return b"".join(
        _packet(
            kind,
            directions[i : i + group],
            millimetres[i : i + group + 1],
            starts[i : i + group],
            is_first and i == 0,
        )
        for i in range(0, len(directions), group)
    )


def _packet(
    kind: AnswerType, directions: FloatArray, millimetres: IntArray, starts: BoolArray, is_first: bool
) -> bytes:
    """One packet; one more distance than its samples for ultra, of which the others take no notice."""
    group = len(directions)
    own = millimetres[:group]
    start_q6 = round(directions[0] * 64) % TURN_Q6
    ahead_q6 = (start_q6 + OPTICS_Q3 * 8) % TURN_Q6
    qualities = np.where(own, _QUALITY, 0)
    match kind:
        case AnswerType.EXPRESS_SCAN:
            return encode_express_capsule(ahead_q6, is_first, own, [OPTICS_Q3] * group)
        case AnswerType.ULTRA_SCAN:
            return encode_ultra_capsule(ahead_q6, is_first, own, int(millimetres[group]))
        case AnswerType.DENSE_SCAN:
            return encode_dense_capsule(start_q6, is_first, own)
        case AnswerType.ULTRA_DENSE_SCAN:
            return encode_ultra_dense_capsule(start_q6, is_first, own, qualities, 0)
        case _:
            angles_q14 = np.rint(directions / 360.0 * 65536).astype(np.int64) % 65536
            return encode_hq_packet(0, angles_q14, 4 * own, qualities, starts.tolist())


def _millimetres(kind: AnswerType, distances: FloatArray) -> IntArray:
    """Distances in millimetres, those that the packets cannot tell as no return."""
    told = np.where(distances * 1000 <= _FARTHEST_MM[kind], distances, 0.0)
    millimetres: IntArray = np.rint(told * 1000).astype(np.int64)
    return millimetres
