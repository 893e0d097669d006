"""Messages out of MAVLink bytes, held against pymavlink's own parser."""

import random
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink2

from drivers.framing import DecodeStats
from drivers.mavlink_frames import MavlinkMessage, MavlinkParser, plain_message, set_signing

KEY = bytes(range(32))
KINDS = sorted(mavlink2.mavlink_map)
USUAL = [mavlink2.mavlink_map[kind] for kind in (0, 27, 30, 105, 111)]


def frame(make: Any, rng: random.Random, version: int = 2, key: bytes | None = None) -> bytes:
    """A message of this kind whose payload is any bytes, perhaps with zeros at its end or more than we know.

    Of version 1 only where it can be: a signed one cannot, nor one whose number has more than 8 bits.
    """
    if key is not None or make.id > 255:
        version = 2
    ends = mavlink2.MAVLink(None, srcSystem=rng.randint(1, 255), srcComponent=rng.randint(1, 255))
    ends.seq = rng.randint(0, 255)
    if key is not None:
        set_signing(ends, key)
        ends.signing.sign_outgoing = True
        ends.signing.timestamp = rng.randint(1, 1 << 40)
    size = make.unpacker.size
    payload = rng.randbytes(rng.randint(0, size)).ljust(size, b"\0")
    if version == 2 and size < 250:
        payload += rng.randbytes(rng.choice((0, 0, 5)))
    message = mavlink2.MAVLink_message(make.id, make.msgname)
    return bytes(message._pack(ends, make.crc_extra, payload, force_mavlink1=version == 1))


def content(message: MavlinkMessage) -> object:
    """All that a message says; repr tells NaN, -0.0, int and float apart."""
    head = message.get_header()
    return (
        message.get_type(),
        repr([getattr(message, name) for name in message.get_fieldnames()]),
        vars(head),
        message.get_msgbuf(),
        message.get_payload(),
        message.get_crc(),
        message.get_signed(),
    )


def expected(chunks: list[bytes], key: bytes | None = None) -> tuple[list[object], DecodeStats]:
    """What pymavlink's own parser makes of the chunks."""
    ends = mavlink2.MAVLink(None)
    ends.robust_parsing = True
    if key is not None:
        set_signing(ends, key)
    stats = DecodeStats()
    messages = []
    for message in (message for chunk in chunks for message in ends.parse_buffer(chunk) or []):
        if message.get_type() == "BAD_DATA":
            stats.bad += 1
            stats.skipped_bytes += len(message.data)
        elif not message.get_type().startswith("UNKNOWN"):
            stats.good += 1
            messages.append(content(message))
    return messages, stats


def found(chunks: list[bytes], key: bytes | None = None) -> tuple[list[object], DecodeStats]:
    parser = MavlinkParser(key)
    return [content(message) for chunk in chunks for message in parser.feed(chunk)], parser.stats


def damaged(data: bytes, rng: random.Random) -> bytes:
    """The same, a bit flipped, cut short, or of a message that nobody knows."""
    match rng.choice(("sound", "sound", "flipped", "cut", "noise", "unknown", "incompatible")):
        case "flipped":
            at = rng.randrange(len(data))
            return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
        case "cut":
            return data[: rng.randrange(len(data))]
        case "noise":
            return rng.randbytes(rng.randint(1, 20)) + data
        case "unknown":
            return b"\xfd\x02\0\0\x07\x01\x01\xff\xff\xffab\x12\x34" + data
        case "incompatible":
            return data[:2] + b"\x02" + data[3:]
    return data


@given(rng=st.integers(0, 2**32).map(random.Random), signs=st.booleans(), asks=st.booleans())
def test_any_stream_in_any_chunks_gives_what_pymavlink_makes_of_it(
    rng: random.Random, signs: bool, asks: bool
) -> None:
    kinds = [mavlink2.mavlink_map[kind] for kind in rng.sample(KINDS, 4)] + USUAL
    frames = [
        damaged(frame(rng.choice(kinds), rng, rng.choice((1, 2, 2, 2)), KEY if signs else None), rng)
        for _ in range(12)
    ]
    if rng.random() < 0.5:
        chunks = frames
    else:
        stream, chunks = b"".join(frames), []
        while stream:
            size = rng.randint(1, 120)
            chunks.append(stream[:size])
            stream = stream[size:]
    key = KEY if asks else None
    assert found(chunks, key) == expected(chunks, key)


def test_every_kind_of_message_is_read_as_pymavlink_reads_it() -> None:
    rng = random.Random(0)
    for kind in KINDS:
        chunks = [frame(mavlink2.mavlink_map[kind], rng) for _ in range(3)]
        assert found(chunks) == expected(chunks)


def test_usual_messages_do_not_need_pymavlinks_parser() -> None:
    rng = random.Random(1)
    for make in USUAL:
        data = b"before" + frame(make, rng) + frame(make, rng)
        message = plain_message(data, 6)
        assert message is not None
        assert message.get_type() == make.msgname
        assert plain_message(data, 6 + len(message.get_msgbuf())) is not None


@given(rng=st.integers(0, 2**32).map(random.Random), changed=st.integers(1, 255))
def test_a_message_with_a_wrong_byte_is_left_to_pymavlinks_parser(rng: random.Random, changed: int) -> None:
    data = bytearray(frame(rng.choice(USUAL), rng))
    data[rng.randrange(len(data))] ^= changed
    assert plain_message(bytes(data), 0) is None


def test_a_signed_message_is_refused_with_a_wrong_key_and_not_looked_at_without_one() -> None:
    data = frame(USUAL[1], random.Random(2), key=KEY)
    assert found([data])[1] == DecodeStats(good=1)
    assert found([data], KEY)[1] == DecodeStats(good=1)
    assert found([data], bytes(32))[1] == DecodeStats(bad=1, skipped_bytes=len(data))
    unsigned = frame(USUAL[1], random.Random(2))
    assert found([unsigned], KEY)[1] == DecodeStats(bad=1, skipped_bytes=len(unsigned))
