"""Copies what an interrupted recording holds into a whole file with an index."""

import logging
import os
from pathlib import Path

from mcap.records import Channel, Message, Schema
from mcap.writer import Writer
from msgspec import Struct

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import open_regular
from gigabrain_zenoh.recording.bag_reader import MAGIC, Bag, BagDamage, check_magic
from gigabrain_zenoh.recording.bag_writer import (
    LIBRARY,
    PROFILE,
    AppendOnlyFile,
    is_being_written,
)

log = logging.getLogger(__name__)


class Recovered(Struct, frozen=True, kw_only=True):
    """Result of a recovery."""

    path: Path
    messages: int
    damages: tuple[BagDamage, ...]


class _Copier:
    """Copies messages with their channels and schemas into another file."""

    def __init__(self, file: AppendOnlyFile) -> None:
        self._file, self._writer = file, Writer(file)  # type: ignore[arg-type]
        self._schemas: dict[int, int] = {}  # new number by old number
        self._channels: dict[int, int] = {}  # likewise
        self.messages = 0

    def copy(self, bag: Bag) -> None:
        """Copy all messages and notes, and write the index. Raises OSError."""
        self._writer.start(PROFILE, LIBRARY)
        for each in bag.messages():
            self._add(*each)
            self._file.flush()
        for name, values in bag.notes.items():
            self._writer.add_metadata(name, dict(values))
        self._writer.finish()
        self._file.flush()
        self._file.sync()

    def _add(self, channel: Channel, schema: Schema | None, message: Message) -> None:
        writer = self._writer
        if schema and schema.id not in self._schemas:
            self._schemas[schema.id] = writer.register_schema(
                schema.name, schema.encoding, schema.data
            )
        if channel.id not in self._channels:
            self._channels[channel.id] = writer.register_channel(
                channel.topic,
                channel.message_encoding,
                self._schemas[schema.id] if schema else 0,
                channel.metadata,
            )
        writer.add_message(
            self._channels[channel.id],
            message.log_time,
            message.data,
            message.publish_time,
            message.sequence,
        )
        self.messages += 1


def recover(path: Path, to: Path) -> Recovered:
    """Write everything readable of `path` into the new file `to`.

    Raises ConfigError if `path` is not a bag, or `to` cannot be written.
    """
    check_magic(path)  # before a file is made
    bag, file = Bag(path), AppendOnlyFile(to)
    copier = _Copier(file)
    try:
        copier.copy(bag)
    except OSError as error:
        to.unlink(missing_ok=True)
        raise ConfigError(f"cannot write {to}: {error.strerror}") from None
    finally:
        file.close()
    return Recovered(path=to, messages=copier.messages, damages=tuple(bag.damages))


def is_unfinished(path: Path) -> bool:
    """Return whether `path` is a recording that was interrupted, and is not being written now."""
    with open_regular(path) as file:
        if file.read(len(MAGIC)) != MAGIC:
            return False
        file.seek(-len(MAGIC), os.SEEK_END)
        ended = file.read() == MAGIC and file.tell() > len(MAGIC)
    return not ended and not is_being_written(path)


def recover_all(folder: Path) -> None:
    """Recover every unfinished recording in `folder` in place; log those that cannot be."""
    for path in sorted(folder.glob("*.mcap")):
        part = path.with_suffix(".recovering")
        try:
            if not is_unfinished(path):
                continue
            part.unlink(missing_ok=True)  # of an earlier attempt that was interrupted
            done = recover(path, part)
            part.replace(path)
        except (ConfigError, OSError) as error:
            log.warning("%s could not be recovered: %s", path, error)
        else:
            log.info("%s was cut off; recovered %d messages", path, done.messages)
