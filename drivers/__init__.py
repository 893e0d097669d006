"""Sensor drivers: bytes to measurements, one line a sensor."""

from importlib import import_module
from typing import Any, cast

from pydantic import BaseModel

from drivers.framing import Sensor

SENSORS: dict[str, tuple[str, str]] = {
    "linktrack": ("drivers.linktrack", "LinkTrack"),
    "rplidar": ("drivers.rplidar", "Rplidar"),
}
"""Name in a site file's `driver` key -> module and class. The class has a nested pydantic `Config`."""


def _sensor_class(driver: str) -> Any:
    module, name = SENSORS[driver]
    return getattr(import_module(module), name)


def sensor_config_class(driver: str) -> type[BaseModel]:
    """Config class of the named driver.

    Raises:
        KeyError: no driver has that name.
    """
    return cast("type[BaseModel]", _sensor_class(driver).Config)


def dtr_stops(driver: str) -> bool:
    """Whether the DTR line stops the named driver's device, see `Sensor.DTR_STOPS`."""
    return bool(_sensor_class(driver).DTR_STOPS)


def make_sensor(driver: str, config: BaseModel) -> Sensor:
    """New decoder (and dialogue) of the named driver.

    Args:
        driver: a key of `SENSORS`.
        config: instance of that driver's `Config`.
    """
    return cast("Sensor", _sensor_class(driver)(config))
