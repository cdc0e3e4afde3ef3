"""A bag as people think of it: messages that came on keys, in order of their arrival."""

import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from mcap.records import Channel, Metadata, Schema

from gigabrain_zenoh.recording.gaps import Header, header_of
from gigabrain_zenoh.recording.records import Damage, Finished, Message, read

log = logging.getLogger(__name__)

RAW = "raw"


class Sample(NamedTuple):
    """One message as it was recorded."""

    log_ns: int  # Unix time of its arrival
    key: str
    encoding: str  # Zenoh's
    schema: str
    payload: bytes

    @property
    def header(self) -> Header:
        """What every message begins with."""
        return header_of(self.payload)


class Bag:
    """A recording on disk. Reading goes on past whatever is damaged."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damages: list[Damage] = []  # filled while it is read
        self.finished = False  # likewise
        self.index_ok = False
        self.notes: dict[str, Mapping[str, str]] = {}  # named sets of words

    def __iter__(self) -> Iterator[Sample]:
        """All that came over the bus. Raises ConfigError for a file that is no bag."""
        for channel, schema, message in self.messages():
            if channel.metadata.get("kind") == RAW:
                yield Sample(
                    message.log_ns,
                    channel.topic,
                    channel.metadata.get("zenoh_encoding", ""),
                    schema.name if schema else "",
                    message.data,
                )

    def messages(self) -> Iterator[tuple[Channel, Schema | None, Message]]:
        """All messages, with those for viewers. Raises ConfigError for a file that is no bag."""
        self.damages, self.finished, self.index_ok = [], False, False
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        for item in read(self.path):
            if isinstance(item, Message):
                if channel := channels.get(item.channel):
                    yield channel, schemas.get(channel.schema_id), item
            elif isinstance(item, Channel):
                channels[item.id] = item
            elif isinstance(item, Schema):
                schemas[item.id] = item
            elif isinstance(item, Metadata):
                self.notes[item.name] = item.metadata
            elif isinstance(item, Damage):
                self.damages.append(item)
            elif isinstance(item, Finished):
                self.finished, self.index_ok = True, item.index_ok


def samples(path: Path) -> Iterator[Sample]:
    """All that came over the bus, and a word about what is missing of it.

    Raises ConfigError for a file that is no bag.
    """
    bag = Bag(path)
    yield from bag
    wrong = bag.damages[0].what if bag.damages else "" if bag.finished else "it was cut off"
    if wrong:
        log.warning("%s: %s; mend it with: gigabrain bag recover %s", path, wrong, path)
