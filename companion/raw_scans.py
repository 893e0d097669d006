"""Scans as the bytes of an RPLIDAR: for what was not recorded from one, or was changed afterwards."""

import struct

import numpy as np

from drivers.rplidar_nodes import HqPackets, encode_hq_packet
from drivers.rplidar_protocol import AnswerType, ConfKey, LidarConf, encode_answer, encode_descriptor
from estimators.messages import FloatArray, IntArray, Scan

_PACKET = HqPackets.SAMPLES
LEAST_SAMPLE_NS = 1000
"""A device tells the duration of its samples in 1/256 us; shorter ones would be lost in it."""


class ScanEncoder:
    """Writes scans as packets of the HQ mode, whose angles and distances have room for any LiDAR.

    The decoder takes a revolution as ended when the next one begins. Where the next scan does not follow
    at once, the end is written explicitly and a new stream begins, whose times owe nothing to those before
    and whose beams follow each other as those of its first scan do.

    Args:
        latency_ns: by which the driver takes stamps back.
    """

    def __init__(self, latency_ns: int = 0) -> None:
        self._sample_ns = LEAST_SAMPLE_NS
        self._latency_ns = latency_ns
        self._newest_ns: int | None = None
        """Time of the newest beam; None before a stream begins."""
        self._begins = True
        self._waiting: IntArray = np.empty((5, 0), np.int64)
        """angle_q14, distance_q2, quality, starts, time [ns]."""

    def add(self, scan: Scan) -> list[tuple[int, bytes]]:
        """Packets that a scan completes: arrival stamp, bytes."""
        out: list[tuple[int, bytes]] = []
        if self._newest_ns is not None and scan.stamp_ns - self._newest_ns > (_PACKET + 1) * self._sample_ns:
            out += self.flush()
        if self._newest_ns is None:
            interval = float(np.median(np.diff(scan.beam_times)))
            self._sample_ns = max(round(interval * 1e9), LEAST_SAMPLE_NS)
        count = len(scan.angles)
        beams = np.zeros((5, count), np.int64)
        beams[0] = _q14(scan.angles)
        beams[1] = np.rint(scan.ranges * 4000)
        beams[2] = np.clip(scan.quality, 0, 255)
        beams[3, 0] = 1
        beams[4] = scan.stamp_ns + np.rint(scan.beam_times * 1e9).astype(np.int64)
        self._newest_ns = int(beams[4, -1])
        self._waiting = np.hstack((self._waiting, beams))
        return out + self._packets()

    def flush(self) -> list[tuple[int, bytes]]:
        """Packets that end the revolution, filled with samples that saw nothing."""
        if self._newest_ns is None:
            return []
        missing = _PACKET - self._waiting.shape[1] % _PACKET
        end = np.zeros((5, missing), np.int64)
        end[3, 0] = 1
        end[4] = self._newest_ns + self._sample_ns * np.arange(1, missing + 1)
        self._waiting = np.hstack((self._waiting, end))
        out = self._packets()
        self._newest_ns, self._begins = None, True
        return out

    def _packets(self) -> list[tuple[int, bytes]]:
        out = []
        while self._waiting.shape[1] >= _PACKET:
            angles, distances, qualities, starts, times_ns = self._waiting[:, :_PACKET]
            data = encode_hq_packet(0, angles, distances, qualities, starts.astype(bool).tolist())
            if self._begins:
                data = self._head() + data
                self._begins = False
            out.append((int(times_ns[-1]) + self._latency_ns, data))
            self._waiting = self._waiting[:, _PACKET:]
        return out

    def _head(self) -> bytes:
        sample_time = struct.pack("<I", round(self._sample_ns * 256 / 1000))
        return encode_answer(LidarConf(ConfKey.MODE_SAMPLE_TIME, sample_time)) + encode_descriptor(
            AnswerType.HQ_SCAN
        )


def _q14(angles: FloatArray) -> IntArray:
    """Clockwise in 65536 parts of a turn, from counter-clockwise angles [rad]."""
    parts: IntArray = np.rint(-angles / (2.0 * np.pi) * 65536).astype(np.int64) % 65536
    return parts
