"""Decoders from PyPI, run from memory on the bytes that ours gets.

Two ways. A `PacketParser` gets the packets already cut and calls the peer's parser for each: the framing, the
search for a lost place and the logging of its reader are not charged to it. A scan reader is the peer's own
reader, on a port in memory, giving whole scans as its users get them.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib import import_module, metadata
from itertools import pairwise
from typing import Any, Literal, TypeAlias, TypeVar
from unittest.mock import patch

import numpy as np
from rich.console import Console

from estimators.messages import FloatArray

_T = TypeVar("_T")
Mode: TypeAlias = Literal["standard", "express"]
ScanReader: TypeAlias = Callable[[bytes], list[Any]]
FrameReader: TypeAlias = Callable[[list[bytes]], list[Any]]

_MODULES = {
    "adafruit-circuitpython-rplidar": "adafruit_rplidar",
    "lds2d": "lds2d.drivers.rplidar",
    "nooploop-uwb": "nooploop_uwb.aoa",
    "pyrplidar": "pyrplidar_protocol",
    "rplidar-roboticia": "rplidar",
}
"""Name on PyPI -> module that decodes."""

_TOLERANCE_DEG = 0.03
_SIGNED_OFFSET_TOLERANCE_DEG = 13.0
"""How far rplidar-roboticia and Adafruit are off in express scans: they take the top bit of a sample's offset
for its sign (up to 11.75 deg) and number the samples from 1 (one step). The vendor's SDK does neither."""


@dataclass(frozen=True, slots=True)
class PacketParser:
    """A peer's parser of scan packets.

    Attributes:
        decode: packets of one scan stream -> the peer's own points.
        polar: these points -> (N, 2) direction clockwise [deg], distance [mm].
        tolerance_deg: by how much its directions may differ from ours.
    """

    decode: Callable[[list[bytes]], list[Any]]
    polar: Callable[[list[Any]], FloatArray]
    tolerance_deg: float = _TOLERANCE_DEG


def packet_parsers(mode: Mode) -> dict[str, PacketParser]:
    """Installed peers that parse packets of this mode, by name and version."""
    return _installed(_PACKET_PARSERS[mode])


def scan_readers(mode: Mode) -> dict[str, ScanReader]:
    """Installed peers that group the samples of a stream to scans, by name and version.

    pyrplidar groups none, and Adafruit's `iter_scans` has no express mode.
    """
    return _installed(_SCAN_READERS[mode])


def aoa_readers() -> dict[str, FrameReader]:
    """Installed peers that read LinkTrack's AOA Node_Frame0, by name and version: frames -> their content."""
    return _installed({"nooploop-uwb": _nooploop_aoa})


def _installed(makers: Mapping[str, Callable[[Any], _T]]) -> dict[str, _T]:
    """Name and version -> what a maker makes of the module, for those whose distribution is there."""
    return {
        f"{distribution} {metadata.version(distribution)}": make(module)
        for distribution, make in makers.items()
        if (module := _module(distribution)) is not None
    }


@cache
def _module(distribution: str) -> Any:
    """A peer's module; None when it is not installed, which is said once."""
    try:
        return import_module(_MODULES[distribution])
    except ImportError:
        Console(stderr=True).print(f"{distribution} is not installed and takes no part (extra: bench)")
        return None


def _roboticia_standard(module: Any) -> PacketParser:
    return PacketParser(
        lambda packets: [module._process_scan(packet) for packet in packets], _polar_of_tuples
    )


def _roboticia_express(module: Any) -> PacketParser:
    def decode(packets: list[bytes]) -> list[Any]:
        parsed = map(module.ExpressPacket.from_string, packets)
        return [
            module._process_express_scan(packet, following.start_angle, number)
            for packet, following in pairwise(parsed)
            for number in range(1, 33)
        ]

    return PacketParser(decode, _polar_of_tuples, _SIGNED_OFFSET_TOLERANCE_DEG)


def _pyrplidar_standard(module: Any) -> PacketParser:
    def polar(points: list[Any]) -> FloatArray:
        return np.array([(point.angle, point.distance) for point in points])

    return PacketParser(lambda packets: [module.PyRPlidarMeasurement(packet) for packet in packets], polar)


def _pyrplidar_express(module: Any) -> PacketParser:
    capsule = module.PyRPlidarScanCapsule

    def decode(packets: list[bytes]) -> list[Any]:
        points: list[Any] = []
        for packet, following in pairwise(map(capsule, packets)):
            points += capsule._parse_capsule(packet, following)
        return points

    def polar(points: list[Any]) -> FloatArray:
        return np.array([(point.get_angle(), point.get_distance()) for point in points])

    return PacketParser(decode, polar)


def _lds2d_standard(module: Any) -> PacketParser:
    def decode(packets: list[bytes]) -> list[Any]:
        return [module.parse_node(packet)[0] for packet in packets if module.node_ok(packet)]

    def polar(points: list[Any]) -> FloatArray:
        return np.array([(point.angle_deg, point.dist_mm) for point in points])

    return PacketParser(decode, polar)


def _polar_of_tuples(points: list[Any]) -> FloatArray:
    return np.array([(angle, distance) for _, _, angle, distance in points])


class _EndOfStreamError(Exception):
    """A port in memory is empty; readers of ports never end by themselves."""


class _MemoryPort:
    """As much of pyserial's Serial as the peers use, with all its bytes already there."""

    dtr = False

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def read(self, size: int) -> bytes:
        begin, self._at = self._at, self._at + size
        if begin >= len(self._data):
            raise _EndOfStreamError
        return self._data[begin : self._at]

    def inWaiting(self) -> int:  # noqa: N802  # pyserial's name
        if self._at >= len(self._data):
            raise _EndOfStreamError
        return len(self._data) - self._at

    def write(self, data: bytes) -> int:
        return len(data)

    def setDTR(self, value: bool) -> None:  # noqa: N802  # pyserial's name
        self.dtr = value


def _all(scans: Iterator[Any]) -> list[Any]:
    found: list[Any] = []
    with suppress(_EndOfStreamError):
        for scan in scans:
            found.append(scan)  # noqa: PERF402  # list() would lose them all at the end of the stream
    return found


_DESCRIPTOR_BYTES = 7


def _roboticia_standard_scans(module: Any) -> ScanReader:
    return _roboticia_scans(module, packet_bytes=5, scan_type="normal")


def _roboticia_express_scans(module: Any) -> ScanReader:
    return _roboticia_scans(module, packet_bytes=84, scan_type="express")


def _roboticia_scans(module: Any, packet_bytes: int, scan_type: str) -> ScanReader:
    def read(stream: bytes) -> list[Any]:
        with patch("serial.Serial", return_value=_MemoryPort(stream[_DESCRIPTOR_BYTES:])):
            lidar = module.RPLidar("memory")
        lidar.scanning = [True, packet_bytes, scan_type]  # as after its start()
        return _all(lidar.iter_scans(max_buf_meas=False))

    return read


def _adafruit_scans(module: Any) -> ScanReader:
    def read(stream: bytes) -> list[Any]:
        with patch("serial.Serial", return_value=_MemoryPort(stream[_DESCRIPTOR_BYTES:])):
            lidar = module.RPLidar(None, "memory")
        lidar.scanning, lidar.descriptor_size = True, 5  # as after its start()
        return _all(lidar.iter_scans(max_buf_meas=0))

    return read


def _lds2d_scans(module: Any) -> ScanReader:
    return lambda stream: _all(module.RPLIDAR_A1(_MemoryPort(stream)).scans())


def _nooploop_aoa(module: Any) -> FrameReader:
    """Its reader keeps a list of integers and cuts frames off it; here each frame comes alone."""

    def read(frames: list[bytes]) -> list[Any]:
        with patch("serial.Serial"), patch("threading.Thread"):
            reader = module.AOA(port="memory")
        found = []
        for frame in frames:
            waiting = list(frame)
            begin, end = module.get_one_complete_frame(waiting)
            reader.data_fifo.put(waiting[begin:end])
            found.append(reader.get_data())
        return found

    return read


_PACKET_PARSERS: dict[Mode, dict[str, Callable[[Any], PacketParser]]] = {
    "standard": {
        "adafruit-circuitpython-rplidar": _roboticia_standard,  # it began as a copy of rplidar-roboticia
        "lds2d": _lds2d_standard,
        "pyrplidar": _pyrplidar_standard,
        "rplidar-roboticia": _roboticia_standard,
    },
    "express": {
        "adafruit-circuitpython-rplidar": _roboticia_express,
        "pyrplidar": _pyrplidar_express,
        "rplidar-roboticia": _roboticia_express,
    },
}
_SCAN_READERS: dict[Mode, dict[str, Callable[[Any], ScanReader]]] = {
    "standard": {
        "adafruit-circuitpython-rplidar": _adafruit_scans,
        "lds2d": _lds2d_scans,
        "rplidar-roboticia": _roboticia_standard_scans,
    },
    "express": {"rplidar-roboticia": _roboticia_express_scans},
}
