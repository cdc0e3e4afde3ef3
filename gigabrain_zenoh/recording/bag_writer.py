"""Writes one MCAP file: every message byte for byte, and the messages that viewers draw."""

import contextlib
import logging
import os
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from foxglove import Schema
from mcap.data_stream import RecordBuilder
from mcap.records import Channel
from mcap.records import Schema as RecordedSchema
from mcap.well_known import MessageEncoding
from mcap.writer import IndexType, Writer

from gigabrain_schemas.topics import CMD_VEL, DEPTH, INTENT, STATE, TASK, TOPICS, Topic
from gigabrain_zenoh.bus.headers import Header, is_json
from gigabrain_zenoh.bus.listening import topic_of
from gigabrain_zenoh.codec import Codec, encoding_of
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import cannot_write
from gigabrain_zenoh.host.posix import fcntl
from gigabrain_zenoh.recording.bag_reader import RAW
from gigabrain_zenoh.recording.drawing import Drawer
from gigabrain_zenoh.recording.drawn import Drawn, json_schema

log = logging.getLogger(__name__)

PROFILE, LIBRARY = "gigabrain", "gigabrain-zenoh"
VIEW = "view"  # kind of a channel of drawings; channels of recorded messages are RAW
MIN_DRAWN_INTERVAL_NS = {
    STATE.key: 30_000_000,
    CMD_VEL.key: 30_000_000,
    TASK.key: 450_000_000,  # contains the whole path to the goal
    DEPTH.key: 450_000_000,  # for each camera; drawings are uncompressed
}
TYPE_BY_ENCODING = {encoding_of(topic.type): topic.type for topic in TOPICS}
_fdatasync = getattr(os, "fdatasync", os.fsync)  # macOS has no fdatasync


class ReceivedMessage(NamedTuple):
    """One message as it was received."""

    log_ns: int  # Unix time of reception; strictly increasing
    key: str
    encoding: str  # Zenoh's encoding
    payload: bytes
    header: Header


class AppendOnlyFile:
    """New file, locked while it is open, which a failed append does not change.

    `write` only collects data. `flush` appends all of it or nothing, so that a full disk leaves no
    incomplete chunk. Raises ConfigError if the file exists.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.size = path, 0  # size on the disk [bytes]
        self.pending = bytearray()
        try:
            if not path.parent.is_dir():
                path.parent.mkdir(parents=True)
            self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        except FileExistsError as error:
            raise ConfigError(f"{error.filename} exists; choose another file") from None
        except OSError as error:
            raise cannot_write(path, error) from None
        fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)  # recovery then skips this file

    def write(self, data: bytes) -> int:
        """Collect data for the next `flush`."""
        self.pending += data
        return len(data)

    def tell(self) -> int:
        """Return the size including collected data [bytes]."""
        return self.size + len(self.pending)

    def flush(self) -> None:
        """Append all collected data. Raises OSError."""
        data, self.pending = bytes(self.pending), bytearray()
        if data:
            self.append(data)

    def append(self, data: bytes) -> None:
        """Append all of `data`, or nothing and raise OSError."""
        view = memoryview(data)
        try:
            while view:
                view = view[os.write(self._fd, view) :]
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self.size)
                os.lseek(self._fd, self.size, os.SEEK_SET)
            raise
        self.size += len(data)

    def sync(self) -> None:
        """Force appended data to the disk. Raises OSError."""
        _fdatasync(self._fd)

    def free_bytes(self) -> int:
        """Return the free space on the disk [bytes]."""
        disk = os.fstatvfs(self._fd)
        return disk.f_bavail * disk.f_frsize

    def is_deleted(self) -> bool:
        """Return whether the file was deleted from its folder."""
        return os.fstat(self._fd).st_nlink == 0

    def close(self) -> None:
        """Close and unlock the file."""
        os.close(self._fd)


class _Channel(NamedTuple):
    """Channel for messages of one key and encoding."""

    id: int
    drawn: Topic[Any] | None  # None if there are no drawings of this key


class BagWriter:
    """Recording in progress.

    Raises ConfigError if the file cannot be created, and OSError if the disk is full.
    """

    def __init__(self, path: Path, *, viewers: bool, notes: Mapping[str, str]) -> None:
        self._file, self._stored_bytes = AppendOnlyFile(path), 0
        index = IndexType.ALL if viewers else IndexType.CHUNK | IndexType.METADATA
        self._writer = Writer(self._file, index_types=index)  # type: ignore[arg-type]
        try:
            self._writer.start(PROFILE, LIBRARY)
            self.add_notes("gigabrain", notes)
            self._file.sync()
        except OSError as error:
            self._file.close()
            path.unlink(missing_ok=True)
            raise cannot_write(path, error) from None
        self._viewers, self._drawer = viewers, Drawer()
        self._decoders = {t.type: Codec(t.type, t.max_bytes).decode for t in TOPICS}
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str, bool], _Channel] = {}
        self._view_channels: dict[tuple[str, str], int] = {}  # by topic and encoding
        self._last_drawn_ns: dict[str, int] = {}  # by key
        self._last_intent = (0, -1)  # boot and basis
        self.pending: Counter[str] = Counter()  # messages per key that are not on the disk yet
        self.written = 0  # messages on the disk
        self.first_ns = 0
        self.repeated_bytes = 0  # on the disk, of messages repeated from earlier files
        self.index_entries = 0  # in memory until the end: one per chunk and channel in it
        self._in_chunk: set[int] = set()  # channels of the messages in the current chunk

    @property
    def path(self) -> Path:
        """Path of the file."""
        return self._file.path

    @property
    def size(self) -> int:
        """Size on the disk [bytes]."""
        return self._file.size

    def free_bytes(self) -> int:
        """Return the free space on the disk [bytes]."""
        return self._file.free_bytes()

    def is_deleted(self) -> bool:
        """Return whether the file was deleted."""
        return self._file.is_deleted()

    def add(self, message: ReceivedMessage, *, repeated: bool = False) -> None:
        """Append one message, and its drawings for viewers.

        A `repeated` message is already in an earlier file, and is not counted again.
        """
        log_ns, key, encoding, payload, header = message
        kind = key, encoding, is_json(payload)
        try:
            channel = self._channels.get(kind) or self._add_channel(kind)
        finally:  # counted also if the disk is full: then the message is lost
            self.pending[key] += not repeated
        self.first_ns = self.first_ns or log_ns
        stamp_ns = header.stamp_ns or log_ns
        self._in_chunk.add(channel.id)
        self._writer.add_message(channel.id, log_ns, payload, stamp_ns, header.seq & 0xFFFF_FFFF)
        if channel.drawn and self._is_worth_drawing(channel.drawn, message):
            self._draw(channel.drawn, message)
        self._store()

    def repeat(self, messages: Iterable[ReceivedMessage], log_ns: int) -> None:
        """Write messages of earlier files first, and sync them to the disk."""
        before = self.size
        for message in messages:
            self.add(message._replace(log_ns=log_ns), repeated=True)
        self.flush()
        self.repeated_bytes = self.size - before

    def flush(self) -> None:
        """Sync all messages to the disk."""
        self._writer.flush()
        self._store()
        self._file.sync()

    def add_notes(self, name: str, values: Mapping[str, str]) -> None:
        """Append a named table of texts."""
        self._writer.add_metadata(name, dict(values))
        self._file.flush()
        self._stored_bytes = self._file.size

    def finish(self) -> None:
        """Write the index, without which most programs refuse to open the file."""
        self._writer.finish()
        self._store()
        self._file.sync()

    def close(self) -> None:
        """Close the file, finished or not."""
        self._file.close()

    def _store(self) -> None:
        """Append the chunk that the library finished, if any: it contains all messages so far."""
        self._file.flush()
        if self._file.size != self._stored_bytes:
            self._stored_bytes = self._file.size
            self.index_entries += len(self._in_chunk)
            self._in_chunk.clear()
            self.written += self.pending.total()
            self.pending = Counter()

    def _add_channel(self, kind: tuple[str, str, bool]) -> _Channel:
        key, encoding, json = kind
        topic = topic_of(key)
        form = MessageEncoding.JSON if json else "msgpack"
        notes = {"kind": RAW, "zenoh_encoding": encoding}
        type_ = topic.type if topic else TYPE_BY_ENCODING.get(encoding)
        schema = self._schema(json_schema(type_)) if type_ else 0
        number = self._register(key, form, schema, notes)
        drawn = topic if topic and self._viewers and self._drawer.draws(topic) else None
        self._channels[kind] = _Channel(number, drawn)
        return self._channels[kind]

    def _register(self, key: str, form: str, schema: int, notes: dict[str, str]) -> int:
        number = self._writer.register_channel(key, form, schema, notes)
        self._declare_again(Channel(number, key, form, notes, schema))
        return number

    def _schema(self, of: Schema) -> int:
        if of.name not in self._schemas:
            number = self._writer.register_schema(of.name, of.encoding, of.data)
            self._declare_again(RecordedSchema(number, of.data, of.encoding, of.name))
            self._schemas[of.name] = number
        return self._schemas[of.name]

    def _declare_again(self, record: Channel | RecordedSchema) -> None:
        """Append a declaration outside the chunks, so that it survives a damaged chunk."""
        self._store()  # a large schema may finish the chunk before its message
        builder = RecordBuilder()
        record.write(builder)
        self._file.write(builder.end())
        self._file.flush()
        self._stored_bytes = self._file.size

    def _draw(self, topic: Topic[Any], received: ReceivedMessage) -> None:
        try:
            message = self._decoders[topic.type](received.payload)
        except ValueError:  # an invalid message is kept, but cannot be drawn
            return
        stamp_ns = received.header.stamp_ns or received.log_ns
        for drawn in self._drawer.draw(topic, message, received.key.rpartition("/")[2]):
            channel = self._view_channel(drawn)
            self._in_chunk.add(channel)
            self._writer.add_message(channel, received.log_ns, drawn.data, stamp_ns)

    def _is_worth_drawing(self, topic: Topic[Any], message: ReceivedMessage) -> bool:
        """Return whether a drawing would show something new; called before decoding."""
        key, header = message.key, message.header
        if key == INTENT.key:  # repeated with every tick
            before, self._last_intent = self._last_intent, (header.boot, header.basis)
            return before != self._last_intent
        interval_ns = MIN_DRAWN_INTERVAL_NS.get(topic.key)
        if interval_ns is not None:
            if message.log_ns - self._last_drawn_ns.get(key, 0) < interval_ns:
                return False
            self._last_drawn_ns[key] = message.log_ns
        return True

    def _view_channel(self, drawn: Drawn) -> int:
        kind = drawn.topic, drawn.encoding
        if kind not in self._view_channels:
            schema = self._schema(drawn.schema())
            self._view_channels[kind] = self._register(*kind, schema, {"kind": VIEW})
        return self._view_channels[kind]
