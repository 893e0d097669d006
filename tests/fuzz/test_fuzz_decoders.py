"""A short fuzz run of every decoder, and proof that the run finds what it looks for."""

import re
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest

from drivers.framing import Sensor
from drivers.linktrack import LinkTrack
from drivers.rplidar import Rplidar
from drivers.rplidar_decoder import AnswerDecoder
from drivers.rplidar_protocol import Event, Samples
from estimators.messages import Attitude, ImuSample, Measurement, RangeFrame, Scan
from tests.fuzz import fuzz_decoders
from tests.fuzz.fuzz_decoders import Report, fuzz
from tests.fuzz.subjects import SUBJECTS
from tests.fuzz.well_formed import FindingError, held_bytes

SHORT = 300_000

Defect: TypeAlias = Callable[[Sensor, bytes, list[Measurement]], list[Measurement]]


def run(name: str, folder: Path, seed: int = 1, byte_count: int = SHORT) -> Report:
    return fuzz(name, SUBJECTS[name][0](), byte_count, seed, folder)


@pytest.mark.parametrize("name", SUBJECTS)
def test_hostile_bytes_do_a_decoder_no_harm_and_good_ones_among_them_are_understood(
    name: str, tmp_path: Path
) -> None:
    report = run(name, tmp_path)
    assert report.fed >= SHORT
    assert min(report.stats.good, report.stats.bad, report.stats.skipped_bytes) > 100
    expected = {
        "linktrack": {"RangeFrame", "ImuSample", "Attitude"},
        "rplidar": {"Scan"},
        "rplidar answers": {"Samples", "DeviceInfo", "Health"},
        "rplidar requests": {"request"},
    }
    assert expected[name] <= set(report.found)
    assert not list(tmp_path.iterdir())


def test_the_seed_determines_the_run(tmp_path: Path) -> None:
    first, again, other = (run("rplidar", tmp_path, seed, 50_000) for seed in (2, 2, 3))
    assert (first.fed, first.stats, first.found) == (again.fed, again.stats, again.found)
    assert first.stats != other.stats


def plant(monkeypatch: pytest.MonkeyPatch, kind: type[Sensor], defect: Defect) -> None:
    """Let a sensor do wrong what it does right."""
    sound = kind.feed

    def feed(self: Sensor, data: bytes, stamp_ns: int) -> list[Measurement]:
        return defect(self, data, sound(self, data, stamp_ns))

    monkeypatch.setattr(kind, "feed", feed)


def raises_on_two_bytes(sensor: Sensor, data: bytes, found: list[Measurement]) -> list[Measurement]:
    if b"\x7f\x3a" in data:
        raise IndexError("beyond the end")
    return found


def holds_all_bytes(sensor: Sensor, data: bytes, found: list[Measurement]) -> list[Measurement]:
    held = sensor.__dict__.setdefault("held", bytearray())
    held += bytes(20 * len(data))
    return found


def counts_too_many(sensor: Sensor, data: bytes, found: list[Measurement]) -> list[Measurement]:
    sensor.stats.skipped_bytes += 2 * len(data)
    return found


def gives_a_foreign_measurement(sensor: Sensor, data: bytes, found: list[Measurement]) -> list[Measurement]:
    return [*found, ImuSample(0, np.zeros(3), np.zeros(3))]


@pytest.mark.parametrize(
    ("defect", "reason"),
    [
        (raises_on_two_bytes, "raised IndexError"),
        (holds_all_bytes, "holds .* bytes, must not hold more"),
        (counts_too_many, "bytes were skipped of"),
        (gives_a_foreign_measurement, "is not in MEASURES"),
    ],
)
def test_a_planted_defect_is_found_and_the_bytes_that_led_to_it_are_kept(
    defect: Defect, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant(monkeypatch, Rplidar, defect)
    with pytest.raises(FindingError, match=reason) as caught:
        run("rplidar", tmp_path)
    (path,) = tmp_path.iterdir()
    assert str(path) in str(caught.value)
    assert "seed 1" in str(caught.value)
    fed = int(re.search(r"after (\d+) bytes", str(caught.value))[1])  # type: ignore[index]
    assert path.stat().st_size == min(fed, 64_000)
    if defect is raises_on_two_bytes:
        assert b"\x7f\x3a" in path.read_bytes()[-4096:]


def test_memory_that_is_lost_outside_of_the_decoder_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost: list[bytes] = []

    def loses(sensor: Sensor, data: bytes, found: list[Measurement]) -> list[Measurement]:
        lost.append(bytes(4 * len(data)))
        return found

    plant(monkeypatch, LinkTrack, loses)
    with pytest.raises(FindingError, match="memory grew by"):
        run("linktrack", tmp_path)


def test_a_decoder_that_never_comes_back_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def hangs(sensor: Sensor, data: bytes, found: list[Measurement]) -> list[Measurement]:
        while True:
            time.sleep(0.01)

    monkeypatch.setattr(fuzz_decoders, "HANG_S", 0.05)
    plant(monkeypatch, LinkTrack, hangs)
    with pytest.raises(FindingError, match="for one chunk"):
        run("linktrack", tmp_path)


def reversed_array(array: Any) -> Any:
    return array[::-1]


@pytest.mark.parametrize(
    ("name", "sensor", "kind", "field", "change"),
    [
        ("rplidar", Rplidar, Scan, "beam_times", reversed_array),
        ("rplidar", Rplidar, Scan, "beam_times", np.zeros_like),
        ("rplidar", Rplidar, Scan, "angles", lambda angles: angles + np.pi),
        ("rplidar", Rplidar, Scan, "ranges", lambda ranges: -ranges),
        ("rplidar", Rplidar, Scan, "quality", lambda quality: quality * np.nan),
        ("linktrack", LinkTrack, RangeFrame, "ranges", lambda ranges: ranges - 5),
        ("linktrack", LinkTrack, RangeFrame, "ranges", lambda ranges: ranges * np.inf),
        ("linktrack", LinkTrack, RangeFrame, "ranges", lambda ranges: ranges[:0]),
        ("linktrack", LinkTrack, RangeFrame, "anchor_ids", lambda ids: ids.astype(float)),
        ("linktrack", LinkTrack, RangeFrame, "rx_power", lambda power: power + 1000),
        ("linktrack", LinkTrack, RangeFrame, "stamp_ns", lambda stamp_ns: stamp_ns + 10**10),
        ("linktrack", LinkTrack, ImuSample, "gyro", lambda gyro: gyro * np.nan),
        ("linktrack", LinkTrack, Attitude, "quat_wxyz", lambda quaternion: quaternion * 1.01),
    ],
)
def test_a_malformed_measurement_is_found(
    name: str,
    sensor: type[Sensor],
    kind: type[Measurement],
    field: str,
    change: Callable[[Any], Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def spoils(sensor: Sensor, data: bytes, found: list[Measurement]) -> list[Measurement]:
        return [replace(m, **{field: change(getattr(m, field))}) if isinstance(m, kind) else m for m in found]

    plant(monkeypatch, sensor, spoils)
    with pytest.raises(FindingError, match=kind.__name__):
        run(name, tmp_path)


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("batch", lambda batch: batch.decoded()._replace(angle_q14=batch.decoded().angle_q14 + 65536)),
        ("batch", lambda batch: batch.decoded()._replace(distance_q2=-1 - batch.decoded().distance_q2)),
        ("batch", lambda batch: batch.decoded()._replace(quality=batch.decoded().quality + 256)),
        ("batch", lambda batch: batch.decoded()._replace(quality=batch.decoded().quality[:0])),
        ("at", lambda at: at + 1_000_000),
        ("count", lambda count: count + 100_000),
        ("starts", lambda starts: [*starts, 100_000]),
        ("starts", lambda starts: [1, 0, *starts]),
        ("end", lambda end: end + SHORT),
    ],
)
def test_malformed_samples_are_found(
    field: str, change: Callable[[Any], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sound = AnswerDecoder.feed

    def spoils(self: AnswerDecoder, data: bytes) -> list[Event]:
        events = sound(self, data)
        return [
            replace(e, **{field: change(getattr(e, field))}) if isinstance(e, Samples) else e for e in events
        ]

    monkeypatch.setattr(AnswerDecoder, "feed", spoils)
    with pytest.raises(FindingError, match="Samples"):
        run("rplidar answers", tmp_path)


def test_all_that_an_object_refers_to_is_counted_once() -> None:
    array = np.zeros(10_000)
    views = [array[:10], array[10:], {"key": (array,)}]
    assert array.nbytes < held_bytes(views) < array.nbytes + 2000
    assert held_bytes([bytes(5000), bytearray(7000)]) > 12_000


def test_the_command_ends_with_0_after_a_clean_run_and_says_what_it_saw(tmp_path: Path) -> None:
    command = [
        sys.executable,
        fuzz_decoders.__file__,
        "--decoder",
        "rplidar",
        "--bytes",
        "50000",
        "--seed",
        "5",
    ]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stderr
    assert "seed 5" in done.stdout
    assert "bytes/s" in done.stdout
    assert not list(tmp_path.iterdir())
