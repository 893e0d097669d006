"""Maps on disk: a picture and a YAML file beside it, in the convention of the ROS map_server."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import yaml
from PIL import Image, UnidentifiedImageError
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from companion.errors import UserError
from companion.text_file import read_text
from estimators.lidar.floor_map import FloorMap

OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196
_BLACK, _GREY, _WHITE = 0, 205, 254
_MOST_PIXELS = 100_000_000

Finite = Annotated[float, Field(allow_inf_nan=False)]


class MapYaml(BaseModel):
    """The keys of the YAML file; others, as some tools write them, are ignored."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    image: str = Field(min_length=1)
    resolution: float = Field(gt=0, le=10)
    origin: tuple[Finite, Finite, Finite]
    negate: Literal[0, 1] = 0
    occupied_thresh: float = Field(OCCUPIED_THRESH, gt=0, le=1)
    free_thresh: float = Field(FREE_THRESH, ge=0, lt=1)


def save_map(floor: FloorMap, path: Path) -> None:
    """Write `path` (YAML) and a PNG of the same name.

    Raises:
        UserError: they cannot be written.
    """
    picture = path.with_suffix(".png")
    pixels = np.full(floor.occupied.shape, _GREY, dtype=np.uint8)
    pixels[floor.free] = _WHITE
    pixels[floor.occupied] = _BLACK
    keys = MapYaml(
        image=picture.name,
        resolution=floor.cell,
        origin=(float(floor.T_map_grid[0]), float(floor.T_map_grid[1]), float(floor.T_map_grid[2])),
    )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # The first row of a picture is the top, where y is greatest.
        Image.fromarray(pixels[::-1]).save(picture, format="PNG")
        path.write_text(yaml.safe_dump(keys.model_dump(mode="json"), sort_keys=False), encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error


def load_map(path: Path) -> FloorMap:
    """Read a map that this or another tool saved.

    Raises:
        UserError: a file is missing or is none, a key is missing or wrong: named with the limit it breaks.
    """
    try:
        data = yaml.safe_load(read_text(path))
    except yaml.YAMLError as error:
        raise UserError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from error
    if not isinstance(data, dict):
        raise UserError(f"{path} is no map: it has no keys such as image and resolution")
    try:
        keys = MapYaml.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        reason = "this key is required and missing" if first["type"] == "missing" else first["msg"]
        raise UserError(f"{path}: {key}: {reason}") from error
    if keys.free_thresh >= keys.occupied_thresh:
        raise UserError(
            f"{path}: free_thresh: {keys.free_thresh} must be below occupied_thresh, {keys.occupied_thresh}"
        )
    shade = _shades(path.parent / keys.image)
    occupancy = shade if keys.negate else 1.0 - shade
    return FloorMap(
        occupied=occupancy > keys.occupied_thresh,
        free=occupancy < keys.free_thresh,
        cell=keys.resolution,
        T_map_grid=np.array(keys.origin),
    )


def _shades(picture: Path) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Lightness (rows, columns) from 0 to 1, first row at the bottom."""
    try:
        with Image.open(picture) as image:
            if image.width * image.height > _MOST_PIXELS:
                raise UserError(f"{picture}: {image.width} x {image.height} pixels, at most {_MOST_PIXELS}")
            pixels = np.asarray(image.convert("L"), dtype=np.float64)
    except UnidentifiedImageError as error:
        raise UserError(f"{picture} is not a picture") from error
    except OSError as error:
        raise UserError(f"cannot read {picture}: {error.strerror or error}") from error
    return pixels[::-1] / 255.0
