"""One MCAP file while it is being written: what came, byte for byte, and what viewers draw."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from foxglove import Schema
from mcap.well_known import MessageEncoding

from gigabrain_schemas.topics import CMD_VEL, INTENT, STATE, TASK, TOPICS, Topic
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.recording.drawing import Drawer, Drawn, json_schema
from gigabrain_zenoh.recording.gaps import is_json
from gigabrain_zenoh.recording.intake import Arrival
from gigabrain_zenoh.recording.tape import Tape
from gigabrain_zenoh.recording.writer import Writer

CHUNK_BYTES = 1 << 20
PROFILE = "gigabrain"
RAW, VIEW = "raw", "view"  # what a channel is for, under the name "kind" in its metadata
BY_KEY = {topic.key: topic for topic in TOPICS}
DRAWN_NS = {  # at least between two of which viewers are drawn one
    STATE.key: 30_000_000,
    CMD_VEL.key: 30_000_000,
    TASK.key: 450_000_000,  # with the whole way to the goal
}


def topic_of(key: str) -> Topic[Any] | None:
    """The topic of a key that came over the bus, if it is one of ours."""
    if key in BY_KEY:
        return BY_KEY[key]
    topic = BY_KEY.get(key.rpartition("/")[0])
    return topic if topic and topic.many else None


class Way(NamedTuple):
    """What becomes of messages of one key and encoding."""

    channel: int
    drawn: Topic[Any] | None  # None where viewers see nothing of them


class BagFile:
    """Raises ConfigError when it cannot be created, OSError when the disk takes no more."""

    def __init__(self, path: Path, *, viewers: bool, notes: Mapping[str, str]) -> None:
        self._tape = Tape(path)
        self._writer = Writer(self._tape, CHUNK_BYTES, message_index=viewers)
        try:
            self._writer.start(PROFILE, "gigabrain-zenoh")
            self._writer.add_metadata("gigabrain", dict(notes))
            self._tape.sync()
        except OSError as error:
            self._tape.close()
            path.unlink(missing_ok=True)
            raise ConfigError(f"cannot write {path}: {error.strerror}") from None
        self._viewers, self._drawer = viewers, Drawer()
        self._decoders = {t.type: Codec(t.type, t.max_bytes).decode for t in TOPICS}
        self._schemas: dict[str, int] = {}
        self._ways: dict[tuple[str, str, bool], Way] = {}
        self._views: dict[tuple[str, str], int] = {}  # channels by topic and encoding
        self._drawn_ns: dict[str, int] = {}  # when a thinned key was drawn last
        self._thought = (0, -1)  # boot and basis of the intent that was drawn last
        self.pending: Counter[str] = Counter()  # per key, what is not on the disk yet
        self.written = 0  # messages that are
        self.first_ns = 0
        self._settled = self._tape.size

    @property
    def path(self) -> Path:
        """Where it is."""
        return self._tape.path

    @property
    def size(self) -> int:
        """What is on the disk [bytes]."""
        return self._tape.size

    def free_bytes(self) -> int:
        """Room on the disk."""
        return self._tape.free_bytes()

    def add(self, arrival: Arrival, *, again: bool = False) -> None:
        """Append one message, and what viewers draw of it; `again` where it is in another file."""
        log_ns, key, encoding, payload, header = arrival
        if not again:
            self.pending[key] += 1
        self.first_ns = self.first_ns or log_ns
        place = key, encoding, is_json(payload)
        way = self._ways.get(place) or self._new_way(place)
        stamp_ns = header.stamp_ns or log_ns
        self._writer.add_message(way.channel, log_ns, payload, stamp_ns, header.seq & 0xFFFF_FFFF)
        if way.drawn and self._worth_drawing(arrival):
            self._draw(way.drawn, arrival)
        if self._tape.size != self._settled:
            self._settle()

    def flush(self) -> None:
        """Bring all that was added to the disk."""
        self._writer.flush()
        if self._tape.size != self._settled:
            self._settle()
        self._tape.sync()

    def _settle(self) -> None:
        """The file has grown: all that was added has been written."""
        self._settled = self._tape.size
        self.written += self.pending.total()
        self.pending = Counter()

    def note(self, name: str, values: Mapping[str, str]) -> None:
        """Add a named set of words."""
        self._writer.add_metadata(name, dict(values))

    def finish(self) -> None:
        """Write the index, without which most programs refuse to open it."""
        self._writer.finish()
        self._tape.sync()

    def close(self) -> None:
        """Let go of the file, finished or not."""
        self._tape.close()

    def _new_way(self, place: tuple[str, str, bool]) -> Way:
        key, encoding, json = place
        topic = topic_of(key)
        form = MessageEncoding.JSON if json else "msgpack"
        notes = {"kind": RAW, "zenoh_encoding": encoding}
        schema = self._schema(json_schema(topic.type)) if topic else 0
        channel = self._writer.register_channel(key, form, schema, notes)
        drawn = topic if topic and self._viewers and self._drawer.draws(topic) else None
        self._ways[place] = Way(channel, drawn)
        return self._ways[place]

    def _schema(self, of: Schema) -> int:
        if of.name not in self._schemas:
            self._schemas[of.name] = self._writer.register_schema(of.name, of.encoding, of.data)
        return self._schemas[of.name]

    def _draw(self, topic: Topic[Any], arrival: Arrival) -> None:
        try:
            message = self._decoders[topic.type](arrival.payload)
        except ValueError:  # not a valid message: kept as it came, but there is nothing to see
            return
        stamp_ns = arrival.header.stamp_ns or arrival.log_ns
        for drawn in self._drawer.draw(topic, message, arrival.key.rpartition("/")[2]):
            channel = self._view_channel(drawn)
            self._writer.add_message(channel, arrival.log_ns, drawn.data, stamp_ns)

    def _worth_drawing(self, arrival: Arrival) -> bool:
        """Whether it shows more than the one before; told before it is decoded."""
        key, header = arrival.key, arrival.header
        if key == INTENT.key:  # said again with every tick
            before, self._thought = self._thought, (header.boot, header.basis)
            return before != self._thought
        if key in DRAWN_NS and arrival.log_ns - self._drawn_ns.get(key, 0) < DRAWN_NS[key]:
            return False
        self._drawn_ns[key] = arrival.log_ns
        return True

    def _view_channel(self, drawn: Drawn) -> int:
        place = drawn.topic, drawn.encoding
        if place not in self._views:
            schema = self._schema(drawn.schema())
            self._views[place] = self._writer.register_channel(*place, schema, {"kind": VIEW})
        return self._views[place]
