"""How NLink lays numbers and records of numbers out in bytes, in both directions; all are little-endian.

Source: NLink V1.4; nlink_unpack @1b79045, nlink_utils.
"""

import math
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice, starmap
from typing import Any, NamedTuple, TypeAlias

Bytes: TypeAlias = bytes | bytearray


@dataclass(frozen=True, slots=True)
class Integer:
    """Integers on the wire.

    Attributes:
        code: struct codes of its words; 24 bits are a low word of 16 and a high one of 8.
        steps: how many of them make one unit of the value; None: the integer itself is the value.
        void: the one that stands for None.
        kind: type of the values, when they have one of their own.
    """

    code: str
    steps: int | None = None
    void: int | None = None
    kind: type[int] = int

    def expression(self, words: Iterator[str]) -> str:
        """Python expression of the value; takes the names of its words."""
        low, *high = islice(words, len(self.code))
        raw = value = f"({low} + ({high[0]} << 16))" if high else low
        if self.kind is not int:
            value = f"{self.kind.__name__}({raw})"
        if self.steps is not None:
            value = f"{raw} / {self.steps}" + (" + 0.0" if self.steps < 0 else "")  # makes -0.0 plain 0
        return value if self.void is None else f"(None if {raw} == {self.void} else {value})"

    def pack(self, value: float | None, name: str) -> bytes:
        """Bytes of a value, rounded to the nearest step.

        Raises:
            ValueError: it does not fit; says the name and the limits.
        """
        size = struct.calcsize("<" + self.code)
        signed = self.code[-1].islower()
        if value is None and self.void is not None:
            return self.void.to_bytes(size, "little", signed=signed)
        low = -(1 << (8 * size - 1)) if signed else 0
        high = low + (1 << (8 * size)) - 1
        scaled = math.nan if value is None else value * (self.steps or 1)
        if not low - 0.5 < scaled < high + 0.5:  # in this form NaN is refused too
            least, most = sorted(raw if self.steps is None else raw / self.steps + 0.0 for raw in (low, high))
            raise ValueError(f"{name} is {value}, must be from {least} to {most}")
        raw = round(scaled)
        if raw == self.void:
            raise ValueError(
                f"{name} is {value}, which on the wire means none, must be another value or None"
            )
        return raw.to_bytes(size, "little", signed=signed)


@dataclass(frozen=True, slots=True)
class Float32:
    """IEEE-754 binary32, finite or not."""

    code: str = "f"

    def expression(self, words: Iterator[str]) -> str:
        """Python expression of the value; takes the name of its word."""
        return next(words)

    def pack(self, value: float, name: str) -> bytes:
        """Bytes of the nearest value.

        Raises:
            ValueError: it does not fit; says the name and the limit.
        """
        try:
            return struct.pack("<f", value)
        except OverflowError as error:
            raise ValueError(f"{name} is {value}, must be within 3.4028235e38 of zero") from error


class Slot(NamedTuple):
    """Place of a field in its record; a shape makes it a tuple of numbers, or a tuple of tuples."""

    name: str
    offset: int
    number: Integer | Float32
    shape: tuple[int, ...] = ()


class Record:
    """Fields at fixed places: a frame without its blocks, or one block.

    Args:
        kind: type of the record.
        size: its bytes; reserved are those that no slot covers.
        slots: its fields, by offset.
        rest: the field that follows the record and is read by others; empty when there is none.
    """

    def __init__(self, kind: type[Any], size: int, slots: list[Slot], rest: str = "") -> None:
        self.size = size
        self.rest = rest
        self._slots = slots
        code, end = "<", 0
        for slot in slots:
            words = slot.number.code * math.prod(slot.shape)
            code += f"{slot.offset - end}x{words}"
            end = slot.offset + struct.calcsize("<" + words)
        self._struct = struct.Struct(f"{code}{size - end}x")
        self._build = self._compiled(kind)

    def read(self, data: Bytes, *rest: Any) -> Any:
        """The record that `data` begins with; the value of its rest, if it has one, was read by others."""
        return self._build(*self._struct.unpack_from(data) + rest)

    def read_all(self, data: Bytes) -> tuple[Any, ...]:
        """The records that fill `data`."""
        return tuple(starmap(self._build, self._struct.iter_unpack(data)))

    def write(self, record: Any, path: str = "") -> bytearray:
        """Bytes of a record, reserved ones 0.

        Raises:
            ValueError: a value does not fit; names the field, after `path`, and its limit.
        """
        data = bytearray(self.size)
        for slot in self._slots:
            name = path + slot.name
            values = _flat(getattr(record, slot.name), slot.shape, name)
            packed = b"".join(slot.number.pack(value, name) for value in values)
            data[slot.offset : slot.offset + len(packed)] = packed
        return data

    def write_all(self, records: Sequence[Any], path: str) -> bytes:
        """Bytes of several records; raises like `write`."""
        return b"".join(self.write(record, f"{path}[{index}].") for index, record in enumerate(records))

    def _compiled(self, kind: type[Any]) -> Callable[..., Any]:
        """Function of the words that the struct gives, and of the rest, that builds the record.

        Like `collections.namedtuple`, it compiles what one would write by hand: going over the slots for
        every record takes 1.7 times as long.
        """
        names = [f"w{index}" for index in range(len(self._struct.unpack(bytes(self.size))))]
        words = iter(names)
        values = {slot.name: _nested(slot.number, slot.shape, words) for slot in self._slots}
        if self.rest:
            names.append(self.rest)
            values[self.rest] = self.rest
        types = {slot.number.kind for slot in self._slots if isinstance(slot.number, Integer)} | {kind}
        arguments = ", ".join(values[field] for field in kind.__match_args__)
        source = f"lambda {', '.join(names)}: {kind.__name__}({arguments})"
        build: Callable[..., Any] = eval(source, {each.__name__: each for each in types})  # noqa: S307
        return build


class RawBytes:
    """Bytes without structure, where there could be records."""

    size = 1

    def read_all(self, data: Bytes) -> bytes:
        """The bytes themselves."""
        return bytes(data)

    def write_all(self, data: bytes, path: str) -> bytes:  # noqa: ARG002
        """The bytes themselves."""
        return data


def _nested(number: Integer | Float32, shape: tuple[int, ...], words: Iterator[str]) -> str:
    if not shape:
        return number.expression(words)
    parts = [_nested(number, shape[1:], words) for _ in range(shape[0])]
    return f"({', '.join(parts)},)"


def _flat(value: Any, shape: tuple[int, ...], name: str) -> Iterator[Any]:
    if not shape:
        yield value
        return
    if len(value) != shape[0]:
        raise ValueError(f"{name} has {len(value)} values, must have {shape[0]}")
    for part in value:
        yield from _flat(part, shape[1:], name)
