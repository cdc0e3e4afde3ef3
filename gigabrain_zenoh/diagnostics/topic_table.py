"""`gigabrain topic list` and `info`: what there is, who sends it and who listens."""

from collections.abc import Iterator
from types import UnionType

import msgspec
from msgspec import Struct
from rich.table import Table

from gigabrain_schemas.topics import TOPICS
from gigabrain_zenoh.diagnostics.hearing import Look
from gigabrain_zenoh.diagnostics.keyexpr import matches
from gigabrain_zenoh.diagnostics.names import Target, short, table_name, topic_of
from gigabrain_zenoh.diagnostics.roll_call import receivers, senders


class Row(Struct, frozen=True, kw_only=True):
    """One key."""

    key: str
    type: str | None  # of the table; None for keys that are not ours
    hz: float
    promised_hz: float | None
    size: int | None  # [bytes], median
    age_s: float | None  # of the newest message; None when none came
    senders: tuple[str, ...]
    receivers: tuple[str, ...]


def rows(found: Look, now_ns: int, *, all_topics: bool = False) -> list[Row]:
    """Every key that somebody sends on or listens to, and with `all_topics` the rest of ours."""
    there = tuple(found.there.values())
    figures, streams = found.tally.figures(found.began_ns), found.tally.streams()
    keys = set(found.alive) | {k for one in there for k in one.subscribes if "*" not in k}
    if all_topics:
        keys |= {topic.key for topic in TOPICS if not topic.many}
    made = []
    for key in sorted(keys):
        topic, one = topic_of(key), figures.get(key)
        if topic is None and key not in streams:
            continue  # a question, not a topic
        made.append(
            Row(
                key=key,
                type=table_name(key),
                hz=round(one.hz, 2) if one else 0.0,
                promised_hz=topic.hz if topic else None,
                size=one.size if one else None,
                age_s=streams[key].age_s(now_ns) if key in streams else None,
                senders=tuple(senders(key, there)),
                receivers=tuple(receivers(key, there)),
            )
        )
    return made


def table(found: list[Row]) -> Table:
    """For people."""
    made = Table(box=None, pad_edge=False, header_style="dim")
    for name, right in (
        ("topic", False), ("message", False), ("Hz", True), ("promised", True), ("bytes", True),
        ("age", True), ("from", False), ("to", False),
    ):  # fmt: skip
        made.add_column(
            name, justify="right" if right else "left", no_wrap=name not in ("from", "to")
        )
    for row in found:
        made.add_row(
            short(row.key),
            row.type or "?",
            f"{row.hz:.1f}" if row.hz else "-",
            f"{row.promised_hz:g}" if row.promised_hz else "",
            str(row.size) if row.size is not None else "-",
            f"{row.age_s:.2f} s" if row.age_s is not None else "-",
            ", ".join(row.senders) or "-",
            ", ".join(row.receivers) or "-",
        )
    return made


def about(aim: Target, found: Look, now_ns: int) -> Iterator[str]:
    """All that is known of one topic, in lines."""
    topic = aim.topic
    yield aim.pattern
    if topic:
        kept = ", the last value is kept for late joiners" if topic.keep else ""
        yield f"  {topic.type.__name__}: {' '.join((topic.type.__doc__ or '').split())}"
        yield f"  promised {topic.hz:g} Hz, stale after {topic.stale_after_ns / 1e9:g} s{kept}"
        yield (
            f"  priority {topic.priority}, {topic.congestion} when congested, "
            f"at most {topic.max_bytes} bytes"
        )
    else:
        yield "  not one of this project's topics; shown raw"
    for row in rows(found, now_ns, all_topics=True):
        if matches(aim.pattern, row.key):
            yield from _measured(row)
    if topic:
        yield "  fields:"
        for one in msgspec.structs.fields(topic.type):
            optional = "" if one.required else "  (may be left out)"
            yield f"    {one.name}: {_type_name(one.type)}{optional}"


def _measured(row: Row) -> Iterator[str]:
    heard = "nothing came" if row.age_s is None else f"{row.hz:g} Hz, {row.size} bytes, "
    age = "" if row.age_s is None else f"{row.age_s:.2f} s ago"
    yield f"  {row.key}: {heard}{age}"
    yield f"    from {', '.join(row.senders) or 'nobody'} to {', '.join(row.receivers) or 'nobody'}"


def _type_name(kind: object) -> str:
    """As short as people need it; bounds and modules left out."""
    text = getattr(kind, "__name__", None)
    if isinstance(kind, type) and text and not hasattr(kind, "__args__"):
        return str(text)
    origin, inner = getattr(kind, "__origin__", None), getattr(kind, "__args__", ())
    if getattr(kind, "__metadata__", None):
        return _type_name(origin)
    if not inner:
        return repr(kind)
    names = ["None" if a is type(None) else _type_name(a) for a in inner if a is not Ellipsis]
    if isinstance(kind, UnionType) or str(origin) == "typing.Union":
        return " | ".join(names)
    if str(origin) == "typing.Literal":
        return " | ".join(map(repr, inner))
    return f"{getattr(origin, '__name__', origin)}[{', '.join(names)}]"
