"""The raw log: every byte that crossed a port, with its host stamp, in an MCAP file.

The file is written without MCAP chunks and flushed after every record, so what a killed process had
written is there. Raw bytes are the truth; measurements and poses are derived from them by replay.
"""

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from io import BufferedReader, BytesIO
from os import fstat
from pathlib import Path
from typing import Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Metadata
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC, Writer

from companion import __version__
from companion.errors import UserError
from estimators.immutable import immutable
from estimators.messages import FloatArray

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
RUN = "companion.run"
TRUTH_TOPIC = "/truth"
_TRUTH_SCHEMA = {
    "type": "object",
    "title": "true pose of the body in the map: metres and radians",
    "properties": {"x": {"type": "number"}, "y": {"type": "number"}, "yaw": {"type": "number"}},
}


class Direction(StrEnum):
    """Which way bytes went, seen from this computer."""

    IN = "in"
    OUT = "out"


_OTHERS = {
    Opcode.CHANNEL: Channel.read,
    Opcode.CHUNK: Chunk.read,
    Opcode.METADATA: Metadata.read,
}
_DIRECTIONS = frozenset(direction.value for direction in Direction)


@dataclass(frozen=True, slots=True)
class RawChunk:
    """Bytes of one read from, or one write to, a port.

    Attributes:
        source: name of the sensor as in the site file, or `mavlink`.
        direction: in or out.
        stamp_ns: host's monotonic time of the read or write.
        data: the bytes.
    """

    source: str
    direction: Direction
    stamp_ns: int
    data: bytes


@immutable
class Truth:
    """Where the body really was.

    Attributes:
        stamp_ns: host's monotonic time.
        pose: (3,) x [m], y [m], yaw [rad], map frame; yaw is NaN where the reference has none.
    """

    stamp_ns: int
    pose: FloatArray


class LogWriter:
    """Writes one log; every record is on its way to the disk when the call returns.

    Args:
        path: file to create.
        config_toml: the resolved configuration, so that the log can be replayed alone.
        start_ns: host's monotonic time at which poses begin; replay gives poses at the same times.

    Raises:
        UserError: the file cannot be created.
    """

    def __init__(self, path: Path, config_toml: str, start_ns: int) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("wb")
        except OSError as error:
            raise UserError(f"cannot write the log {path}: {error.strerror}") from error
        self._writer = Writer(self._file, use_chunking=False)
        self._writer.start(profile="", library="companion")
        self._writer.add_metadata(
            RUN, {"version": __version__, "config": config_toml, "start_ns": str(start_ns)}
        )
        self._channels: dict[str, int] = {}

    def raw(self, chunk: RawChunk) -> None:
        """Append bytes."""
        topic = f"/raw/{chunk.source}/{chunk.direction}"
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "application/octet-stream", 0)
        self._append(topic, chunk.stamp_ns, chunk.data)

    def truth(self, truth: Truth) -> None:
        """Append a true pose."""
        if TRUTH_TOPIC not in self._channels:
            schema = self._writer.register_schema(
                "companion.Truth", "jsonschema", json.dumps(_TRUTH_SCHEMA).encode()
            )
            self._channels[TRUTH_TOPIC] = self._writer.register_channel(TRUTH_TOPIC, "json", schema)
        x, y, yaw = truth.pose.tolist()
        pose = {"x": x, "y": y, "yaw": yaw if np.isfinite(yaw) else None}
        self._append(TRUTH_TOPIC, truth.stamp_ns, json.dumps(pose).encode())

    def close(self) -> None:
        """Write the index and close the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()

    def _append(self, topic: str, stamp_ns: int, data: bytes) -> None:
        self._writer.add_message(self._channels[topic], stamp_ns, data, stamp_ns)
        self._file.flush()


class Log:
    """A log opened for reading.

    Attributes:
        path: the file.
        config_toml: configuration that the run used.
        version: version of this program that wrote it.
        start_ns: time of the first pose.
        share_read: how far the newest iteration is, 0 to 1.
        complete: False once reading met a torn end, as a killed process leaves it, or a damaged record.

    Raises:
        UserError: the file is missing, no MCAP, or not one of ours.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.share_read = 0.0
        self.complete = True
        with self._open() as file:
            run = next((r for r in self._records(file) if isinstance(r, Metadata) and r.name == RUN), None)
        if run is None:
            raise UserError(f"{path} is an MCAP file but holds no run of companion (no {RUN!r} metadata)")
        self.config_toml = run.metadata["config"]
        self.version = run.metadata["version"]
        self.start_ns = int(run.metadata["start_ns"])

    def __iter__(self) -> Iterator[RawChunk | Truth]:
        """Everything in the order in which it was written."""
        topics: dict[int, str] = {}
        chunks: dict[int, tuple[str, Direction]] = {}
        with self._open() as file:
            for record in self._records(file):
                if isinstance(record, Message):
                    if record.channel_id in chunks:
                        source, direction = chunks[record.channel_id]
                        yield RawChunk(source, direction, record.log_time, record.data)
                    elif topics.get(record.channel_id) == TRUTH_TOPIC:
                        yield from self._truth(record)
                elif isinstance(record, Channel):
                    topics[record.id] = record.topic
                    parts = record.topic.split("/")
                    if len(parts) == 4 and parts[1] == "raw" and parts[3] in _DIRECTIONS:
                        chunks[record.id] = (parts[2], Direction(parts[3]))

    def _truth(self, message: Message) -> Iterator[Truth]:
        try:
            pose = json.loads(message.data)
            x, y, yaw = pose["x"], pose["y"], pose["yaw"]
        except (ValueError, KeyError):
            self.complete = False
        else:
            yield Truth(message.log_time, np.array([x, y, np.nan if yaw is None else yaw]))

    def _open(self) -> BufferedReader:
        try:
            file = self.path.open("rb")
            magic = file.read(len(MCAP0_MAGIC))
        except OSError as error:
            raise UserError(f"cannot read {self.path}: {error.strerror}") from error
        if magic != MCAP0_MAGIC:
            file.close()
            raise UserError(f"{self.path} is not an MCAP file")
        file.seek(0)
        return file

    def _records(self, file: BufferedReader) -> Iterator[Any]:
        """Channels, messages and metadata.

        Nearly all records are messages, and a message is unpacked at once: the library's reader, which takes
        each of its numbers from the stream by itself, takes three times as long.
        """
        size = fstat(file.fileno()).st_size
        at = file.seek(len(MCAP0_MAGIC))
        opcode = 0
        try:
            while opcode != Opcode.FOOTER:
                opcode, length = _RECORD.unpack(file.read(_RECORD.size))
                at += _RECORD.size + length
                if at > size:
                    raise EndOfFile
                content = file.read(length)
                self.share_read = at / size
                if opcode == Opcode.MESSAGE:
                    channel, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(content)
                    yield Message(channel, log_ns, content[_MESSAGE.size :], publish_ns, sequence)
                elif opcode in _OTHERS:
                    record = _OTHERS[opcode](ReadDataStream(BytesIO(content)))
                    yield from breakup_chunk(record) if isinstance(record, Chunk) else [record]
            if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                raise EndOfFile
        except (McapError, struct.error, ValueError):
            self.complete = False
