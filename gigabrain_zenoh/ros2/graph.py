"""The ROS graph: waits for its discovery, and finds endpoints that cannot communicate."""

import asyncio
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.ros2.qos import mismatch
from gigabrain_zenoh.ros2.transport import EndpointKind, GraphEndpoint

CLOCK_S = 1.0  # tolerated difference between two machines' clocks
SYNCHRONISE = "synchronise both machines by chrony or NTP"
POLL_S = 0.1
UNCHANGED_S = 1.0  # discovery is complete after this time without a change,
MIN_WAIT_S = 2.0  # but not before this time, as nodes of other hosts need time to answer
INCOMPLETE_WAIT_S = 5.0  # minimum while there is no other node, or one whose name is unknown
TIMEOUT_S = 10.0  # for a graph that keeps changing
MATCHING_KINDS: tuple[tuple[EndpointKind, EndpointKind], ...] = (
    ("publisher", "subscriber"),
    ("server", "client"),
)
ACTION = "/_action/"  # separates an action's name from the names of its topics and services
# last parts of topic names that several nodes may publish
SHARED = ("tf", "tf_static", "joint_states", "diagnostics", "rosout", "parameter_events")
APART = (
    "give each robot its own `namespace:` or `domain:`; or name in `leave_out:` what the other "
    "node offers"
)
Owner = tuple[str, EndpointKind]  # name of a node, and the kind of its endpoints


class Trouble(NamedTuple):
    """A problem of two endpoints: they cannot communicate, or they conflict."""

    kind: str  # type, qos, hash, name or twice
    topic: str
    text: str
    remedy: str


async def discovered(
    endpoints: Callable[[], tuple[GraphEndpoint, ...]], limit_s: float = TIMEOUT_S
) -> tuple[GraphEndpoint, ...]:
    """Return the endpoints of other nodes once they stop changing, at most after `limit_s`."""
    clock = asyncio.get_running_loop().time
    began_s = changed_s = clock()
    found: frozenset[GraphEndpoint] = frozenset()
    while (now_s := clock()) - began_s < limit_s:
        newest = frozenset(each for each in endpoints() if not each.ours)
        if newest != found:
            found, changed_s = newest, now_s
        complete = found and all(each.node for each in found)
        min_wait_s = MIN_WAIT_S if complete else INCOMPLETE_WAIT_S
        if now_s - changed_s >= UNCHANGED_S and now_s - began_s >= min_wait_s:
            break
        await asyncio.sleep(POLL_S)
    return tuple(sorted(found, key=lambda each: (each.topic, each.type, each.kind, each.node)))


def unreached(transport: str, domain: int, router: str = "") -> str:
    """Return the advice for the case that no other node is found."""
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
    """Return the text for a clock that is `offset_s` behind this machine's; negative: ahead."""
    side = "behind" if offset_s > 0 else "ahead of"
    return f"{abs(offset_s):.1f} s {side} this machine's clock"


def troubles(
    link: Ros2Link, endpoints: Iterable[GraphEndpoint], *, ours_only: bool = False
) -> list[Trouble]:
    """Return the problems between publishers and subscribers, and servers and clients, each once.

    With `ours_only`, exactly one of the two endpoints belongs to this transport.
    """
    by_topic: dict[str, list[GraphEndpoint]] = defaultdict(list)
    types: dict[str, dict[Owner, set[str]]] = defaultdict(lambda: defaultdict(set))
    for each in endpoints:
        by_topic[each.topic].append(each)
        types[each.topic][each.node, each.kind].add(each.type)
    found: dict[Trouble, None] = {}
    for topic, on_topic in by_topic.items():
        if ours_only and not any(each.ours for each in on_topic):
            continue  # saves time: topics that each node has, such as /rosout, have many pairs
        for provider, user in _pairs(on_topic):
            if not ours_only or provider.ours != user.ours:
                found |= dict.fromkeys(_between(link, provider, user, types[topic]))
    return list(found)


def _pairs(endpoints: list[GraphEndpoint]) -> Iterator[tuple[GraphEndpoint, GraphEndpoint]]:
    """Yield (publisher, subscriber) and (server, client) of one topic or service."""
    for provider_kind, user_kind in MATCHING_KINDS:
        for provider in (each for each in endpoints if each.kind == provider_kind):
            yield from ((provider, each) for each in endpoints if each.kind == user_kind)


def _between(
    link: Ros2Link, provider: GraphEndpoint, user: GraphEndpoint, types: dict[Owner, set[str]]
) -> Iterator[Trouble]:
    topic, provider_name, user_name = provider.topic, _name(provider), _name(user)
    if provider.type != user.type:
        if types[provider.node, provider.kind].isdisjoint(types[user.node, user.kind]):
            text = f"{provider_name} has the type {provider.type}, {user_name} {user.type}"
            yield Trouble("type", topic, text, "use one type at both ends")
        return
    wrong = mismatch(provider.qos, user.qos) if link.transport == "dds" else ""
    if wrong:
        text = f"nothing passes from {provider_name} to {user_name}: {wrong}"
        do = f"have {provider_name} publish" if user.ours else f"have {user_name} subscribe"
        yield Trouble("qos", topic, text, f"{do} with {user.qos if user.ours else provider.qos}")
    yield from _definitions(link, provider, user)


def _definitions(link: Ros2Link, provider: GraphEndpoint, user: GraphEndpoint) -> Iterator[Trouble]:
    provider_name, user_name = _name(provider), _name(user)
    if provider.hash and user.hash and provider.hash != user.hash:
        text = f"{provider_name} and {user_name} have different definitions of {provider.type}"
        do = "use the same version of its package, or give ours by `types:`"
        yield Trouble("hash", provider.topic, text, do)
    elif provider.hash != user.hash and link.transport == "rmw_zenoh":
        humble = user_name if provider.hash else provider_name
        text = (
            f"nothing passes between {provider_name} and {user_name}: "
            f"{humble} has no type hashes, as on Humble"
        )
        do = "set distro: humble" if link.distro != "humble" else "set distro: jazzy"
        yield Trouble(
            "hash", provider.topic, text, f"{do}, or use the same distribution everywhere"
        )


def _name(endpoint: GraphEndpoint) -> str:
    return endpoint.node or "a node without a name"


def doubles(endpoints: Iterable[GraphEndpoint]) -> list[Trouble]:
    """Return the other nodes that offer one of our topics or services, such as a second robot's."""
    endpoints = [each for each in endpoints if each.kind in ("publisher", "server")]
    ours = [each for each in endpoints if each.ours and each.topic.rpartition("/")[2] not in SHARED]
    names, nodes = {(each.kind, each.topic) for each in ours}, {each.node for each in ours}
    doubled: dict[str, set[str]] = defaultdict(set)
    for each in endpoints:
        if not each.ours and (each.kind, each.topic) in names:
            node = f"another {each.node}" if each.node in nodes else _name(each)
            doubled[node].add(each.topic.partition(ACTION)[0])
    found = []
    for node, topics in doubled.items():
        first, *more = sorted(topics)
        text = f"{node} offers it as well" + (f", and {len(more)} more" if more else "")
        found.append(Trouble("twice", first, text, APART))
    return sorted(found)


def nameless(link: Ros2Link, endpoints: Iterable[GraphEndpoint]) -> Trouble | None:
    """Return the trouble of nodes without names: over DDS, Humble announces them differently."""
    topics = {each.topic for each in endpoints if not (each.ours or each.node or each.hash)}
    if not topics or link.transport != "dds" or link.distro == "humble":
        return None
    text = f"nodes with neither name nor type hashes, as on {min(topics)}"
    return Trouble("name", min(topics), text, "if they run Humble, set distro: humble")
