"""Writes MCAP, whole chunks at a time.

The library's own writer spends 10 µs on each message, in an object and seven small writes; three
hundred messages a second make that the greater part of a recorder. What is rare is left to it.
"""

import itertools
import struct
import zlib
from collections import defaultdict
from collections.abc import Mapping

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from gigabrain_zenoh.recording.records import MAGIC
from gigabrain_zenoh.recording.tape import Tape

MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log and publish time
FIXED = MESSAGE.size - 9  # [bytes] of a message beside its payload, as its length counts them
FOOTER = struct.Struct("<BQQQ")  # what of the footer its checksum covers
LEVEL = 1  # of zstd: less work than its usual 3, for a file that is 3 % larger


class Writer:
    """Writes into a tape. Raises OSError where that takes no more."""

    def __init__(self, tape: Tape, chunk_bytes: int, *, message_index: bool) -> None:
        self._tape, self._chunk_bytes, self._with_index = tape, chunk_bytes, message_index
        self._zstd = zstandard.ZstdCompressor(LEVEL)
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._metadata: list[MetadataIndex] = []
        self._chunks: list[ChunkIndex] = []
        self._counts: dict[int, int] = defaultdict(int)  # messages by channel
        self._begin_chunk()

    def start(self, profile: str, library: str) -> None:
        """Write what every file begins with."""
        self._tape.write(MAGIC + _record(Header(profile, library)))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """A new schema; its number."""
        number = len(self._schemas) + 1
        self._schemas.append(Schema(id=number, name=name, encoding=encoding, data=data))
        self._chunk += _record(self._schemas[-1])
        return number

    def register_channel(
        self, topic: str, encoding: str, schema: int, notes: Mapping[str, str]
    ) -> int:
        """A new channel of messages in `encoding`; its number. Schema 0 is none."""
        number = len(self._channels) + 1
        self._channels.append(
            Channel(
                id=number,
                topic=topic,
                message_encoding=encoding,
                metadata=dict(notes),
                schema_id=schema,
            )
        )
        self._chunk += _record(self._channels[-1])
        return number

    def add_message(
        self, channel: int, log_ns: int, payload: bytes, publish_ns: int, sequence: int = 0
    ) -> None:
        """Append one message to the present chunk, and write that where it is full."""
        chunk = self._chunk
        self._places[channel] += (log_ns, len(chunk))
        chunk += MESSAGE.pack(
            Opcode.MESSAGE, FIXED + len(payload), channel, sequence, log_ns, publish_ns
        )
        chunk += payload
        if len(chunk) > self._chunk_bytes:
            self.flush()

    def add_metadata(self, name: str, words: Mapping[str, str]) -> None:
        """A named set of words."""
        record = _record(Metadata(name=name, metadata=dict(words)))
        index = MetadataIndex(offset=self._tape.size, length=len(record), name=name)
        self._metadata.append(index)
        self._tape.write(record)

    def flush(self) -> None:
        """Write the present chunk, unless there is no message in it."""
        places = self._places
        if not places:
            return
        data = bytes(self._chunk)
        self._begin_chunk()
        times = [time for place in places.values() for time in place[::2]]
        chunk = Chunk(
            compression="zstd",
            data=self._zstd.compress(data),
            message_end_time=max(times),
            message_start_time=min(times),
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data),
        )
        self._write(chunk, places)

    def _write(self, chunk: Chunk, places: Mapping[int, list[int]]) -> None:
        """A chunk with its indexes in one piece: a file that is cut off has all or nothing."""
        record, at, offsets, indexes = _record(chunk), self._tape.size, {}, b""
        for channel, place in places.items():
            self._counts[channel] += len(place) // 2
            if self._with_index:
                offsets[channel] = at + len(record) + len(indexes)
                indexes += _index(channel, place)
        self._tape.write(record + indexes)
        self._chunks.append(
            ChunkIndex(
                chunk_length=len(record),
                chunk_start_offset=at,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=chunk.message_end_time,
                message_index_length=len(indexes),
                message_index_offsets=offsets,
                message_start_time=chunk.message_start_time,
                uncompressed_size=chunk.uncompressed_size,
            )
        )

    def finish(self) -> None:
        """Write the summary, without which most programs refuse to open a file."""
        self.flush()
        self._tape.write(_record(DataEnd(0)))
        begin, summary, offsets = self._tape.size, b"", b""
        for opcode, group in self._groups():
            records = b"".join(map(_record, group))
            offset = SummaryOffset(
                group_opcode=opcode,
                group_start=begin + len(summary),
                group_length=len(records),
            )
            offsets += _record(offset) if records else b""
            summary += records
        at = begin + len(summary)
        summary += offsets
        crc = zlib.crc32(summary + FOOTER.pack(Opcode.FOOTER, 20, begin, at))
        footer = Footer(summary_start=begin, summary_offset_start=at, summary_crc=crc)
        self._tape.write(summary + _record(footer) + MAGIC)

    def _begin_chunk(self) -> None:
        self._chunk = bytearray()
        self._places: dict[int, list[int]] = defaultdict(list)  # by channel: time, offset, time, …

    def _groups(self) -> list[tuple[Opcode, list[McapRecord]]]:
        """What is said at the end, of each kind together."""
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=max((one.message_end_time for one in self._chunks), default=0),
            message_start_time=min((one.message_start_time for one in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        return [
            (Opcode.SCHEMA, [*self._schemas]),
            (Opcode.CHANNEL, [*self._channels]),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, [*self._chunks]),
            (Opcode.METADATA_INDEX, [*self._metadata]),
        ]


def _record(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    written: bytes = builder.end()
    return written


def _index(channel: int, place: list[int]) -> bytes:
    """Where in the chunk the messages of one channel are: times and offsets in turn."""
    size = 8 * len(place)
    head = (Opcode.MESSAGE_INDEX, 6 + size, channel, size)
    return struct.pack(f"<BQHI{len(place)}Q", *itertools.chain(head, place))
