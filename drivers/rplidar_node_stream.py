"""RPLIDAR standard nodes out of damaged streams. They have no checksum: each has to fit the one before.

No I/O and no time.
"""

import numpy as np

from drivers.framing import ByteBuffer, DecodeStats
from drivers.rplidar_nodes import NODE, TURN_Q6, Angles, BoolArray, Columns, NodeArray, node_angles, to_q14
from drivers.rplidar_protocol import DESCRIPTOR, DESCRIPTOR_BYTES, AnswerType, Event, Samples

_NODE_BYTES = NODE.itemsize
# A node's direction is corrected for the distance, so it jumps by up to 9 deg either way between a return
# and none (seen on a real A1), on top of the step, which is 0.3 to 6 deg.
_FALL, _RISE, _TURN = np.uint16(10 << 6), np.uint16(20 << 6), np.uint16(TURN_Q6)
_WRAPPED = np.uint16(65536 - 2 * TURN_Q6 + (10 << 6) + (20 << 6))
_TRUSTED_NODES = 4  # this many in a row end a search; by chance random bytes pass once in some 10^6
_RUN_BYTES = _TRUSTED_NODES * _NODE_BYTES
_TAIL_BYTES = 2 * _NODE_BYTES - 1  # a descriptor at the first byte of a node never makes two
# Bytes looked at in one go, so that badly damaged input costs linear time.
_WINDOW = 8000
_SEARCH_WINDOW = 1000


class NodeStream:
    """Standard nodes of one scan, from its descriptor to the next.

    Args:
        stats: where nodes are counted.
    """

    def __init__(self, stats: DecodeStats) -> None:
        self._stats = stats
        self._trusted = True
        self._gap = False
        self._arrived = 0
        self._last_angle_q6: np.uint16 | None = None
        self._tail = b""  # end of what was taken; a descriptor may begin in it

    def step(self, buffer: ByteBuffer, fed: int, events: list[Event]) -> bytes | None:
        """See `ScanStream`."""
        if not self._trusted:
            return self._search(buffer)
        count = min(len(buffer), _WINDOW) // _NODE_BYTES
        if count == 0:
            return None
        nodes = np.frombuffer(buffer.view[: count * _NODE_BYTES], NODE)
        angle_q6, good = node_angles(nodes)
        if self._last_angle_q6 is not None:
            good[0] &= _rises(angle_q6[:1] - self._last_angle_q6)[0]
        good[1:] &= _rises(angle_q6[1:] - angle_q6[:-1])
        taken = count if good.all() else int(good.argmin())
        if taken:
            self._tail = (self._tail + buffer.take(taken * _NODE_BYTES))[-_TAIL_BYTES:]
            self._last_angle_q6 = angle_q6[taken - 1]
            self._give(nodes[:taken], angle_q6[:taken], fed - len(buffer), events)
        if taken < count:
            self._stats.bad += 1
            self._gap = True
            self._trusted = False
        return b""

    def lose(self) -> None:
        """See `ScanStream`."""
        self._trusted = False
        self._gap = True
        self._last_angle_q6 = None
        self._tail = b""

    def _give(self, nodes: NodeArray, angle_q6: Angles, end: int, events: list[Event]) -> None:
        flags = nodes["flags"].copy()
        columns = Columns(
            to_q14(angle_q6), nodes["distance"].astype(np.int64), (flags & 0xFC).astype(np.int64)
        )
        starts = (flags & 1).nonzero()[0].tolist()
        events.append(
            Samples(AnswerType.STANDARD_SCAN, columns, 0, len(nodes), starts, self._gap, self._arrived, end)
        )
        self._gap = False
        self._arrived += len(nodes)
        self._stats.good += len(nodes)

    def _search(self, buffer: ByteBuffer) -> bytes | None:
        """After damage: skip to the next run of nodes that fit each other, or to a descriptor.

        Whichever is complete first wins, so that the result does not depend on the chunks.
        """
        window = bytes(buffer.view[:_SEARCH_WINDOW])
        run = _find_run(window)
        descriptor = DESCRIPTOR.search(self._tail + window)
        if descriptor is not None:
            end = descriptor.end() - len(self._tail)
            if run is None or end <= run + _RUN_BYTES:
                buffer.skip(end - DESCRIPTOR_BYTES)
                buffer.take(min(end, DESCRIPTOR_BYTES))
                return descriptor[0]
        if run is not None:
            buffer.skip(run)
            self._trusted = True
            self._last_angle_q6 = None
            return b""
        refused = len(window) - _RUN_BYTES + 1
        if refused <= 0:
            return None
        buffer.skip(refused)
        self._tail = b""
        return b""


def _rises(step_q6: Angles) -> BoolArray:
    """Whether steps from one angle within a turn to the next, modulo 65536, are such as the head makes.

    Modulo a turn, steps from the largest fall to the largest rise. All that is done on 16 bits, where a step
    past 0 appears as 65536 less a part of a turn.
    """
    ahead = step_q6 + _FALL
    return (ahead <= _FALL + _RISE) | (ahead - _TURN <= _WRAPPED)


def _find_run(data: bytes) -> int | None:
    """Offset of the first node that begins a run of trustworthy nodes; None when there is none."""
    positions = len(data) - _RUN_BYTES + 1
    if positions <= 0:
        return None
    # nodes at every byte offset that has room for one
    nodes = np.ndarray((len(data) - _NODE_BYTES + 1,), NODE, data, strides=(1,))
    angle_q6, good = node_angles(nodes)
    continues = good[:-5] & good[5:] & _rises(angle_q6[5:] - angle_q6[:-5])
    runs = np.logical_and.reduce([continues[5 * k : 5 * k + positions] for k in range(_TRUSTED_NODES - 1)])
    return int(runs.argmax()) if runs.any() else None
