"""How the types that flow from sensor to pose are made."""

from dataclasses import dataclass
from typing import TypeVar, dataclass_transform

Record = TypeVar("Record")


@dataclass_transform(frozen_default=True, eq_default=False)
def immutable(cls: type[Record]) -> type[Record]:
    """Make a dataclass that nobody changes: the type checker sees to that.

    `frozen=True` would see to it at run time as well, but then an object takes four times as long to make,
    and there are 1500 a second. It equals itself only, as most hold arrays.
    """
    return dataclass(slots=True, eq=False)(cls)
