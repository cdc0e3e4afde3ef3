"""`gigabrain topic`: lists topics, and prints and measures their messages."""

import asyncio
import inspect
import re
import sys
from collections.abc import Callable, Coroutine, Iterator
from typing import Any, Literal, get_type_hints

import msgspec
from msgspec import Struct
from rich.table import Table

from gigabrain_schemas.topics import TOPICS, Topic
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.key_expressions import matches
from gigabrain_zenoh.bus.listening import topic_of
from gigabrain_zenoh.diagnostics.discovery import (
    TEXT_COLUMNS,
    TopicPattern,
    discover,
    plain_table,
    receivers,
    senders,
    short_name,
)
from gigabrain_zenoh.diagnostics.listener import RawMessage, Snapshot, messages, stop_on_broken_pipe
from gigabrain_zenoh.diagnostics.message_text import as_json, in_a_line, lines, pick, read
from gigabrain_zenoh.diagnostics.topic_stats import StreamStats, monitored
from gigabrain_zenoh.errors import BodyLost
from gigabrain_zenoh.host.escaping import printable
from gigabrain_zenoh.host.signals import stop_signals

SILENCE_NOTICE_S = 2.0  # without a message, before the user gets a notice
REPORT_PERIOD_S = 1.0
Quantity = Literal["hz", "bw", "delay"]


class TopicRow(Struct, frozen=True, kw_only=True):
    """One key of `topic list`."""

    key: str
    type: str | None  # name of its type; None for keys of other projects
    hz: float
    promised_hz: float | None
    size: int | None  # [bytes], median
    age_s: float | None  # of the newest message; None without one
    senders: tuple[str, ...]
    receivers: tuple[str, ...]


def rows(found: Snapshot, now_ns: int, *, all_topics: bool = False) -> list[TopicRow]:
    """Return every key with a sender or a receiver, and with `all_topics` the rest of the table."""
    processes = tuple(found.processes.values())
    stats, streams = found.monitor.stats(found.start_ns), found.monitor.streams()
    keys = found.live_keys | {k for each in processes for k in each.subscribes if "*" not in k}
    if all_topics:
        keys |= {topic.key for topic in TOPICS if not topic.many}
    result = []
    for key in sorted(keys):
        topic, stream = topic_of(key), stats.get(key)
        if topic is None and key not in streams:
            continue  # a service, not a topic
        result.append(
            TopicRow(
                key=key,
                type=topic.type.__name__ if topic else None,
                hz=round(stream.hz, 2) if stream else 0.0,
                promised_hz=topic.hz if topic else None,
                size=stream.size if stream else None,
                age_s=streams[key].age_s(now_ns) if key in streams else None,
                senders=tuple(senders(key, processes)),
                receivers=tuple(receivers(key, processes)),
            )
        )
    return result


def topic_table(found: list[TopicRow]) -> Table:
    """Return a table with one row per key."""
    columns = ("topic", "message", "Hz", "promised", "bytes", "age", "from", "to")
    cells = (
        (
            short_name(row.key),
            row.type or "?",
            f"{row.hz:.1f}" if row.hz else "-",
            f"{row.promised_hz:g}" if row.promised_hz else "",
            str(row.size) if row.size is not None else "-",
            f"{row.age_s:.2f} s" if row.age_s is not None else "-",
            ", ".join(row.senders) or "-",
            ", ".join(row.receivers) or "-",
        )
        for row in found
    )
    return plain_table(columns, cells, left=TEXT_COLUMNS, wraps=("from", "to"))


def describe(wanted: TopicPattern, found: Snapshot, now_ns: int) -> Iterator[str]:
    """Yield lines that describe one topic."""
    topic = wanted.topic
    yield wanted.pattern
    if topic:
        kept = ", last value kept for late subscribers" if topic.keep else ""
        yield f"  {topic.type.__name__}: {' '.join((topic.type.__doc__ or '').split())}"
        yield f"  promised {topic.hz:g} Hz, stale after {topic.stale_after_ns / 1e9:g} s{kept}"
        yield (
            f"  priority {topic.priority}, {topic.congestion} when congested, "
            f"at most {topic.max_bytes} bytes"
        )
    else:
        yield "  not a topic of this project; shown raw"
    for row in rows(found, now_ns, all_topics=True):
        if matches(wanted.pattern, row.key):
            yield from _measured(row)
    if topic:
        yield "  fields:"
        types = get_type_hints(topic.type)  # without bounds
        for field in msgspec.structs.fields(topic.type):
            optional = "" if field.required else "  (optional)"
            yield f"    {field.name}: {_type_name(types[field.name])}{optional}"


def _measured(row: TopicRow) -> Iterator[str]:
    rate = "no messages"
    if row.age_s is not None:
        rate = f"{row.hz:g} Hz, {row.size} bytes, {row.age_s:.2f} s ago"
    yield f"  {row.key}: {rate}"
    yield f"    from {', '.join(row.senders) or '-'} to {', '.join(row.receivers) or '-'}"


def _type_name(kind: Any) -> str:
    """Return the name of a type, without modules."""
    return re.sub(r"[\w.]+\.(?=\w)", "", inspect.formatannotation(kind))


class EchoOptions(Struct, frozen=True, kw_only=True):
    """Format and limits of the output of `topic echo`."""

    json: bool = False
    fields: tuple[str, ...] = ()
    count: int | None = None  # number of messages to print
    within_s: float | None = None  # time limit for the first message; then exit code 1


def message_lines(message: RawMessage, options: EchoOptions) -> Iterator[str]:
    """Yield the lines of one message. Raises UnknownName for an unknown field."""
    value = read(message.key, message.payload, whole=options.json)
    if options.fields and "invalid" not in value:
        value = pick(value, options.fields)
    if options.json:
        yield as_json({"key": message.key, **value})
    elif options.fields:
        yield "  ".join(f"{name}={in_a_line(inner)}" for name, inner in value.items())
    else:
        yield f"--- {message.key}"
        yield from lines(value)


async def echo(
    bus: Bus, wanted: TopicPattern, options: EchoOptions, out: Callable[[str], None]
) -> int:
    """Print messages as they arrive. Raises BodyLost if the first one is too late."""
    left = options.count
    first = asyncio.Event()

    async def show() -> None:
        nonlocal left
        async for message in messages(bus, wanted):
            first.set()
            if isinstance(message, int):
                print(f"{message} messages dropped: too fast to show", file=sys.stderr, flush=True)
                continue
            for line in message_lines(message, options):
                out(line)
            left = None if left is None else left - 1
            if left == 0:
                return

    return await _until_stopped(show(), _report_silence(bus, wanted, first, options.within_s))


async def measure(
    bus: Bus, wanted: TopicPattern, what: Quantity, count: int | None, out: Callable[[str], None]
) -> int:
    """Print one line per key and second, for `count` seconds with messages."""
    first = asyncio.Event()

    async def report() -> None:
        left = count
        with monitored(bus, wanted.pattern) as monitor:
            while left is None or left > 0:
                since_ns = bus.clock.now_ns()
                await asyncio.sleep(REPORT_PERIOD_S)
                found = monitor.stats(since_ns)
                for key, stats in found.items():
                    first.set()
                    missing = monitor.missing(key)
                    lost = f"  {missing} missing" if missing else ""
                    out(f"{key}  {stats_text(what, stats, wanted.topic)}{lost}")
                if not found and first.is_set():
                    out(f"{wanted.pattern}  no messages")
                left = left if left is None or not found else left - 1

    return await _until_stopped(report(), _report_silence(bus, wanted, first, None))


def stats_text(what: Quantity, stats: StreamStats, topic: Topic[Any] | None) -> str:
    """Return one quantity of a stream, in a line."""
    if what == "bw":
        return f"{stats.bytes_s / 1e3:.1f} kB/s  {stats.size} bytes  {stats.count} messages"
    if what == "delay":
        if stats.delay_median_ms is None:
            return "no time stamps"
        return (
            f"delay median {stats.delay_median_ms:.2f} ms  min {stats.delay_min_ms:.2f}  "
            f"max {stats.delay_max_ms:.2f}"
        )
    promised = f"  promised {topic.hz:g}" if topic else ""
    if stats.gap_max_ms is None:
        return f"{stats.hz:.2f} Hz{promised}"
    return (
        f"{stats.hz:.2f} Hz{promised}  gap min {stats.gap_min_ms:.1f} ms  "
        f"max {stats.gap_max_ms:.1f}  std {stats.gap_std_ms:.1f}"
    )


async def _report_silence(
    bus: Bus, wanted: TopicPattern, first: asyncio.Event, within_s: float | None
) -> None:
    """Print a notice if no message arrives. Raises BodyLost instead if there is a limit."""
    try:
        await asyncio.wait_for(first.wait(), within_s or SILENCE_NOTICE_S)
    except TimeoutError:
        processes = (await discover(bus)).values()
        by = ", ".join(senders(wanted.pattern, processes)) or "none"
        to = ", ".join(receivers(wanted.pattern, processes)) or "none"
        text = f"no messages on {wanted.pattern} (senders: {by}; receivers: {to})"
        if within_s:
            raise BodyLost(text) from None
        print(f"{printable(text)}; waiting", file=sys.stderr, flush=True)
        await first.wait()


async def _until_stopped(work: Coroutine[Any, Any, None], watch: Coroutine[Any, Any, None]) -> int:
    """Run both until `work` is done, one raises, a signal arrives or stdout is closed."""
    tasks = [asyncio.ensure_future(work), asyncio.ensure_future(watch)]
    with stop_signals() as stop, stop_on_broken_pipe(stop):
        stopped = asyncio.ensure_future(stop.wait())
        pending = {*tasks, stopped}
        while tasks[0] in pending and stopped in pending:
            done, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
            if any(not task.cancelled() and task.exception() for task in done):
                break
    for task in (*tasks, stopped):
        task.cancel()
    for result in await asyncio.gather(*tasks, return_exceptions=True):
        if isinstance(result, BaseException) and not isinstance(result, asyncio.CancelledError):
            raise result
    return 0
