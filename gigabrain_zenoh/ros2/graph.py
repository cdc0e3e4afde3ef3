"""The ROS graph: waits until it is known, and finds what keeps its endpoints apart."""

import asyncio
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.ros2.qos import mismatch
from gigabrain_zenoh.ros2.transport import EndpointKind, GraphEndpoint

CLOCK_S = 1.0  # by which clocks may differ
SYNCHRONISE = "synchronise both machines by chrony or NTP"
POLL_S = 0.1
STILL_S = 1.0  # without a change, after which discovery is over
MIN_WAIT_S = 2.0  # for nodes of other hosts to answer
ALONE_S = 5.0  # while there is no other node, or one without a name: names come later
LIMIT_S = 10.0  # of a graph that does not come to rest
ENDS: tuple[tuple[EndpointKind, EndpointKind], ...] = (
    ("publisher", "subscriber"),
    ("server", "client"),
)
ACTION = "/_action/"  # between an action's name and its parts
# topics, below a namespace, that several nodes may publish
SHARED = ("tf", "tf_static", "joint_states", "diagnostics", "rosout", "parameter_events")
APART = (
    "give each robot its own `namespace:` or `domain:`; or name in `leave_out:` what the other "
    "node offers"
)
Owner = tuple[str, EndpointKind]  # a node, and its endpoints of a kind


class Trouble(NamedTuple):
    """The reason why two endpoints exchange nothing, or get in each other's way."""

    kind: str  # type, qos, hash, name or twice
    topic: str
    text: str
    do: str


async def discovered(
    endpoints: Callable[[], tuple[GraphEndpoint, ...]], limit_s: float = LIMIT_S
) -> tuple[GraphEndpoint, ...]:
    """Return the endpoints of others once nothing new comes, at the latest after `limit_s`."""
    clock = asyncio.get_running_loop().time
    began_s = changed_s = clock()
    found: frozenset[GraphEndpoint] = frozenset()
    while (now_s := clock()) - began_s < limit_s:
        newest = frozenset(one for one in endpoints() if not one.ours)
        if newest != found:
            found, changed_s = newest, now_s
        known = found and all(one.node for one in found)
        if now_s - changed_s >= STILL_S and now_s - began_s >= (MIN_WAIT_S if known else ALONE_S):
            break
        await asyncio.sleep(POLL_S)
    return tuple(sorted(found, key=lambda one: (one.topic, one.type, one.kind, one.node)))


def unreached(transport: str, domain: int, router: str = "") -> str:
    """Return what to check where no other node is found."""
    if transport == "rmw_zenoh":
        return (
            f"is the router {router} up, do the other nodes run with "
            f"RMW_IMPLEMENTATION=rmw_zenoh_cpp and ROS_DOMAIN_ID={domain}?"
        )
    return (
        f"check on the other nodes: ROS_DOMAIN_ID={domain}, same network with multicast, "
        "ROS_LOCALHOST_ONLY not set"
    )


def clock_text(offset_s: float) -> str:
    """Return by how much a clock of others is behind this machine's; negative is ahead."""
    way = "behind" if offset_s > 0 else "ahead of"
    return f"{abs(offset_s):.1f} s {way} this machine's clock"


def troubles(
    link: Ros2Link, endpoints: Iterable[GraphEndpoint], *, ours_only: bool = False
) -> list[Trouble]:
    """Return what keeps publishers from subscribers and servers from clients, each once.

    With `ours_only` one of both ends is of this transport.
    """
    by_topic: dict[str, list[GraphEndpoint]] = defaultdict(list)
    types: dict[str, dict[Owner, set[str]]] = defaultdict(lambda: defaultdict(set))
    for one in endpoints:
        by_topic[one.topic].append(one)
        types[one.topic][one.node, one.kind].add(one.type)
    found: dict[Trouble, None] = {}
    for topic, there in by_topic.items():
        if ours_only and not any(one.ours for one in there):
            continue  # such as those of each node, which have many pairs
        for giver, taker in _pairs(there):
            if not ours_only or giver.ours != taker.ours:
                found |= dict.fromkeys(_between(link, giver, taker, types[topic]))
    return list(found)


def _pairs(there: list[GraphEndpoint]) -> Iterator[tuple[GraphEndpoint, GraphEndpoint]]:
    for giving, taking in ENDS:
        for giver in (one for one in there if one.kind == giving):
            yield from ((giver, one) for one in there if one.kind == taking)


def _between(
    link: Ros2Link, giver: GraphEndpoint, taker: GraphEndpoint, types: dict[Owner, set[str]]
) -> Iterator[Trouble]:
    topic, one, other = giver.topic, _name(giver), _name(taker)
    if giver.type != taker.type:
        if types[giver.node, giver.kind].isdisjoint(types[taker.node, taker.kind]):
            text = f"{one} has the type {giver.type}, {other} {taker.type}"
            yield Trouble("type", topic, text, "use one type at both ends")
        return
    wrong = mismatch(giver.qos, taker.qos) if link.transport == "dds" else ""
    if wrong:
        text = f"nothing passes from {one} to {other}: {wrong}"
        do = f"have {one} publish" if taker.ours else f"have {other} subscribe"
        yield Trouble("qos", topic, text, f"{do} with {taker.qos if taker.ours else giver.qos}")
    yield from _definitions(link, giver, taker)


def _definitions(link: Ros2Link, giver: GraphEndpoint, taker: GraphEndpoint) -> Iterator[Trouble]:
    one, other = _name(giver), _name(taker)
    if giver.hash and taker.hash and giver.hash != taker.hash:
        text = f"{one} and {other} have different definitions of {giver.type}"
        do = "use the same version of its package, or give ours by `types:`"
        yield Trouble("hash", giver.topic, text, do)
    elif giver.hash != taker.hash and link.transport == "rmw_zenoh":
        humble = other if giver.hash else one
        text = (
            f"nothing passes between {one} and {other}: {humble} has no type hashes, as on Humble"
        )
        do = "set distro: humble" if link.distro != "humble" else "set distro: jazzy"
        yield Trouble("hash", giver.topic, text, f"{do}, or use the same distribution everywhere")


def _name(one: GraphEndpoint) -> str:
    return one.node or "a node without a name"


def doubles(endpoints: Iterable[GraphEndpoint]) -> list[Trouble]:
    """Return the nodes that offer what ours offers, such as a second robot's, each once."""
    endpoints = [one for one in endpoints if one.kind in ("publisher", "server")]
    ours = [one for one in endpoints if one.ours and one.topic.rpartition("/")[2] not in SHARED]
    names, nodes = {(one.kind, one.topic) for one in ours}, {one.node for one in ours}
    same: dict[str, set[str]] = defaultdict(set)
    for one in endpoints:
        if not one.ours and (one.kind, one.topic) in names:
            node = f"another {one.node}" if one.node in nodes else _name(one)
            same[node].add(one.topic.partition(ACTION)[0])
    found = []
    for node, topics in same.items():
        first, *more = sorted(topics)
        text = f"{node} offers it as well" + (f", and {len(more)} more" if more else "")
        found.append(Trouble("twice", first, text, APART))
    return sorted(found)


def nameless(link: Ros2Link, endpoints: Iterable[GraphEndpoint]) -> Trouble | None:
    """Return what the nodes without names may be: over DDS, Humble tells them in another form."""
    odd = {one.topic for one in endpoints if not (one.ours or one.node or one.hash)}
    if not odd or link.transport != "dds" or link.distro == "humble":
        return None
    text = f"nodes with neither name nor type hashes, as on {min(odd)}"
    return Trouble("name", min(odd), text, "if they run Humble, set distro: humble")
