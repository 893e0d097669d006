"""RPLIDAR answers and scan streams out of damaged bytes: descriptors found, packets checked, gaps known.

No I/O and no time. Source: rplidar_sdk @99478e5; where we keep more good samples than it, the docstrings
say how.
"""

import re

import numpy as np

from drivers.framing import ByteBuffer, DecodeStats
from drivers.rplidar_protocol import (
    CAPSULE_BYTES,
    NODE_BYTES,
    PACKET_BYTES,
    PACKET_SAMPLES,
    TURN_Q6,
    AnswerType,
    BoolArray,
    Event,
    Samples,
    ScanStarted,
    decode_answer,
    decode_express_capsule,
    descriptor_bytes,
    encode_descriptor,
    span_q6,
    to_q14,
    xor_checksum,
)
from estimators.messages import IntArray

_UNREAD_SCANS = {0x84: 132, 0x85: 84, 0x86: 170}  # type -> packet bytes: they end what ran before
_DESCRIPTOR = re.compile(
    b"|".join(
        re.escape(descriptor)
        for descriptor in (
            *(encode_descriptor(answer_type) for answer_type in AnswerType),
            *(descriptor_bytes(size, True, type_byte) for type_byte, size in _UNREAD_SCANS.items()),
        )
    )
)
_DESCRIPTOR_BYTES = 7
_CAPSULE_START = re.compile(rb"[\xa0-\xaf](?:[\x50-\x5f]|\Z)")
_MAX_SPAN_Q6 = 120 << 6  # 32 samples at 1000/s and 10 rev/s; real devices stay below 45 deg
# A standard node's direction is corrected for the distance, so it jumps by up to 9 deg either way
# between a return and none (seen on a real A1), on top of the step, which is 0.3 to 6 deg.
_MAX_FALL_Q6 = 10 << 6
_MAX_RISE_Q6 = 20 << 6
_TRUSTED_NODES = 4  # this many in a row end a search; by chance random bytes pass once in some 10^6
_WINDOW = 1000  # bytes looked at in one go, so that badly damaged input costs linear time


def _node_angles(b0: IntArray, b1: IntArray, b2: IntArray) -> tuple[IntArray, BoolArray]:
    """Angle (q6) of nodes from their first three bytes, and whether these can be a node's."""
    angle_q6 = b1 >> 1 | b2 << 7
    return angle_q6, ((b0 ^ b0 >> 1) & b1 & 1 == 1) & (angle_q6 < TURN_Q6)


def _rises(step_q6: IntArray) -> BoolArray:
    return (step_q6 + _MAX_FALL_Q6) % TURN_Q6 <= _MAX_FALL_Q6 + _MAX_RISE_Q6


class AnswerDecoder:
    """Bytes from the device to answers and samples, however they are chunked.

    What follows is known from the descriptors alone, never from what was asked, so the incoming half of
    a recorded link is enough. A descriptor is 7 exact bytes. Where are such bytes one, and not data?

    - Outside a stream: anywhere. Leftovers, banner text and answers of other types are skipped.
    - In a standard stream: where the nodes break, from the last 4 bytes of the last node on, because a
      stream cut inside a node makes it swallow them. A descriptor always breaks the nodes: at a node's
      place by its even second byte 5A, inside a node by the guard bits of the next node. One exception:
      those of health and of standard scan, begun on a node's last byte, read like a node at 1/64 or
      2/64 deg; they are data if the angle was just there.
    - In an express stream: where a packet should begin, and anywhere after damage. Inside a packet whose
      checksum holds they are data. At a packet's place they win over the packet that begins with the
      same 48 bits of content, because waiting for its checksum would hold back short answers.
    """

    def __init__(self, stats: DecodeStats) -> None:
        self._stats = stats
        self._buffer = ByteBuffer(stats)
        self._fed = 0
        self._expected: AnswerType | None = None
        self._gap = False
        self._nodes_trusted = True
        self._last_angle_q6: int | None = None
        self._last_node_tail = b""
        self._pending: bytes | None = None  # capsule that waits for the next one
        self._pending_end = 0

    def feed(self, data: bytes) -> list[Event]:
        """Events completed by these bytes; never raises on any bytes."""
        self._buffer.push(data)
        self._fed += len(data)
        events: list[Event] = []
        while self._step(events):
            pass
        return events

    def discard(self) -> None:
        """Drop what waits for the rest of its packet: the device fell quiet, the rest will not come."""
        self._buffer.skip(len(self._buffer))
        self._lose()
        if self._expected not in PACKET_SAMPLES:
            self._expected = None

    def _step(self, events: list[Event]) -> bool:
        """Take one thing from the buffer; False when it needs more bytes."""
        if self._expected is None:
            return self._find_descriptor(events)
        if self._expected is AnswerType.STANDARD_SCAN:
            return self._take_nodes(events) if self._nodes_trusted else self._find_nodes(events)
        if self._expected is AnswerType.EXPRESS_SCAN:
            return self._take_capsule(events)
        return self._take_answer(self._expected, events)

    def _begin(self, descriptor: bytes, events: list[Event]) -> None:
        """Any descriptor ends what ran before and says what follows."""
        self._lose()
        if descriptor[-1] in _UNREAD_SCANS:
            self._stats.other += 1
            self._expected = None
            return
        self._expected = AnswerType(descriptor[-1])
        if self._expected in PACKET_SAMPLES:
            events.append(ScanStarted(self._expected))
            self._gap = False
            self._nodes_trusted = True

    def _lose(self) -> None:
        """Nothing that comes next continues what came before."""
        self._gap = True
        self._nodes_trusted = False
        self._last_angle_q6 = None
        self._last_node_tail = b""
        self._pending = None

    def _find_descriptor(self, events: list[Event]) -> bool:
        descriptor = _DESCRIPTOR.search(self._buffer.view)
        if descriptor is None:
            self._buffer.skip(len(self._buffer) - _DESCRIPTOR_BYTES + 1)
            return False
        self._buffer.skip(descriptor.start())
        self._begin(self._buffer.take(_DESCRIPTOR_BYTES), events)
        return True

    def _take_answer(self, answer_type: AnswerType, events: list[Event]) -> bool:
        if len(self._buffer) < PACKET_BYTES[answer_type]:
            return False
        self._expected = None
        answer = decode_answer(answer_type, self._buffer.take(PACKET_BYTES[answer_type]))
        if answer is None:
            self._stats.bad += 1
        else:
            self._stats.good += 1
            events.append(answer)
        return True

    def _take_nodes(self, events: list[Event]) -> bool:
        """Take all nodes up to the first that does not continue the stream."""
        count = min(len(self._buffer), _WINDOW) // NODE_BYTES
        if count == 0:
            return False
        raw = np.frombuffer(self._buffer.view, np.uint8, count * NODE_BYTES).astype(np.int64).reshape(-1, 5)
        angle_q6, good = _node_angles(raw[:, 0], raw[:, 1], raw[:, 2])
        before_q6 = angle_q6[0] if self._last_angle_q6 is None else self._last_angle_q6
        good &= _rises(np.diff(angle_q6, prepend=before_q6))
        taken = count if good.all() else int(np.argmin(good))
        if taken:
            raw, angle_q6 = raw[:taken], angle_q6[:taken]
            self._last_node_tail = self._buffer.take(taken * NODE_BYTES)[1 - NODE_BYTES :]
            self._last_angle_q6 = int(angle_q6[-1])
            self._stats.good += taken
            distance_q2, starts = raw[:, 3] | raw[:, 4] << 8, raw[:, 0] & 1 == 1
            end = self._fed - len(self._buffer)
            angle_q14, quality = to_q14(angle_q6), raw[:, 0] >> 2 << 2
            scan_type = AnswerType.STANDARD_SCAN
            events.append(Samples(scan_type, angle_q14, distance_q2, quality, starts, self._gap, end))
            self._gap = False
        if taken < count:
            self._stats.bad += 1
            self._gap = True
            self._nodes_trusted = False
        return True

    def _find_nodes(self, events: list[Event]) -> bool:
        """After damage: skip to the next run of nodes that fit each other, or to a descriptor.

        Whichever is complete first wins, so that the result does not depend on the chunks.
        """
        window = bytes(self._buffer.view[:_WINDOW])
        run_bytes = _TRUSTED_NODES * NODE_BYTES
        run = _find_run(window)
        descriptor = _DESCRIPTOR.search(self._last_node_tail + window)
        if descriptor is not None:
            end = descriptor.end() - len(self._last_node_tail)
            if run is None or end <= run + run_bytes:
                self._buffer.skip(end - _DESCRIPTOR_BYTES)
                self._buffer.take(min(end, _DESCRIPTOR_BYTES))
                self._begin(descriptor[0], events)
                return True
        if run is not None:
            self._buffer.skip(run)
            self._nodes_trusted = True
            self._last_angle_q6 = None
            return True
        refused = len(window) - run_bytes + 1
        if refused <= 0:
            return False
        self._buffer.skip(refused)
        self._last_node_tail = b""
        return True

    def _take_capsule(self, events: list[Event]) -> bool:
        view = self._buffer.view
        candidate = _CAPSULE_START.search(view)
        if (skipped := candidate.start() if candidate else len(view)) > 0:
            self._buffer.skip(skipped)
            self._lose()
        if _DESCRIPTOR.match(view):
            self._begin(self._buffer.take(_DESCRIPTOR_BYTES), events)
            return True
        if len(view) < CAPSULE_BYTES:
            return False
        if xor_checksum(view[2:CAPSULE_BYTES]) != view[0] & 15 | (view[1] & 15) << 4:
            self._stats.bad += 1
            self._buffer.skip(1)
            self._lose()
            return True
        previous, previous_end = self._pending, self._pending_end
        capsule = self._buffer.take(CAPSULE_BYTES)
        self._stats.good += 1
        self._pending, self._pending_end = capsule, self._fed - len(self._buffer)
        if previous is None:
            return True
        # S says that the encoder was restarted; no rotation or too much of it, that packets were
        # repeated or lost whole. Such a pair has no common scale of angles.
        if capsule[3] & 0x80 or not 0 < span_q6(previous, capsule) <= _MAX_SPAN_Q6:
            self._gap = True
            return True
        decoded = decode_express_capsule(previous, capsule)
        events.append(Samples(AnswerType.EXPRESS_SCAN, *decoded, self._gap, previous_end))
        self._gap = False
        return True


def _find_run(data: bytes) -> int | None:
    """Offset of the first node that begins a run of trustworthy nodes; None when there is none."""
    if len(data) < _TRUSTED_NODES * NODE_BYTES:
        return None
    # angles of nodes at every byte offset that has room for one
    raw = np.frombuffer(data, np.uint8).astype(np.int64)[: 3 - NODE_BYTES]
    angle_q6, good = _node_angles(raw[:-2], raw[1:-1], raw[2:])
    continues = good[:-5] & good[5:] & _rises(angle_q6[5:] - angle_q6[:-5])
    positions = len(data) - _TRUSTED_NODES * NODE_BYTES + 1
    runs = np.logical_and.reduce([continues[5 * k : 5 * k + positions] for k in range(_TRUSTED_NODES - 1)])
    return int(np.argmax(runs)) if runs.any() else None
