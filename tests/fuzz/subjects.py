"""The decoders under test, all with the same face: counts, bytes in and what came out, requests."""

import random
from collections.abc import Callable
from dataclasses import dataclass

from drivers import make_sensor, sensor_config_class
from drivers.framing import DecodeStats, Sensor
from drivers.rplidar_decoder import AnswerDecoder
from drivers.rplidar_protocol import RequestDecoder, Samples
from tests.fuzz.hostile_streams import Material, linktrack_material, request_material, rplidar_material
from tests.fuzz.well_formed import require, require_well_formed, require_well_formed_samples


def _silent(rng: random.Random, now_ns: int) -> bytes:
    return b""


@dataclass(frozen=True, slots=True)
class Subject:
    """A decoder under test.

    Attributes:
        decoder: the object whose size is watched.
        stats: its counts.
        feed: bytes and their arrival [ns] -> names of what came out, once it was checked.
        converse: at that time [ns], maybe do something else; bytes that go to the device.
    """

    decoder: object
    stats: DecodeStats
    feed: Callable[[bytes, int], list[str]]
    converse: Callable[[random.Random, int], bytes] = _silent


def sensor_subject(sensor: Sensor) -> Subject:
    """A sensor, whose dialogue also runs and is started over at random times."""

    def feed(data: bytes, stamp_ns: int) -> list[str]:
        found = sensor.feed(data, stamp_ns)
        for measurement in found:
            require(type(measurement) in sensor.MEASURES, f"{type(measurement)} is not in MEASURES")
            require_well_formed(measurement, stamp_ns)
        return [type(measurement).__name__ for measurement in found]

    def converse(rng: random.Random, now_ns: int) -> bytes:
        if rng.random() < 0.001:
            sensor.connected(now_ns)
        return sensor.poll(now_ns) if rng.random() < 0.2 else b""

    return Subject(sensor, sensor.stats, feed, converse)


def answer_subject() -> Subject:
    """What a RPLIDAR sends, down to single samples; now and then it falls quiet."""
    stats = DecodeStats()
    decoder = AnswerDecoder(stats)
    fed = 0

    def feed(data: bytes, stamp_ns: int) -> list[str]:
        nonlocal fed
        fed += len(data)
        events = decoder.feed(data)
        for event in events:
            if isinstance(event, Samples):
                require_well_formed_samples(event, fed)
        return [type(event).__name__ for event in events]

    def converse(rng: random.Random, now_ns: int) -> bytes:
        if rng.random() < 0.001:
            decoder.discard()
        return b""

    return Subject(decoder, stats, feed, converse)


def request_subject() -> Subject:
    """What a RPLIDAR is sent, as an emulator hears it."""
    decoder = RequestDecoder()

    def feed(data: bytes, stamp_ns: int) -> list[str]:
        requests = decoder.feed(data)
        for command, payload in requests:
            require(0 <= command <= 255 and len(payload) <= 255, f"impossible request: {command} {payload!r}")
        return ["request"] * len(requests)

    return Subject(decoder, decoder.stats, feed)


def _default_sensor_subject(driver: str) -> Subject:
    return sensor_subject(make_sensor(driver, sensor_config_class(driver)()))


SUBJECTS: dict[str, tuple[Callable[[], Subject], Callable[[random.Random], Material]]] = {
    "linktrack": (lambda: _default_sensor_subject("linktrack"), linktrack_material),
    "rplidar": (lambda: _default_sensor_subject("rplidar"), rplidar_material),
    "rplidar answers": (answer_subject, rplidar_material),
    "rplidar requests": (request_subject, request_material),
}
"""Name -> maker of a decoder under test, maker of what its streams consist of."""
