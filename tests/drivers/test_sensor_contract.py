"""What every driver promises, over the whole SENSORS table: a new driver is covered by its line there."""

import random
from dataclasses import fields

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from companion.log import Direction, Log, RawChunk
from companion.sim.scenario import load_scenario
from drivers import SENSORS, make_sensor, sensor_config_class
from drivers.framing import Sensor
from estimators.messages import Measurement, measurement_stamp_ns
from tests.conftest import write_log, write_scenario

every_sensor = pytest.mark.parametrize("driver", SENSORS)
SECOND = 1_000_000_000


def sensor(driver: str) -> Sensor:
    return make_sensor(driver, sensor_config_class(driver)())


@pytest.fixture(scope="module")
def streams(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[RawChunk]]:
    """What a device of every driver sent in a short run."""
    folder = tmp_path_factory.mktemp("streams")
    walk = "[trajectory]\nwaypoints = [[1.5, 1.2], [2.0, 1.2]]\nlaps = 0\nrest = 0.5\n"
    scenario = load_scenario(write_scenario(folder, walk), 1, [])
    records = list(Log(write_log(scenario, folder / "log.mcap")))
    chunks = [r for r in records if isinstance(r, RawChunk) and r.direction is Direction.IN]
    return {
        table.driver: [chunk for chunk in chunks if chunk.source == name]
        for name, table in scenario.config.sensor.items()
    }


def test_every_driver_has_an_emulated_device(streams: dict[str, list[RawChunk]]) -> None:
    assert set(streams) == set(SENSORS)
    assert all(streams.values())


@every_sensor
def test_measurements_are_of_the_promised_types_and_not_from_the_future(
    driver: str, streams: dict[str, list[RawChunk]]
) -> None:
    decoder = sensor(driver)
    seen: set[type] = set()
    for chunk in streams[driver]:
        for measurement in decoder.feed(chunk.data, chunk.stamp_ns):
            seen.add(type(measurement))
            assert measurement_stamp_ns(measurement) <= chunk.stamp_ns
    assert seen == set(decoder.MEASURES)
    assert decoder.stats.bad == decoder.stats.skipped_bytes == 0


def contents(measurements: list[Measurement]) -> list[str]:
    """Everything but the stamps, which depend on when bytes arrive."""
    return [
        " ".join(
            repr(getattr(m, name).tolist() if hasattr(getattr(m, name), "tolist") else getattr(m, name))
            for name in (field.name for field in fields(m))
            if name not in ("stamp_ns", "beam_times")
        )
        for m in measurements
    ]


@every_sensor
@pytest.mark.parametrize("longest", [1, 7, 1000])
def test_same_measurements_for_any_chunking(
    driver: str, longest: int, streams: dict[str, list[RawChunk]]
) -> None:
    data = b"".join(chunk.data for chunk in streams[driver])[:20_000]
    whole = contents(sensor(driver).feed(data, SECOND))
    rng, decoder, pieces = random.Random(longest), sensor(driver), []
    at = 0
    while at < len(data):
        size = rng.randint(1, longest)
        pieces += contents(decoder.feed(data[at : at + size], SECOND + at))
        at += size
    assert whole == pieces
    assert whole


@every_sensor
@given(st.lists(st.binary(max_size=200), max_size=20))
def test_no_bytes_raise_and_all_are_accounted_for(driver: str, chunks: list[bytes]) -> None:
    decoder = sensor(driver)
    for i, data in enumerate(chunks):
        decoder.feed(data, i * SECOND)
    assert decoder.stats.skipped_bytes <= sum(map(len, chunks))


@every_sensor
def test_good_bytes_after_garbage_are_understood(driver: str, streams: dict[str, list[RawChunk]]) -> None:
    decoder = sensor(driver)
    decoder.feed(random.Random(0).randbytes(5000), 0)
    found = [m for chunk in streams[driver] for m in decoder.feed(chunk.data, chunk.stamp_ns)]
    assert {type(m) for m in found} == set(decoder.MEASURES)


@every_sensor
def test_the_dialogue_starts_with_the_connection_and_never_floods(driver: str) -> None:
    device = sensor(driver)
    assert device.poll(SECOND) == b""
    device.connected(SECOND)
    # Nobody answers for ten seconds: requests are repeated, slowly.
    said = [device.poll(SECOND + k * SECOND // 100) for k in range(1000)]
    assert sum(map(bool, said)) < 60
    assert len(b"".join(device.closing())) < 100


@every_sensor
def test_unknown_settings_are_refused(driver: str) -> None:
    with pytest.raises(ValidationError):
        sensor_config_class(driver).model_validate({"colour": "blue"})
