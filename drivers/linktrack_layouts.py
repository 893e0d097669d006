"""The five shapes of an NLink frame: how long one is, and how it is read and written.

A frame begins with constant bytes that tell its type and ends with a checksum. Between them is a head of
fixed fields; most types have blocks after it.

Source: NLink V1.4; nlink_unpack @1b79045; of the limits, ArduPilot AP_Beacon_Nooploop.
"""

import zlib
from abc import ABC, abstractmethod
from typing import Any

from drivers.linktrack_records import Bytes, RawBytes, Record
from drivers.linktrack_types import VOID_ID, Role

_MOST_BLOCKS = 255


class FrameLayout(ABC):
    """One type of frame.

    Args:
        start: constant bytes at its beginning, the first two tell the type.
        head: its fixed fields.
    """

    def __init__(self, start: bytes, head: Record) -> None:
        self.start = start
        self._head = head
        self._least = max(4, len(start))

    def extent(self, data: Bytes) -> int | None:
        """Length of the frame that starts `data`, or None when none can start so.

        While it is more than `len(data)`, nothing is to be said before so many bytes are there. More bytes
        never turn None into a length: a refusal holds however the stream is cut.
        """
        if len(data) < self._least:
            return self._least
        return self._extent(data) if data.startswith(self.start) else None

    def decode(self, data: Bytes) -> Any | None:
        """The frame that `data` is, whose extent was checked; None when its last byte is wrong."""
        return self._read(data) if data[-1] == self._last_byte(data) else None

    def encode(self, frame: Any) -> bytes:
        """Bytes of a frame, reserved ones 0.

        Raises:
            ValueError: a value does not fit; names the field and its limit.
        """
        data = self._write(frame)
        data[: len(self.start)] = self.start
        data[-1] = self._last_byte(data)
        return bytes(data)

    @abstractmethod
    def _extent(self, data: Bytes) -> int | None: ...

    @abstractmethod
    def _read(self, data: Bytes) -> Any: ...

    @abstractmethod
    def _write(self, frame: Any) -> bytearray: ...

    def _last_byte(self, data: Bytes) -> int:
        return checksum(data[:-1])


def checksum(data: Bytes) -> int:
    """Sum of bytes modulo 256."""
    # Adler-32 begun with 0 holds in its low half the plain sum modulo 65521, which 256 bytes do not reach;
    # it is ten times as fast as sum().
    if len(data) <= 256:
        return zlib.adler32(data, 0) & 0xFF
    return sum(zlib.adler32(data[at : at + 256], 0) & 0xFF for at in range(0, len(data), 256)) & 0xFF


class FixedFrame(FrameLayout):
    """A head alone, always of the same length."""

    def _extent(self, data: Bytes) -> int:  # noqa: ARG002
        return self._head.size

    def _read(self, data: Bytes) -> Any:
        return self._head.read(data)

    def _write(self, frame: Any) -> bytearray:
        return self._head.write(frame)


class BlockFrame(FrameLayout):
    """A head with the frame's length at offset 2 and the number of blocks at its end, then equal blocks.

    Args:
        block: one of them; they are the rest of the head.
    """

    def __init__(self, start: bytes, head: Record, block: Record) -> None:
        super().__init__(start, head)
        self._block = block

    def _extent(self, data: Bytes) -> int | None:
        length = data[2] | data[3] << 8
        blocks, left_over = divmod(length - self._head.size - 1, self._block.size)
        if left_over or not 0 <= blocks <= _MOST_BLOCKS:
            return None
        if len(data) < self._head.size:
            return self._head.size
        return length if data[self._head.size - 1] == blocks else None

    def _read(self, data: Bytes) -> Any:
        return self._head.read(data, self._block.read_all(data[self._head.size : -1]))

    def _write(self, frame: Any) -> bytearray:
        blocks = _limited(frame, self._head, _MOST_BLOCKS)
        data = self._head.write(frame)
        data[-1] = len(blocks)
        data += self._block.write_all(blocks, self._head.rest) + b"\x00"
        data[2:4] = len(data).to_bytes(2, "little")
        return data


class PayloadFrame(FrameLayout):
    """Like BlockFrame, but each block ends in a count of the items that follow it.

    Args:
        block: fixed part of a block; its items are its rest.
        count_size: bytes of the count.
        item: one item.
        longest: cap of the frame's length, because no count confirms it at once.
        most_items: of one block; None: as many as fit.
    """

    def __init__(
        self,
        start: bytes,
        head: Record,
        block: Record,
        *,
        count_size: int,
        item: Record | RawBytes,
        longest: int,
        most_items: int | None = None,
    ) -> None:
        super().__init__(start, head)
        self._block = block
        self._count_size = count_size
        self._item = item
        self._longest = longest
        self._most_items = longest if most_items is None else most_items

    def _extent(self, data: Bytes) -> int | None:
        length = data[2] | data[3] << 8
        if not self._head.size < length <= self._longest:
            return None
        if len(data) < self._head.size:
            return self._head.size
        end, checksum_at = self._head.size, length - 1
        least, most = self._block.size, self._block.size + self._most_items * self._item.size
        # Looking at each count as it arrives ends the wait after a false start early.
        for left in range(data[end - 1], 0, -1):
            if not end + left * least <= checksum_at <= end + left * most:
                return None
            if end + least > len(data):
                return end + least
            items = self._items(data, end)
            if items > self._most_items:
                return None
            end += least + items * self._item.size
        return length if end == checksum_at else None

    def _items(self, data: Bytes, block_at: int) -> int:
        last = block_at + self._block.size - 1
        return data[last] if self._count_size == 1 else data[last - 1] | data[last] << 8

    def _read(self, data: Bytes) -> Any:
        blocks = []
        end = self._head.size
        for _ in range(data[end - 1]):
            start, items_at = end, end + self._block.size
            end = items_at + self._items(data, start) * self._item.size
            blocks.append(self._block.read(data[start:items_at], self._item.read_all(data[items_at:end])))
        return self._head.read(data, tuple(blocks))

    def _write(self, frame: Any) -> bytearray:
        blocks = _limited(frame, self._head, _MOST_BLOCKS)
        data = self._head.write(frame)
        data[-1] = len(blocks)
        for index, block in enumerate(blocks):
            path = f"{self._head.rest}[{index}]."
            items = _limited(block, self._block, self._most_items, path)
            data += self._block.write(block, path)
            data[-self._count_size :] = len(items).to_bytes(self._count_size, "little")
            data += self._item.write_all(items, f"{path}{self._block.rest}")
        data += b"\x00"
        if len(data) > self._longest:
            raise ValueError(f"the frame has {len(data)} bytes, must have at most {self._longest}")
        data[2:4] = len(data).to_bytes(2, "little")
        return data


class UserFrame(FrameLayout):
    """A head that ends in the number of bytes after it.

    Args:
        longest: cap of the frame's length.
    """

    def __init__(self, start: bytes, head: Record, longest: int) -> None:
        super().__init__(start, head)
        self._most = longest - head.size - 1

    def _extent(self, data: Bytes) -> int | None:
        if len(data) < self._head.size:
            return self._head.size
        size = int.from_bytes(data[self._head.size - 2 : self._head.size], "little")
        return self._head.size + size + 1 if size <= self._most else None

    def _read(self, data: Bytes) -> Any:
        return self._head.read(data, bytes(data[self._head.size : -1]))

    def _write(self, frame: Any) -> bytearray:
        content = _limited(frame, self._head, self._most)
        data = self._head.write(frame)
        data[-2:] = len(content).to_bytes(2, "little")
        data += content + b"\x00"
        return data


class TagTable(FrameLayout):
    """Anchor_Frame0: places for 30 tags after the first two bytes, and no checksum.

    Args:
        block: what is in a place; its id is `VOID_ID` when nothing is.
    """

    _PLACES = 30
    _TAIL = 0xEE
    _SENDERS = (Role.ANCHOR, Role.CONSOLE)

    def __init__(self, start: bytes, head: Record, block: Record) -> None:
        super().__init__(start, head)
        self._block = block
        self._blocks = slice(len(start), len(start) + self._PLACES * block.size)

    def _extent(self, data: Bytes) -> int | None:
        # Without a checksum, the roles are the guard. Looking at each as it arrives also ends the wait after
        # a false start early.
        ids, roles = data[self._blocks][:: self._block.size], data[self._blocks][1 :: self._block.size]
        if any(role != Role.TAG and id_ != VOID_ID for id_, role in zip(ids, roles, strict=False)):
            return None
        if len(roles) < self._PLACES:
            return len(self.start) + len(roles) * self._block.size + 2
        if len(data) < self._head.size:
            return self._head.size
        return self._head.size if data[self._head.size - 2] in self._SENDERS else None

    def _read(self, data: Bytes) -> Any:
        blocks = self._block.read_all(data[self._blocks])
        return self._head.read(data, tuple(block for block in blocks if block.id != VOID_ID))

    def _write(self, frame: Any) -> bytearray:
        blocks = _limited(frame, self._head, self._PLACES)
        if frame.role not in self._SENDERS:
            raise ValueError(f"role is {frame.role}, must be {Role.ANCHOR:d} or {Role.CONSOLE:d}")
        for index, block in enumerate(blocks):
            if block.role != Role.TAG:
                raise ValueError(f"nodes[{index}].role is {block.role}, must be {Role.TAG:d}")
            if block.id == VOID_ID:
                raise ValueError(f"nodes[{index}].id is {block.id}, must be from 0 to {VOID_ID - 1}")
        data = self._head.write(frame)
        void = bytes([VOID_ID]) + bytes(self._block.size - 1)
        places = self._block.write_all(blocks, self._head.rest) + void * (self._PLACES - len(blocks))
        data[self._blocks] = places
        return data

    def _last_byte(self, data: Bytes) -> int:  # noqa: ARG002
        return self._TAIL


def _limited(record: Any, layout: Record, most: int, path: str = "") -> Any:
    """The rest of a record, when it is not too long.

    Raises:
        ValueError: it is; names it and the limit.
    """
    rest = getattr(record, layout.rest)
    if len(rest) > most:
        raise ValueError(f"{path}{layout.rest} has {len(rest)} entries, must have at most {most}")
    return rest
