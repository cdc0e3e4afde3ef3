"""Messages as rows of named values: CSV tables, and plots over time."""

import csv
import io
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, TextIO

import msgspec

from gigabrain_schemas.base import Message
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import TOPICS
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.errors import ConfigError, unknown
from gigabrain_zenoh.host.files import cannot_write, check_picture_path, replacing
from gigabrain_zenoh.recording.bag_reader import Bag, Sample, samples

Value = float | int | str | bool | None
NUMBER = int | float  # types that can be plotted
Series = tuple[list[float], list[float]]  # times since the first message [s], values
DECODERS = {f"gigabrain.{t.type.__name__}": Codec(t.type, t.max_bytes).decode for t in TOPICS}


def message_of(sample: Sample) -> Message | None:
    """Decode a recorded message by its schema; None if it is not a valid message of ours."""
    decode = DECODERS.get(sample.schema)
    try:
        return decode(sample.payload) if decode else None
    except ValueError:
        return None


def row(message: Message) -> dict[str, Value]:
    """Return all values by dotted name; for bytes only their length, except for a scan's ranges."""
    values = dict(_flat("", msgspec.to_builtins(message, builtin_types=(bytes,))))
    if isinstance(message, LaserScan):
        del values["ranges"]
        values |= {f"ranges.{i}": float(r) for i, r in enumerate(message.ranges_m)}
    return values


def _flat(name: str, value: Any) -> Iterator[tuple[str, Value]]:
    if isinstance(value, bytes):
        yield name, len(value)
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _flat(f"{name}.{key}" if name else str(key), inner)
    elif isinstance(value, list | tuple):
        for i, inner in enumerate(value):
            yield from _flat(f"{name}.{i}", inner)
    else:
        yield name, value


def write_csv(path: Path, folder: Path) -> list[Path]:
    """Write one file per key with a row per message; return the files. Raises ConfigError.

    The files appear when all are complete. Messages that a recorder appends meanwhile are left out.
    """
    columns: dict[str, dict[str, None]] = {}  # in order of first appearance
    count = 0
    for sample in samples(path):
        count += 1
        if message := message_of(sample):
            columns.setdefault(sample.key, {}).update(dict.fromkeys(row(message)))
    if not columns:
        raise ConfigError(f"{path} holds no message to convert")
    paths = _paths(folder, sorted(columns))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with ExitStack() as files:
            writers = {
                key: csv.DictWriter(
                    files.enter_context(_replacing_text(each)), ("time_s", *columns[key])
                )
                for key, each in paths.items()
            }
            _write_rows(islice(Bag(path), count), writers)
    except OSError as error:
        raise cannot_write(folder, error) from None
    return list(paths.values())


def _paths(folder: Path, keys: Iterable[str]) -> dict[str, Path]:
    """Return a path per key; `a/b` and `a_b` get different ones."""
    paths: dict[str, Path] = {}
    for key in keys:
        name = key.replace("/", "_")
        names = (f"{name}_{n}.csv" if n else f"{name}.csv" for n in itertools.count())
        paths[key] = next(folder / each for each in names if folder / each not in paths.values())
    return paths


@contextmanager
def _replacing_text(path: Path) -> Iterator[TextIO]:
    """Yield a file for text that replaces `path` when the block ends. Raises OSError."""
    with replacing(path) as file:
        text = io.TextIOWrapper(file, encoding="utf-8", newline="")
        try:
            yield text
        finally:
            text.detach()  # writes the rest; `file` is closed by its own block


def _write_rows(recorded: Iterable[Sample], writers: Mapping[str, "csv.DictWriter[str]"]) -> None:
    for writer in writers.values():
        writer.writeheader()
    first_ns = 0
    for sample in recorded:
        first_ns = first_ns or sample.log_ns
        if message := message_of(sample):
            time_s = round((sample.log_ns - first_ns) / 1e9, 6)
            writers[sample.key].writerow({"time_s": time_s, **row(message)})


def read_series(path: Path, fields: Sequence[str]) -> dict[str, Series]:
    """Return each field's values over time. Raises UnknownName for a field not in the bag."""
    found: dict[str, Series] = {field: ([], []) for field in fields}
    wanted = {field: _split(field) for field in fields}
    topics, numbers = set[str](), set[str]()
    first_ns = 0
    for sample in samples(path):
        first_ns = first_ns or sample.log_ns
        topic = sample.key.removeprefix("robot/")
        selected = [field for field, (name, _) in wanted.items() if name == topic]
        if not selected and topic in topics:
            continue
        message = message_of(sample)
        if message is None:
            continue
        values = row(message)
        if topic not in topics:
            topics.add(topic)
            numbers |= {f"{topic}.{name}" for name in values if isinstance(values[name], NUMBER)}
        for field in selected:
            value = values.get(wanted[field][1])
            if isinstance(value, NUMBER):
                found[field][0].append((sample.log_ns - first_ns) / 1e9)
                found[field][1].append(float(value))
    for field, (times, _) in found.items():
        if not times:
            topic = wanted[field][0]
            if topic not in topics:
                raise unknown("topic", field, topics)
            of_topic = {name for name in numbers if name.startswith(f"{topic}.")}
            raise unknown("number", field, of_topic)
    return found


def _split(field: str) -> tuple[str, str]:
    topic, _, name = field.removeprefix("robot/").partition(".")
    return topic, name


def plot(path: Path, fields: Sequence[str], to: Path) -> Path:
    """Draw `fields` over time into the PNG file `to`. Raises ConfigError."""
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        raise ConfigError("plots need matplotlib: pip install 'gigabrain-zenoh[record]'") from None
    if not fields:
        raise ConfigError("no field to plot; name one, such as cmd_vel.linear_x")
    if to.exists() and path.exists() and to.samefile(path):
        raise ConfigError(f"{to} is the recording; name another file")
    check_picture_path(to)
    drawn = read_series(path, fields)
    figure = Figure(figsize=(10, 5), layout="constrained")
    axes = figure.subplots()
    for field, (times, values) in drawn.items():
        axes.step(times, values, where="post", label=field, linewidth=1.2)
    axes.set_xlabel("time [s]")
    axes.set_title(path.name)
    axes.grid(alpha=0.3)
    axes.legend()
    try:
        figure.savefig(to, format="png", dpi=110)
    except OSError as error:
        raise cannot_write(to, error) from None
    return to
