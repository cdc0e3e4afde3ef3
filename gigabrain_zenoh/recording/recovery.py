"""Recovers recordings that were cut off, into a new file or in place."""

import logging
import os
import shutil
import struct
from pathlib import Path

from mcap.records import Channel, Message, Schema
from mcap.writer import Writer
from msgspec import Struct

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import cannot_write, open_regular
from gigabrain_zenoh.host.posix import fcntl
from gigabrain_zenoh.recording.bag_reader import HEAD, MAGIC, Bag, BagDamage, check_magic
from gigabrain_zenoh.recording.bag_writer import LIBRARY, PROFILE, VIEW, AppendOnlyFile

log = logging.getLogger(__name__)

OWN_PROFILE = struct.pack("<I", len(PROFILE)) + PROFILE.encode()  # start of the first record
HEAD_BYTES = len(MAGIC) + HEAD.size + len(OWN_PROFILE)


class Recovered(Struct, frozen=True, kw_only=True):
    """Result of a recovery."""

    path: Path
    messages: int  # without drawings for viewers
    damages: tuple[BagDamage, ...]


class _Copier:
    """Copies messages with their channels and schemas into another file."""

    def __init__(self, file: AppendOnlyFile) -> None:
        self._file, self._writer = file, Writer(file)  # type: ignore[arg-type]
        self._schemas: dict[int, int] = {}  # new number by old number
        self._channels: dict[int, int] = {}  # new number by old number
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
        if channel.metadata.get("kind") != VIEW:
            self.messages += 1


def recover(path: Path, to: Path) -> Recovered:
    """Write everything readable of `path` into the new file `to`.

    If it fails or is interrupted, `to` is removed. Raises ConfigError if `path` is not a bag, or
    `to` cannot be written.
    """
    check_magic(path)  # before a file is created
    bag, file = Bag(path), AppendOnlyFile(to)
    copier = _Copier(file)
    try:
        copier.copy(bag)
    except BaseException as error:
        to.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise cannot_write(to, error) from None
        raise
    finally:
        file.close()
    return Recovered(path=to, messages=copier.messages, damages=tuple(bag.damages))


def is_being_written(path: Path) -> bool:
    """Return whether a recorder holds the lock on `path`."""
    with open_regular(path) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def is_unfinished(path: Path) -> bool:
    """Return whether `path` is a recording of ours that was cut off, and no process writes it."""
    with open_regular(path) as file:
        head = file.read(HEAD_BYTES)
        if not head.startswith(MAGIC) or not head.endswith(OWN_PROFILE):
            return False
        file.seek(-len(MAGIC), os.SEEK_END)
        ended = file.read() == MAGIC
    return not ended and not is_being_written(path)


def recover_all(folder: Path, *, keep_free_mb: float) -> None:
    """Recover every unfinished recording of ours in `folder` in place; log failures.

    A file stays as it is if its copy would leave less than `keep_free_mb` free, or if it changes
    meanwhile, as a file that is being copied does.
    """
    for path in sorted(folder.glob("*.mcap")):
        try:
            if not is_unfinished(path):
                continue
            with path.open("r+b") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # other recorders then skip it
                _recover_in_place(path, os.fstat(file.fileno()), keep_free_mb)
        except BlockingIOError:  # another recorder was faster
            continue
        except (ConfigError, OSError) as error:
            log.warning("%s could not be recovered: %s", path, error)


def _recover_in_place(path: Path, before: os.stat_result, keep_free_mb: float) -> None:
    if shutil.disk_usage(path.parent).free - before.st_size < keep_free_mb * 1e6:
        log.warning(
            "%s was cut off, and is not recovered: a copy of %.1f MB would leave less than %g MB "
            "of the disk free; make space, or: gigabrain bag recover %s -o FILE",
            path, before.st_size / 1e6, keep_free_mb, path,
        )  # fmt: skip
        return
    part = path.with_suffix(".recovering")
    part.unlink(missing_ok=True)  # left by an interrupted attempt
    done, now = recover(path, part), path.stat()
    if (now.st_ino, now.st_size) != (before.st_ino, before.st_size):
        part.unlink()
        log.warning("%s changed while it was recovered, and stays as it is", path)
        return
    part.replace(path)
    log.info("%s was cut off; recovered %d messages", path, done.messages)
