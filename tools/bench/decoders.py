"""Rows of the decoders: sensor bytes, as a port gives them, to measurements or samples.

Ours always frames and checks a raw stream in chunks of 4096 bytes. Where a peer's parser takes packets, it
gets them cut (`peers.PacketParser`). Before anything is timed, ours must have lost nothing and the peers must
agree.
"""

from collections.abc import Sequence

import numpy as np

from drivers import make_sensor, sensor_config_class
from drivers.framing import DecodeStats
from drivers.linktrack_frames import encode
from drivers.linktrack_types import NodeFrame2, NodeRange
from drivers.rplidar_decoder import AnswerDecoder
from drivers.rplidar_protocol import Event, Samples
from estimators.messages import FloatArray, Measurement, Scan
from tests import vectors
from tools.bench.peers import Mode, PacketParser, aoa_readers, packet_parsers, scan_readers
from tools.bench.rows import Benchmark

_CHUNK_BYTES = 4096  # what a read of a busy port gives at most
_FRAMES = 2000
_FRAME_PERIOD_NS = 5_000_000
_DEVICE_RATE = 200.0  # fastest LinkTrack mode [frames/s]
_DESCRIPTOR_BYTES = 7
_PACKET_BYTES: dict[Mode, int] = {"standard": 5, "express": 84}
_PACKET_SAMPLES: dict[Mode, int] = {"standard": 1, "express": 32}
_SAMPLE_NS: dict[Mode, int] = {"standard": 500_000, "express": 250_000}
_STREAM_BYTES = 400_000


class DisagreementError(Exception):
    """A decoder did not make of a clean stream what it should: the row would compare unequal work."""


def linktrack_decode() -> Benchmark:
    """Node_Frame2 with four ranges, inertial sample and attitude, to measurements.

    No peer: nooploop-uwb reads AOA frames alone and takes every other type for garbage.
    """
    return _linktrack(_node_frames(), measurements_a_frame=3)


def linktrack_decode_vs_200hz() -> Benchmark:
    """The same, against what the fastest mode of a module sends."""
    bench = linktrack_decode()
    needed = ("200 Hz device rate", _DEVICE_RATE)
    return Benchmark(bench.unit, bench.better, bench.work, bench.ours, needed=needed)


def linktrack_aoa_decode() -> Benchmark:
    """AOA Node_Frame0 with four ranges: the one type that nooploop-uwb reads."""
    frames = _aoa_frames()
    readers = aoa_readers()
    for name, read in readers.items():
        if [len(frame["nodes"]) for frame in read(frames)] != [4] * len(frames):
            raise DisagreementError(f"{name} does not read four nodes in every AOA frame")
    ours = _linktrack(frames, measurements_a_frame=1)
    peers = {name: (lambda read=read: read(frames)) for name, read in readers.items()}
    return Benchmark(ours.unit, ours.better, ours.work, ours.ours, peers)


def rplidar_express_decode() -> Benchmark:
    """Express packets to samples."""
    return _samples("express")


def rplidar_standard_decode() -> Benchmark:
    """Standard nodes to samples."""
    return _samples("standard")


def rplidar_express_scan() -> Benchmark:
    """Express packets to whole scans with a time for every beam."""
    return _scans("express")


def rplidar_standard_scan() -> Benchmark:
    """Standard nodes to whole scans with a time for every beam."""
    return _scans("standard")


def _linktrack(frames: list[bytes], measurements_a_frame: int) -> Benchmark:
    chunks = _chunks(b"".join(frames))
    ends = np.cumsum([len(chunk) for chunk in chunks])
    stamps_ns = [int(end) * _FRAME_PERIOD_NS // len(frames[0]) for end in ends]

    def decode() -> list[Measurement]:
        return _fed("linktrack", chunks, stamps_ns)

    if len(decode()) != measurements_a_frame * len(frames):
        raise DisagreementError(f"LinkTrack makes {len(decode())} measurements of {len(frames)} frames")
    return Benchmark("frames/s", "higher", len(frames), decode)


def _node_frames() -> list[bytes]:
    rng = np.random.default_rng(1)
    frames = []
    for number in range(_FRAMES):
        ranges = rng.uniform(0.5, 12.0, 4).tolist()
        quaternion = rng.normal(size=4)
        time_ms = number * _FRAME_PERIOD_NS // 1_000_000
        frame = NodeFrame2(
            id=1,
            role=2,
            local_time_ms=time_ms,
            system_time_ms=time_ms,
            voltage=5.0,
            pos=(1.0, 2.0, 3.0),
            vel=(0.1, 0.2, 0.0),
            eop=(0.1, 0.1, 0.1),
            gyro=tuple(rng.normal(size=3).tolist()),
            acc=tuple(rng.normal(size=3).tolist()),
            angle_deg=(0.0, 0.0, 90.0),
            quat_wxyz=tuple((quaternion / np.linalg.norm(quaternion)).tolist()),
            nodes=tuple(
                NodeRange(role=1, id=k, dis=ranges[k], fp_rssi=-80.0, rx_rssi=-78.5) for k in range(4)
            ),
        )
        frames.append(encode(frame))
    return frames


def _aoa_frames() -> list[bytes]:
    """A captured frame of four nodes, with a local time that goes on.

    Source: nlink_parser @77a3238, test of its AOA driver.
    """
    data = bytearray.fromhex(
        "550742000200be730200000000000000f106ef1204"
        "0100ff0200220ba39f9e00"
        "0101020300ad00a49f0000"
        "0102ec0300cb03a5a00000"
        "010388050099eca3a00000"
        "33"
    )
    frames = []
    for number in range(_FRAMES):
        data[6:10] = (number * _FRAME_PERIOD_NS // 1_000_000).to_bytes(4, "little")
        data[-1] = sum(data[:-1]) & 0xFF
        frames.append(bytes(data))
    return frames


def _samples(mode: Mode) -> Benchmark:
    stream = _scan_stream(mode)
    chunks = _chunks(stream)

    def decode() -> list[Event]:
        decoder = AnswerDecoder(DecodeStats())
        events = [event for chunk in chunks for event in decoder.feed(chunk)]
        for event in events:
            if isinstance(event, Samples):
                event.batch.decoded()  # what waits to be done for all at once is done
        return events

    ours = _polar(decode())
    if len(ours) != _sample_count(mode, stream):
        raise DisagreementError(f"{mode}: {len(ours)} samples of {_sample_count(mode, stream)}")
    size = _PACKET_BYTES[mode]
    packets = [stream[at : at + size] for at in range(_DESCRIPTOR_BYTES, len(stream), size)]
    parsers = packet_parsers(mode)
    for name, parser in parsers.items():
        _require_agreement(f"{name}, {mode} scan", parser, packets, ours)
    peers = {name: (lambda decode=parser.decode: decode(packets)) for name, parser in parsers.items()}
    return Benchmark("samples/s", "higher", len(ours), decode, peers)


def _scans(mode: Mode) -> Benchmark:
    stream = _scan_stream(mode)
    chunks = _chunks(stream)
    samples_fed = np.cumsum([len(chunk) for chunk in chunks]) // _PACKET_BYTES[mode] * _PACKET_SAMPLES[mode]
    stamps_ns = [int(fed) * _SAMPLE_NS[mode] for fed in samples_fed]

    def decode() -> list[Measurement]:
        return _fed("rplidar", chunks, stamps_ns)

    scans = [len(scan.ranges) for scan in decode() if isinstance(scan, Scan)]
    readers = scan_readers(mode)
    for name, read in readers.items():
        # A peer also gives out what came before the first start of a revolution.
        if not 0 <= len(read(stream)) - len(scans) <= 1:
            raise DisagreementError(f"{name}: {len(read(stream))} {mode} scans, ours {len(scans)}")
    peers = {name: (lambda read=read: read(stream)) for name, read in readers.items()}
    return Benchmark("samples/s", "higher", _sample_count(mode, stream), decode, peers)


def _scan_stream(mode: Mode) -> bytes:
    """Descriptor and packets of a device that turns on and on.

    A stretch of the clean vector of whole revolutions, repeated; the S flag of an express stream stays in its
    first packet. The stretches are those whose end continues at their beginning.
    """
    stream = vectors.stream(f"rplidar_{mode}_clean")
    size = _PACKET_BYTES[mode]
    descriptor = stream[:_DESCRIPTOR_BYTES]
    packets = [stream[at : at + size] for at in range(_DESCRIPTOR_BYTES, len(stream), size)]
    if mode == "standard":
        starts = [number for number, packet in enumerate(packets) if packet[0] & 1]
        before, turns = b"", packets[starts[0] : starts[-1]]
    else:
        # 3 revolutions take 38 packets but for 0.7 deg
        before, turns = packets[0], packets[1:39]
    times = _STREAM_BYTES // (len(turns) * size)
    return descriptor + before + b"".join(turns) * times


def _sample_count(mode: Mode, stream: bytes) -> int:
    """Samples that a stream gives; the last packet of an express scan waits for the one after it."""
    packets = (len(stream) - _DESCRIPTOR_BYTES) // _PACKET_BYTES[mode]
    return (packets - (mode == "express")) * _PACKET_SAMPLES[mode]


def _chunks(stream: bytes) -> list[bytes]:
    return [stream[at : at + _CHUNK_BYTES] for at in range(0, len(stream), _CHUNK_BYTES)]


def _fed(driver: str, chunks: list[bytes], stamps_ns: list[int]) -> list[Measurement]:
    """What a new sensor makes of the chunks.

    Raises:
        DisagreementError: it lost bytes of a clean stream.
    """
    sensor = make_sensor(driver, sensor_config_class(driver)())
    found = [
        measurement
        for chunk, stamp_ns in zip(chunks, stamps_ns, strict=True)
        for measurement in sensor.feed(chunk, stamp_ns)
    ]
    if sensor.stats.bad or sensor.stats.skipped_bytes:
        raise DisagreementError(f"{driver} refuses parts of a clean stream: {sensor.stats}")
    return found


def _polar(events: Sequence[Event]) -> FloatArray:
    """Samples as the peers have them: (N, 2) direction clockwise [deg], distance [mm]."""
    samples = [event for event in events if isinstance(event, Samples)]
    angle_q14 = np.concatenate([part.columns.angle_q14 for part in samples])
    distance_q2 = np.concatenate([part.columns.distance_q2 for part in samples])
    return np.column_stack((angle_q14 * (90 / 16384), distance_q2 / 4))


def _require_agreement(what: str, parser: PacketParser, packets: list[bytes], ours: FloatArray) -> None:
    theirs = parser.polar(parser.decode(packets))
    if theirs.shape != ours.shape:
        raise DisagreementError(f"{what}: {len(theirs)} samples, ours {len(ours)}")
    turned_deg = np.abs((theirs[:, 0] - ours[:, 0] + 180) % 360 - 180).max()
    moved_mm = np.abs(theirs[:, 1] - ours[:, 1]).max()
    if turned_deg > parser.tolerance_deg or moved_mm >= 1:  # lds2d cuts distances to whole mm
        raise DisagreementError(f"{what}: differs from ours by {turned_deg:.3f} deg, {moved_mm:.2f} mm")


BENCHMARKS = {
    "linktrack_decode": linktrack_decode,
    "linktrack_decode_vs_200hz": linktrack_decode_vs_200hz,
    "linktrack_aoa_decode": linktrack_aoa_decode,
    "rplidar_express_decode": rplidar_express_decode,
    "rplidar_standard_decode": rplidar_standard_decode,
    "rplidar_express_scan": rplidar_express_scan,
    "rplidar_standard_scan": rplidar_standard_scan,
}
"""Name of the row -> what makes its benchmark."""
