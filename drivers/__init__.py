"""Sensor drivers: bytes to measurements, one line a sensor."""

from importlib import import_module
from typing import cast

from pydantic import BaseModel

from drivers.framing import Sensor

SENSORS: dict[str, tuple[str, str]] = {
    "linktrack": ("drivers.linktrack", "LinkTrack"),
    "rplidar": ("drivers.rplidar", "Rplidar"),
}
"""Name in a site file's `driver` key -> module and class. The class has a nested pydantic `Config`."""


def sensor_config_class(driver: str) -> type[BaseModel]:
    """Config class of the named driver.

    Raises:
        KeyError: no driver has that name.
    """
    module, name = SENSORS[driver]
    return cast("type[BaseModel]", getattr(import_module(module), name).Config)


def make_sensor(driver: str, config: BaseModel) -> Sensor:
    """New decoder (and dialogue) of the named driver.

    Args:
        driver: a key of `SENSORS`.
        config: instance of that driver's `Config`.
    """
    module, name = SENSORS[driver]
    return cast("Sensor", getattr(import_module(module), name)(config))
