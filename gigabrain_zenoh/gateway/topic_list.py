"""`gigabrain ros2 topics`: the ROS graph, with our keys for the gateway's topics. Pure."""

from collections import defaultdict
from collections.abc import Collection, Iterable
from typing import Literal

from msgspec import Struct
from rich.table import Table
from rich.text import Text

from gigabrain_schemas.topics import DEPTH, HEALTH, IMAGE, SAFETY
from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.diagnostics.discovery import plain, plain_table
from gigabrain_zenoh.gateway.publishing import COMMANDED, table
from gigabrain_zenoh.ros2.graph import ACTION, troubles
from gigabrain_zenoh.ros2.transport import EndpointKind, GraphEndpoint

EVERY_NODE = ("rcl_interfaces/", "type_description_interfaces/")  # types that all nodes use
GOES_OUT: tuple[EndpointKind, ...] = ("publisher", "server")
COLUMNS = ("name", "type", "QoS", "from", "to", "robot")
Kind = Literal["topic", "service", "action"]


class TopicRow(Struct, frozen=True, kw_only=True):
    """A topic, service or action of one type."""

    name: str  # fully qualified
    kind: Kind
    type: str
    offered: tuple[str, ...]  # QoS of its publishers or servers
    requested: tuple[str, ...]  # QoS of its subscribers or clients
    senders: tuple[str, ...]  # nodes that publish or serve
    receivers: tuple[str, ...]  # nodes that subscribe or call
    robot_keys: tuple[str, ...]  # keys that the gateway connects to it
    troubles: tuple[str, ...]  # reasons for lost messages, with remedies


def robot_keys(name: str) -> tuple[str, ...]:
    """Return our keys behind a name of the gateway, given below its namespace."""
    if name in COMMANDED:
        return (COMMANDED[name],)
    if name == "diagnostics":
        return (f"{HEALTH.key}/*", SAFETY.key)
    if name.startswith("camera/"):
        return (f"{(DEPTH if 'depth' in name.split('/') else IMAGE).key}/*",)
    return tuple(source.key for row in table() if row.topic == name for source, _ in row.sources)


def rows(
    endpoints: Iterable[GraphEndpoint], link: Ros2Link, *, all_topics: bool = False
) -> list[TopicRow]:
    """Return a row for each name and type; `link` names the gateway's node.

    Without `all_topics`, topics and services of every node, and parts of actions, are omitted.
    """
    endpoints = tuple(endpoints)
    wrong: dict[str, list[str]] = defaultdict(list)
    for one in troubles(link, endpoints):
        wrong[one.topic].append(f"{one.text}; {one.remedy}")
    groups: dict[tuple[str, Kind, str], list[GraphEndpoint]] = defaultdict(list)
    for each in endpoints:
        shown = all_topics or not each.type.startswith(EVERY_NODE)
        if shown and (group := _group(each, all_topics)):
            groups[group].append(each)
    return [
        _row(group, there, link, wrong[there[0].topic]) for group, there in sorted(groups.items())
    ]


def gateway_node(link: Ros2Link) -> str:
    """Return the fully qualified name of the gateway's node."""
    return f"{link.namespace.rstrip('/')}/{link.node}"


def topic_table(listed: Iterable[TopicRow]) -> Table:
    """Return a table with one line per row."""
    cells = (
        (
            row.name,
            row.type,
            _lines(row.offered or row.requested),
            _lines(row.senders),
            _lines(row.receivers),
            _lines(row.robot_keys),
        )
        for row in listed
    )
    return plain_table(COLUMNS, cells, left=COLUMNS, wraps=COLUMNS[2:])


def _lines(texts: Collection[str]) -> Text:
    return Text("\n").join(map(plain, texts)) or Text("-")


def _group(one: GraphEndpoint, all_topics: bool) -> tuple[str, Kind, str] | None:
    """Return the row of an endpoint; None for a hidden part of an action."""
    kind: Kind = "topic" if one.kind in ("publisher", "subscriber") else "service"
    name, is_action, part = one.topic.partition(ACTION)
    if not is_action or all_topics:
        return one.topic, kind, one.type
    if part != "send_goal":
        return None
    return name, "action", one.type.removesuffix("_SendGoal")


def _row(
    group: tuple[str, Kind, str], there: list[GraphEndpoint], link: Ros2Link, wrong: list[str]
) -> TopicRow:
    name, kind, type = group
    ends = {out: [one for one in there if (one.kind in GOES_OUT) is out] for out in (True, False)}
    space = f"{link.namespace.rstrip('/')}/"
    mine = name.startswith(space) and any(one.node == gateway_node(link) for one in there)
    return TopicRow(
        name=name,
        kind=kind,
        type=type,
        offered=_distinct(str(one.qos) for one in ends[True]),
        requested=_distinct(str(one.qos) for one in ends[False]),
        senders=_distinct(one.node or "?" for one in ends[True]),
        receivers=_distinct(one.node or "?" for one in ends[False]),
        robot_keys=robot_keys(name.removeprefix(space)) if mine else (),
        troubles=tuple(wrong),
    )


def _distinct(texts: Iterable[str]) -> tuple[str, ...]:
    return tuple(sorted(set(texts)))
