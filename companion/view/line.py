"""A line of the text log."""

from dataclasses import dataclass
from typing import Literal

Level = Literal["INFO", "WARN", "ERROR"]


@dataclass(frozen=True, slots=True)
class Line:
    """Something said in words, with its time and how bad it is."""

    stamp_ns: int
    text: str
    level: Level = "INFO"
