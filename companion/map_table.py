"""The site's map as it stands in a resolved configuration, and so in every log: whole, without a file."""

import zlib
from base64 import b64decode, b64encode
from binascii import Error as Base64Error
from math import hypot
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from companion.checked_toml import Table
from estimators.lidar.floor_map import FloorMap

MOST_CELLS = 4_000_000
"""100 m x 100 m in cells of 5 cm: every log holds it, and every start spreads it out in memory."""
MOST_ACROSS = 200.0
"""Diagonal [m] that the grid of what the LiDAR sees has room for."""
_OCCUPIED, _FREE = 1, 2

Finite = Annotated[float, Field(allow_inf_nan=False)]


class MapTable(Table):
    """Cells of a map; a site file names the map's file instead, `map = "room.yaml"`."""

    name: str = Field(description="file that it was read from")
    cell: float = Field(gt=0, le=10, description="side of a cell [m]")
    origin: tuple[Finite, Finite, Finite] = Field(
        description="x [m], y [m], yaw [rad] of the outer corner of the first cell in the map frame"
    )
    rows: int = Field(gt=0, description="along y")
    columns: int = Field(gt=0, description="along x")
    cells: str = Field(
        description="a byte a cell, row by row: 1 obstacle, 2 free, 0 never seen; by zlib, then as base64"
    )

    @model_validator(mode="after")
    def _is_usable(self) -> Self:
        size = f"{self.name}: {self.columns} x {self.rows} cells of {self.cell:g} m"
        if self.rows * self.columns > MOST_CELLS:
            raise ValueError(f"{size}, at most {MOST_CELLS} in all")
        across = self.cell * hypot(self.rows, self.columns)
        if across > MOST_ACROSS:
            raise ValueError(f"{size} are {across:.0f} m across, at most {MOST_ACROSS:g} m")
        if not self.floor_map().occupied.any():
            raise ValueError(f"{self.name}: a map without any obstacle says nothing")
        return self

    @classmethod
    def of(cls, floor: FloorMap, name: str) -> Self:
        """The table of a map.

        Raises:
            ValidationError: it is too large, or has no obstacle.
        """
        rows, columns = floor.occupied.shape
        cells = np.where(floor.occupied, _OCCUPIED, np.where(floor.free, _FREE, 0)).astype(np.uint8)
        x, y, yaw = floor.T_map_grid.tolist()
        return cls(
            name=name,
            cell=floor.cell,
            origin=(x, y, yaw),
            rows=rows,
            columns=columns,
            cells=b64encode(zlib.compress(cells.tobytes(), 9)).decode(),
        )

    def floor_map(self) -> FloorMap:
        """The map.

        Raises:
            ValueError: the cells are damaged.
        """
        count = self.rows * self.columns
        try:
            # One byte more than is wanted tells that there are more; all might not fit into memory.
            data = zlib.decompressobj().decompress(b64decode(self.cells, validate=True), count + 1)
        except (Base64Error, zlib.error) as error:
            raise ValueError(f"{self.name}: the cells are damaged ({error})") from error
        if len(data) != count:
            raise ValueError(f"{self.name}: the cells are damaged (not {count} of them)")
        cells = np.frombuffer(data, dtype=np.uint8).reshape(self.rows, self.columns)
        return FloorMap(cells == _OCCUPIED, cells == _FREE, self.cell, np.array(self.origin))
