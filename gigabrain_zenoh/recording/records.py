"""Reads a bag from its first byte to its last, however it ended, and says what is damaged.

The record layout is that of the MCAP specification: opcode u8, length u64, content; little-endian.
"""

import mmap
import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.bounded_file import open_regular

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")
CHUNK = struct.Struct("<QQQII")  # start, end, size, crc, length of the compression's name
FOOTER = struct.Struct("<QQI")  # where the summary begins, and its offsets; its crc
KINDS: dict[int, Callable[[ReadDataStream], Schema | Channel | Metadata]] = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.METADATA: Metadata.read,
}
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
ZSTD_NAME = b"\x04\x00\x00\x00zstd"
BEFORE_NAME = HEAD.size + CHUNK.size - 4  # from a chunk's opcode to the length of that name
PIECE = 1 << 16
MOST = 48 << 20  # [bytes] of a record, and that a chunk may grow to: writers' chunks are of 1 MB
WINDOW = 1 << 25  # [bytes] that a decompressor keeps at most


class Message(NamedTuple):
    """One message on one channel."""

    channel: int
    sequence: int
    log_ns: int
    publish_ns: int
    data: bytes


class Damage(NamedTuple):
    """Something that cannot be read."""

    offset: int  # [bytes] into the file
    what: str


class Finished(NamedTuple):
    """The end of a file that was ended well."""

    index_ok: bool


Item = Schema | Channel | Message | Metadata | Damage | Finished


def check_magic(path: Path) -> None:
    """Raises ConfigError for a file that is no bag, with what it is instead."""
    try:
        with open_regular(path) as file:
            head = file.read(len(MAGIC))
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None
    if head != MAGIC:
        raise _no_bag(path, head)


def read(path: Path) -> Iterator[Item]:
    """All that is in a bag, in order. Raises ConfigError for a file that is none."""
    check_magic(path)
    with open_regular(path) as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as whole:
        yield from _walk(whole)


def _no_bag(path: Path, head: bytes) -> ConfigError:
    if not head:
        return ConfigError(f"{path} is empty")
    if head[:5] == MAGIC[:5] and head[6:] == MAGIC[6:]:
        version = head[5:6].decode("ascii", "replace")
        return ConfigError(f"{path} is MCAP of version {version}; version 0 can be read")
    return ConfigError(f"{path} is not a bag (MCAP)")


def _walk(whole: mmap.mmap) -> Iterator[Item]:
    at, end = len(MAGIC), len(whole)
    summary = _summary(whole)
    if summary:  # what is declared in a damaged chunk is declared here once more
        yield from (item for item in _inner(summary) if isinstance(item, Schema | Channel))
    while at < end:
        opcode, after = _head(whole, at)
        if opcode == Opcode.DATA_END and after <= end:
            yield Finished(summary is not None)
            return
        if opcode and after <= end and after - at > MOST:
            yield Damage(at, f"a record of {(after - at) / 1e6:.0f} MB is passed over")
            at = after
        elif opcode and after <= end:
            body = whole[at + HEAD.size : after]
            yield from _chunk(body, at) if opcode == Opcode.CHUNK else _record(opcode, body)
            at = after
        elif (chunk := _next_chunk(whole, at + 1)) > 0:
            yield Damage(at, "what is here is no record")
            at = chunk
        else:
            if opcode == Opcode.CHUNK:
                yield from _torn(whole[at + HEAD.size : at + MOST])
            break
    yield Damage(at, "the file breaks off here")


def _head(whole: mmap.mmap, at: int) -> tuple[int, int]:
    """Opcode and end of the record at `at`; 0 for what cannot be one."""
    if at + HEAD.size > len(whole):
        return 0, at
    opcode, length = HEAD.unpack_from(whole, at)
    known = Opcode.HEADER <= opcode <= Opcode.DATA_END
    return (opcode, at + HEAD.size + length) if known else (0, at)


def _next_chunk(whole: mmap.mmap, at: int) -> int:
    """Where the next chunk begins, told by the name of its compression; -1 for nowhere."""
    name = whole.find(ZSTD_NAME, at + BEFORE_NAME)
    while name > 0:
        opcode, after = _head(whole, name - BEFORE_NAME)
        if opcode == Opcode.CHUNK and after > name:
            return name - BEFORE_NAME
        name = whole.find(ZSTD_NAME, name + 1)
    return -1


def _summary(whole: mmap.mmap) -> bytes | None:
    """The part behind the data, if it is there and whole."""
    footer = len(whole) - len(MAGIC) - HEAD.size - FOOTER.size
    if footer < len(MAGIC) or whole[-len(MAGIC) :] != MAGIC:
        return None
    opcode, length = HEAD.unpack_from(whole, footer)
    begin, _, crc = FOOTER.unpack_from(whole, footer + HEAD.size)
    if opcode != Opcode.FOOTER or length != FOOTER.size or not 0 < begin <= footer:
        return None
    if footer - begin > MOST:
        return None
    good = crc == 0 or zlib.crc32(whole[begin : len(whole) - len(MAGIC) - 4]) == crc
    return whole[begin:footer] if good else None


def _chunk(body: bytes, at: int) -> Iterator[Item]:
    """A whole chunk: all of it, or none where its checksum says no."""
    crc, name, data = _packed(body)
    records, intact = _unpack(name, data)
    if not intact or (crc and zlib.crc32(records) != crc):
        yield Damage(at, f"a chunk of {len(body)} bytes is damaged")
        return
    yield from _inner(records)


def _torn(body: bytes) -> Iterator[Item]:
    """The head of a chunk whose end was never written."""
    if len(body) > CHUNK.size:
        _, name, data = _packed(body)
        yield from _inner(_unpack(name, data)[0])


def _packed(body: bytes) -> tuple[int, str, bytes]:
    """Checksum, name of the compression, and compressed records of a chunk."""
    if len(body) < CHUNK.size:
        return 0, "", b""
    _, _, _, crc, length = CHUNK.unpack_from(body)
    name = body[CHUNK.size : CHUNK.size + length].decode("ascii", "replace")
    return crc, name, body[CHUNK.size + length + 8 :]


def _unpack(name: str, data: bytes) -> tuple[bytes | bytearray, bool]:
    """As much as can be decompressed, and whether that went well."""
    if name == "":
        return data, True
    records = bytearray()
    try:
        reader = _reader(name, data)
        while len(records) < MOST and (piece := reader.read(PIECE)):
            records += piece
    except (zstandard.ZstdError, RuntimeError, EOFError, ConfigError):
        return records, False
    return records, len(records) < MOST


def _reader(name: str, data: bytes) -> IO[bytes]:
    if name == "zstd":
        return zstandard.ZstdDecompressor(max_window_size=WINDOW).stream_reader(data)
    if name == "lz4":
        return lz4.frame.open(BytesIO(data), "rb")  # type: ignore[no-any-return]
    raise ConfigError(f"compression {name!r} is not known")


def _inner(records: bytes | bytearray) -> Iterator[Item]:
    """The records within a chunk, as far as they are whole."""
    at = 0
    while at + HEAD.size <= len(records):
        opcode, length = HEAD.unpack_from(records, at)
        at += HEAD.size
        if at + length > len(records):
            return
        yield from _record(opcode, bytes(records[at : at + length]))
        at += length


def _record(opcode: int, body: bytes) -> Iterator[Item]:
    """One record, if it is of a kind that matters here."""
    if opcode == Opcode.MESSAGE and len(body) >= MESSAGE.size:
        channel, sequence, log_ns, publish_ns = MESSAGE.unpack_from(body)
        yield Message(channel, sequence, log_ns, publish_ns, body[MESSAGE.size :])
    elif opcode in KINDS:
        try:
            yield KINDS[opcode](ReadDataStream(BytesIO(body)))
        except (McapError, struct.error, UnicodeDecodeError):
            return
