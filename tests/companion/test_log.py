"""The raw log: what went in comes out, and a killed process loses nothing that was written."""

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from companion import __version__
from companion.errors import UserError
from companion.log import RUN, Direction, Log, LogWriter, RawChunk, Truth

chunks = st.builds(
    RawChunk,
    st.sampled_from(["uwb", "lidar", "mavlink"]),
    st.sampled_from(Direction),
    st.integers(0, 2**62),
    st.binary(max_size=300),
)


def write(path: Path, records: list[RawChunk]) -> None:
    writer = LogWriter(path, "config = 1", 42)
    for record in records:
        writer.raw(record)
    writer.close()


@given(st.lists(chunks, max_size=20))
def test_reads_back_what_was_written(
    tmp_path_factory: pytest.TempPathFactory, records: list[RawChunk]
) -> None:
    path = tmp_path_factory.mktemp("log") / "a.mcap"
    write(path, records)
    log = Log(path)
    assert list(log) == records
    assert (log.config_toml, log.start_ns, log.version, log.complete) == ("config = 1", 42, __version__, True)


def test_truth_reads_back_with_and_without_heading(tmp_path: Path) -> None:
    writer = LogWriter(tmp_path / "t.mcap", "", 0)
    writer.truth(Truth(5, np.array([1.0, 2.0, 0.5])))
    writer.truth(Truth(6, np.array([1.0, 2.0, np.nan])))
    writer.close()
    first, second = (record for record in Log(tmp_path / "t.mcap") if isinstance(record, Truth))
    assert first.stamp_ns == 5
    assert first.pose.tolist() == [1.0, 2.0, 0.5]
    assert np.isnan(second.pose[2])


def test_other_mcap_readers_understand_it(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", [RawChunk("uwb", Direction.IN, 7, b"bytes")])
    with (tmp_path / "a.mcap").open("rb") as file:
        messages = [(c.topic, m.log_time, m.data) for _, c, m in make_reader(file).iter_messages()]
    assert messages == [("/raw/uwb/in", 7, b"bytes")]


def test_topics_that_are_not_ours_are_passed_over(tmp_path: Path) -> None:
    ours = RawChunk("uwb", Direction.IN, 7, b"bytes")
    writer = LogWriter(tmp_path / "a.mcap", "", 0)
    writer.raw(replace(ours, direction=cast("Direction", "sideways")))
    writer.raw(replace(ours, source="a/b"))
    writer.raw(ours)
    writer.close()
    assert list(Log(tmp_path / "a.mcap")) == [ours]


WRITER = """
import sys, time
from pathlib import Path
from companion.log import Direction, LogWriter, RawChunk
writer = LogWriter(Path(sys.argv[1]), "config = 1", 0)
for i in range(1000):
    writer.raw(RawChunk("uwb", Direction.IN, i, b"%d" % i))
print("written", flush=True)
time.sleep(60)
"""


def test_a_killed_process_loses_no_chunk(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    process = subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"written\n"
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    process.stdout.close()
    log = Log(path)
    read = [record.data for record in log if isinstance(record, RawChunk)]
    assert read == [b"%d" % i for i in range(1000)]
    assert not log.complete


def test_torn_anywhere_it_gives_a_prefix(tmp_path: Path) -> None:
    records = [RawChunk("uwb", Direction.IN, i, bytes([i]) * 20) for i in range(20)]
    write(tmp_path / "whole.mcap", records)
    whole = (tmp_path / "whole.mcap").read_bytes()
    torn = tmp_path / "torn.mcap"
    counts = []
    for size in range(200, len(whole), 7):
        torn.write_bytes(whole[:size])
        log = Log(torn)
        read = list(log)
        assert read == records[: len(read)]
        assert not log.complete
        counts.append(len(read))
    assert counts == sorted(counts)
    assert counts[-1] == len(records)


def test_what_other_tools_made_of_it_reads_the_same(tmp_path: Path) -> None:
    records = [RawChunk("uwb", Direction.IN, i, bytes([i]) * 20) for i in range(20)]
    write(tmp_path / "a.mcap", records)
    plain = Log(tmp_path / "a.mcap")
    with (tmp_path / "chunked.mcap").open("wb") as file:
        writer = Writer(file, chunk_size=100, compression=CompressionType.LZ4)
        writer.start()
        writer.add_metadata(RUN, {"version": "1", "config": plain.config_toml, "start_ns": "42"})
        writer.add_attachment(0, 0, "notes", "text/plain", b"of another tool")
        channel = writer.register_channel("/raw/uwb/in", "application/octet-stream", 0)
        for record in records:
            writer.add_message(channel, record.stamp_ns, record.data, record.stamp_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    log = Log(tmp_path / "chunked.mcap")
    assert list(log) == records
    assert (log.config_toml, log.start_ns, log.complete) == (plain.config_toml, 42, True)


@pytest.mark.parametrize("length", [0, 10**4, 2**62])
def test_a_record_with_a_damaged_length_ends_the_log(tmp_path: Path, length: int) -> None:
    records = [RawChunk("uwb", Direction.IN, i, bytes([65 + i]) * 20) for i in range(9)]
    path = tmp_path / "a.mcap"
    write(path, records)
    content = bytearray(path.read_bytes())
    # A message is its opcode, its length (8), 22 bytes of head, and its data.
    at = content.index(b"F" * 20) - 22 - 8
    content[at : at + 8] = length.to_bytes(8, "little")
    path.write_bytes(content)
    log = Log(path)
    assert list(log) == records[:5]
    assert not log.complete


@pytest.mark.parametrize("content", [b"", b"MCAP", b"not an mcap file at all, but long enough to be one"])
def test_no_mcap_file_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "no.mcap"
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"no\.mcap is not an MCAP file"):
        Log(path)


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"cannot read .*gone\.mcap: No such file"):
        Log(tmp_path / "gone.mcap")


def test_unwritable_log_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot write the log"):
        LogWriter(tmp_path / "file" / "a.mcap", "", 0)
