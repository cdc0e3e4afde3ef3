"""What an interrupted recording has left, as a whole file with an index."""

import logging
import os
from pathlib import Path

from mcap.records import Channel, Schema
from mcap.writer import CompressionType, Writer
from msgspec import Struct

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.bounded_file import open_regular
from gigabrain_zenoh.recording.reading import Bag
from gigabrain_zenoh.recording.records import MAGIC, Damage, Message, check_magic
from gigabrain_zenoh.recording.tape import Tape, being_written

log = logging.getLogger(__name__)


class Recovered(Struct, frozen=True, kw_only=True):
    """What came of it."""

    path: Path
    messages: int
    damages: tuple[Damage, ...]


class Copier:
    """Copies messages with their channels and schemas into another file."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schemas: dict[int, int] = {}
        self._channels: dict[int, int] = {}
        self.messages = 0

    def copy(self, channel: Channel, schema: Schema | None, message: Message) -> None:
        """Append one."""
        if schema and schema.id not in self._schemas:
            self._schemas[schema.id] = self._writer.register_schema(
                schema.name, schema.encoding, schema.data
            )
        if channel.id not in self._channels:
            self._channels[channel.id] = self._writer.register_channel(
                channel.topic,
                channel.message_encoding,
                self._schemas[schema.id] if schema else 0,
                channel.metadata,
            )
        self._writer.add_message(
            self._channels[channel.id],
            message.log_ns,
            message.data,
            message.publish_ns,
            message.sequence,
        )
        self.messages += 1


def recover(path: Path, to: Path) -> Recovered:
    """Write all that can be read of `path` into the new file `to`.

    Raises ConfigError where `path` is no bag, or `to` cannot be written.
    """
    check_magic(path)  # before a file is made
    bag, tape = Bag(path), Tape(to)
    try:
        writer = Writer(tape, compression=CompressionType.ZSTD)  # type: ignore[arg-type]
        writer.start("gigabrain", "gigabrain-zenoh")
        copier = Copier(writer)
        for channel, schema, message in bag.messages():
            copier.copy(channel, schema, message)
        for name, values in bag.notes.items():
            writer.add_metadata(name, dict(values))
        writer.finish()
        tape.sync()
    except OSError as error:
        to.unlink(missing_ok=True)
        raise ConfigError(f"cannot write {to}: {error.strerror}") from None
    finally:
        tape.close()
    return Recovered(path=to, messages=copier.messages, damages=tuple(bag.damages))


def unfinished(path: Path) -> bool:
    """Whether `path` is a recording that was cut off, and that nobody is writing now."""
    with open_regular(path) as file:
        if file.read(len(MAGIC)) != MAGIC:
            return False
        file.seek(-len(MAGIC), os.SEEK_END)
        ended = file.read() == MAGIC and file.tell() > len(MAGIC)
    return not ended and not being_written(path)


def recover_all(folder: Path) -> None:
    """Mend every unfinished recording in `folder` in its place; what fails is logged and left."""
    for path in sorted(folder.glob("*.mcap")):
        part = path.with_suffix(".recovering")
        try:
            if not unfinished(path):
                continue
            part.unlink(missing_ok=True)  # of an attempt that was cut off in its turn
            done = recover(path, part)
            part.replace(path)
        except (ConfigError, OSError) as error:
            log.warning("%s could not be recovered: %s", path, error)
        else:
            log.info("%s was cut off and is whole again: %d messages", path, done.messages)
