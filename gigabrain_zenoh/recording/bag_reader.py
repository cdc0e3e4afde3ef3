"""Reads a bag from its first byte to its last, also if it is damaged or cut off; reports damage.

The mcap library parses single records. Its own readers end at the first damaged byte, return
messages that are cut off as whole ones, and allocate as much memory as a chunk claims to need.
So this module goes from record to record itself, with limits.
"""

import contextlib
import logging
import mmap
import struct
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, McapRecord, Message, Metadata, Schema
from mcap.writer import MCAP0_MAGIC
from msgspec import Struct

from gigabrain_schemas.topics import DEPTH, IMAGE, current_key
from gigabrain_zenoh.bus.headers import Header, SequenceGaps, header_of
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.escaping import printable
from gigabrain_zenoh.host.files import cannot_read, open_regular

log = logging.getLogger(__name__)

RAW = "raw"  # kind of a channel that holds recorded messages
MAGIC = MCAP0_MAGIC
HEAD = struct.Struct("<BQ")  # opcode and length of a record
RECORD_READERS: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.CHUNK: Chunk.read,
    Opcode.METADATA: Metadata.read,
    Opcode.FOOTER: Footer.read,
}
MALFORMED = (McapError, struct.error, UnicodeDecodeError)
FOOTER_BYTES = HEAD.size + 20
ZSTD_NAME = b"\x04\x00\x00\x00zstd"
BYTES_BEFORE_NAME = HEAD.size + 28  # from a chunk's opcode to the name of its compression
READ_BYTES = 1 << 16
MAX_RECORD_BYTES = 48 << 20  # also of a decompressed chunk; usual chunks have 1 MB
MAX_WINDOW_BYTES = 1 << 25  # memory of a decompressor


class BagDamage(NamedTuple):
    """Part of a bag that cannot be read."""

    offset: int  # [bytes] from the start of the file
    text: str


class BagEnd(NamedTuple):
    """Regular end of a bag."""

    index_ok: bool


class Sample(NamedTuple):
    """One recorded message."""

    log_ns: int  # Unix time of reception
    key: str
    encoding: str  # Zenoh's encoding
    schema: str
    payload: bytes

    @property
    def header(self) -> Header:
        """Return the header of the message."""
        return header_of(self.payload)


class Bag:
    """Recording on disk. Reading continues after damaged parts."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damages: list[BagDamage] = []  # reading the bag sets this and the next three
        self.finished = False
        self.index_ok = False
        self.notes: dict[str, Mapping[str, str]] = {}  # named tables of texts

    def __iter__(self) -> Iterator[Sample]:
        """Iterate over all messages from the bus. Raises ConfigError if the file is not a bag."""
        for channel, schema, message in self.messages():
            if channel.metadata.get("kind") == RAW:
                yield Sample(
                    message.log_time,
                    current_key(channel.topic),
                    channel.metadata.get("zenoh_encoding", ""),
                    schema.name if schema else "",
                    message.data,
                )

    def messages(self) -> Iterator[tuple[Channel, Schema | None, Message]]:
        """Iterate over all messages, including those for viewers. Raises ConfigError."""
        self.damages, self.finished, self.index_ok = [], False, False
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        undeclared = 0
        for item in read_records(self.path):
            if isinstance(item, Message):
                if channel := channels.get(item.channel_id):
                    yield channel, schemas.get(channel.schema_id), item
                else:
                    undeclared += 1
            elif isinstance(item, Channel):
                channels[item.id] = item
            elif isinstance(item, Schema):
                schemas[item.id] = item
            elif isinstance(item, Metadata):
                self.notes[item.name] = item.metadata
            elif isinstance(item, BagDamage):
                self.damages.append(item)
            elif isinstance(item, BagEnd):
                self.finished, self.index_ok = True, item.index_ok
        if undeclared:
            text = f"{undeclared} messages of keys that only damaged parts declare cannot be read"
            self.damages.append(BagDamage(len(MAGIC), text))


def samples(path: Path) -> Iterator[Sample]:
    """Iterate over all messages from the bus; log a warning if the bag is damaged.

    Raises ConfigError if the file is not a bag.
    """
    bag = Bag(path)
    yield from bag
    damage = bag.damages[0].text if bag.damages else "" if bag.finished else "the file is cut off"
    if damage:
        log.warning("%s: %s; repair it with: gigabrain bag recover %s", path, damage, path)


def check_magic(path: Path) -> None:
    """Raise ConfigError if the file is not a bag, with the reason."""
    try:
        with open_regular(path) as file:
            head = file.read(len(MAGIC))
    except OSError as error:
        raise cannot_read(path, error) from None
    if not head:
        raise ConfigError(f"{path} is empty")
    if head[:5] == MAGIC[:5] and head[6:] == MAGIC[6:] and head != MAGIC:
        version = head[5:6].decode("ascii", "replace")
        raise ConfigError(f"{path} is MCAP of version {version}; version 0 can be read")
    if head != MAGIC:
        raise ConfigError(f"{path}: not a recording; expected an MCAP file")


def read_records(path: Path) -> Iterator[McapRecord | BagDamage | BagEnd]:
    """Iterate over all records in order, also those in chunks. Raises ConfigError."""
    check_magic(path)
    with open_regular(path) as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        yield from _records(data)


def _records(data: mmap.mmap) -> Iterator[McapRecord | BagDamage | BagEnd]:
    at, end = len(MAGIC), len(data)
    summary = _summary(data)
    if summary:  # declares also the channels and schemas of damaged chunks
        yield from (item for item in _parse(summary, at) if isinstance(item, Schema | Channel))
    while at < end:
        opcode, after = _head(data, at)
        whole = opcode > 0 and after <= end
        if whole and opcode == Opcode.DATA_END:
            yield BagEnd(summary is not None)
            return
        if whole and after - at > MAX_RECORD_BYTES:
            yield BagDamage(at, f"a record of {(after - at) / 1e6:.0f} MB is skipped")
        elif whole:
            yield from _unpacked(data[at:after], at)
        elif (chunk := _next_chunk(data, at + 1)) > 0:
            yield BagDamage(at, "there is no valid record here")
            after = chunk
        else:
            if opcode == Opcode.CHUNK:
                yield from _cut_off_chunk(data[at : at + MAX_RECORD_BYTES])
            break
        at = after
    yield BagDamage(at, "the file is cut off here")


def _head(data: mmap.mmap, at: int) -> tuple[int, int]:
    """Return opcode and end offset of the record at `at`; opcode 0 without a record."""
    if at + HEAD.size > len(data):
        return 0, at
    opcode, length = HEAD.unpack_from(data, at)
    known = Opcode.HEADER <= opcode <= Opcode.DATA_END
    return (opcode, at + HEAD.size + length) if known else (0, at)


def _next_chunk(data: mmap.mmap, at: int) -> int:
    """Return the offset of the next chunk, found by the name of its compression; -1 without one."""
    name = data.find(ZSTD_NAME, at + BYTES_BEFORE_NAME)
    while name > 0:
        opcode, after = _head(data, name - BYTES_BEFORE_NAME)
        if opcode == Opcode.CHUNK and after > name:
            return name - BYTES_BEFORE_NAME
        name = data.find(ZSTD_NAME, name + 1)
    return -1


def _summary(data: mmap.mmap) -> bytes | None:
    """Return the part after the messages, or None if it is absent or damaged."""
    at = len(data) - len(MAGIC) - FOOTER_BYTES
    if at < len(MAGIC) or data[-len(MAGIC) :] != MAGIC:
        return None
    footer = next(_parse(data[at : -len(MAGIC)], at), None)
    if not isinstance(footer, Footer) or not 0 < footer.summary_start <= at:
        return None
    if at - footer.summary_start > MAX_RECORD_BYTES:
        return None
    summary = data[footer.summary_start : len(data) - len(MAGIC) - 4]
    ok = footer.summary_crc in (0, zlib.crc32(summary))
    return data[footer.summary_start : at] if ok else None


def _unpacked(record: bytes, at: int) -> Iterator[McapRecord | BagDamage]:
    """Parse one record; for a chunk yield its records, or only damage if its checksum is wrong."""
    for item in _parse(record, at):
        if not isinstance(item, Chunk):
            yield item
            continue
        records, complete = _decompressed(item)
        crc = item.uncompressed_crc
        if complete and (not crc or zlib.crc32(records) == crc):
            yield from _parse(records, at)
        else:
            yield BagDamage(at, f"a chunk of {len(record) - HEAD.size} bytes is damaged")


def _cut_off_chunk(record: bytes) -> Iterator[McapRecord]:
    """Parse the start of a chunk whose end is missing."""
    with contextlib.suppress(*MALFORMED):
        chunk = Chunk.read(ReadDataStream(BytesIO(record[HEAD.size :])))
        for item in _parse(_decompressed(chunk)[0], 0):
            if not isinstance(item, BagDamage):
                yield item


def _decompressed(chunk: Chunk) -> tuple[bytes, bool]:
    """Return the content that decompresses within the limits, and whether it is complete."""
    if chunk.compression == "":
        return chunk.data, True
    records = bytearray()
    try:
        reader = _decompressor(chunk)
        while len(records) < MAX_RECORD_BYTES and (piece := reader.read(READ_BYTES)):
            records += piece
    except (zstandard.ZstdError, RuntimeError, EOFError):
        return bytes(records), False
    return bytes(records), len(records) < MAX_RECORD_BYTES


def _decompressor(chunk: Chunk) -> IO[bytes]:
    if chunk.compression == "zstd":
        decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES)
        return decompressor.stream_reader(chunk.data)
    if chunk.compression == "lz4":
        return lz4.frame.open(BytesIO(chunk.data), "rb")  # type: ignore[no-any-return]
    raise EOFError(f"unknown compression {chunk.compression!r}")


def _parse(records: bytes, offset: int) -> Iterator[McapRecord | BagDamage]:
    """Parse consecutive records; report each malformed one as damage at `offset`, and continue."""
    at = 0
    while at + HEAD.size <= len(records):
        opcode, length = HEAD.unpack_from(records, at)
        content = records[at + HEAD.size : at + HEAD.size + length]
        at += HEAD.size + length
        try:
            if at > len(records):
                raise EndOfFile
            stream = _StrictStream(BytesIO(content))
            if opcode == Opcode.MESSAGE:
                yield Message.read(stream, length)
            elif read := RECORD_READERS.get(opcode):
                yield read(stream)
        except MALFORMED:
            yield BagDamage(offset, f"a record of {len(content)} bytes is malformed")


class _StrictStream(ReadDataStream):
    """Content of one record. Raises EndOfFile where the library would return too few bytes."""

    def read(self, length: int) -> bytes:
        if length > MAX_RECORD_BYTES:  # a stream would allocate it
            raise EndOfFile
        data = super().read(length)
        if len(data) < length:
            raise EndOfFile
        return data


PICTURE_KEYS = (f"{IMAGE.key}/", f"{DEPTH.key}/")
PICTURES_NOTE = "pictures"  # name of the note with the rate of a thinned recording
TABLE_HEAD = (
    f"{'key':<28} {'message':<14} {'messages':>8} {'hz':>7} {'kB':>9} {'missing':>8} "
    f"{'restarts':>9} {'longest gap':>11}"
)


class KeyInfo(Struct, frozen=True, kw_only=True):
    """Figures of one key of a recording."""

    key: str
    message: str  # name of its type
    messages: int
    bytes: int
    hz: float  # between the first and the last message
    missing: int  # according to the sender's numbers
    restarts: int  # of the sender's numbers
    longest_gap_s: float  # between two messages


class BagInfo(Struct, frozen=True, kw_only=True):
    """Figures of a whole recording."""

    path: str
    bytes: int  # of the file
    start_ns: int  # Unix time of the first message
    seconds: float
    messages: int
    finished: bool  # it has its end and an intact index
    damages: tuple[str, ...]
    keys: tuple[KeyInfo, ...]
    notes: dict[str, dict[str, str]]


class _KeyCounts:
    def __init__(self) -> None:
        self.messages = self.bytes = self.first_ns = self.last_ns = self.longest_ns = 0
        self.message = ""

    def info(self, key: str, gaps: SequenceGaps) -> KeyInfo:
        seconds = (self.last_ns - self.first_ns) / 1e9
        return KeyInfo(
            key=key,
            message=self.message,
            messages=self.messages,
            bytes=self.bytes,
            hz=round((self.messages - 1) / seconds, 2) if seconds else 0.0,
            missing=gaps.missing[key],
            restarts=gaps.restarts[key],
            longest_gap_s=round(self.longest_ns / 1e9, 3),
        )


def read_info(path: Path) -> BagInfo:
    """Read all of `path`. Raises ConfigError if the file is not a bag."""
    bag, gaps, keys = Bag(path), SequenceGaps(), dict[str, _KeyCounts]()
    first_ns = last_ns = 0
    for sample in bag:
        if not (sample.key.startswith(PICTURE_KEYS) and _leaves_out_pictures(bag)):
            gaps.count(sample.key, sample.header)
        key = keys.setdefault(sample.key, _KeyCounts())
        if key.messages:
            key.longest_ns = max(key.longest_ns, sample.log_ns - key.last_ns)
        key.first_ns = key.first_ns or sample.log_ns
        key.last_ns, key.message = sample.log_ns, sample.schema.removeprefix("gigabrain.")
        key.messages, key.bytes = key.messages + 1, key.bytes + len(sample.payload)
        first_ns, last_ns = first_ns or sample.log_ns, sample.log_ns
    infos = tuple(keys[key].info(key, gaps) for key in sorted(keys))
    return BagInfo(
        path=str(path),
        bytes=path.stat().st_size,
        start_ns=first_ns,
        seconds=round((last_ns - first_ns) / 1e9, 3),
        messages=sum(key.messages for key in infos),
        finished=bag.finished and bag.index_ok,
        damages=tuple(f"byte {damage.offset}: {damage.text}" for damage in bag.damages),
        keys=infos,
        notes={name: dict(values) for name, values in bag.notes.items()},
    )


def _leaves_out_pictures(bag: Bag) -> bool:
    return PICTURES_NOTE in bag.notes.get("gigabrain", {})


def faults(info: BagInfo) -> list[str]:
    """Return a sentence for each fault of a recording; empty if it has none."""
    found = list(info.damages)
    if not info.finished and not info.damages:
        found.append("its index is damaged")
    missing = [(key.key, key.missing) for key in info.keys if key.missing]
    return found + [f"{key}: {count} messages are missing" for key, count in missing]


def print_info(info: BagInfo) -> None:
    """Print the figures of a recording as a table."""
    when = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(info.start_ns / 1e9))
    state = "finished" if info.finished else "unfinished or damaged"
    notes = "  ".join(
        f"{k} {v}" for k, v in info.notes.get("gigabrain", {}).items() if v[:1] != "{"
    )
    print(printable(f"{info.path}: {info.bytes / 1e6:.2f} MB, {state}  {notes}".rstrip()))
    print(f"{when}, {info.seconds:.1f} s, {info.messages} messages" if info.messages else "empty")
    print(TABLE_HEAD)
    for key in info.keys:
        gap = f"{key.longest_gap_s:.2f} s"
        print(
            f"{printable(key.key):<28} {printable(key.message):<14} {key.messages:>8} "
            f"{key.hz:>7.1f} {key.bytes / 1e3:>9.1f} {key.missing:>8} {key.restarts:>9} {gap:>11}"
        )
    for damage in info.damages:
        print(damage)
