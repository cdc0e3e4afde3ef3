"""Configuration of Zenoh sessions, and explanations of their errors. Does not import Zenoh."""

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from msgspec import structs

from gigabrain_schemas.topics import SERVICES, Priority, Service, Topic
from gigabrain_zenoh.config.settings import Endpoint, RouterConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.network import LOCAL_ENDPOINT, host_and_port
from gigabrain_zenoh.security.acl import (
    FIRST,
    PUBLISHED,
    Grants,
    Table,
    access_control,
    known_names,
    own_topics,
)
from gigabrain_zenoh.security.identity_files import (
    CA,
    CERTIFICATE,
    KEY,
    check_files,
    generations_in,
)

FAR_TOO_LARGE = 4  # times the size that a reader accepts
Rule = dict[str, Any]


def bounds(grants: Grants) -> dict[str, Any]:
    """Return the settings of a router's session that limit messages from others."""
    topics = (*PUBLISHED, *own_topics(grants))
    return {
        "low_pass_filter": [*_small("put", topics), *_small("query", SERVICES)],
        "qos/network": [*_urgent("put", topics), *_urgent("query", SERVICES)],
    }


def _small(message: str, of: Iterable[Topic[Any] | Service[Any, Any]]) -> list[Rule]:
    """Return rules of Zenoh's low-pass filter that drop far too large messages at the router."""
    sizes = {each.key: each.max_bytes for each in of}
    return [
        _at_ingress(f"a {message} of at most {size // 1024} KB", message, _keys(sizes, size))
        | {"size_limit": FAR_TOO_LARGE * size}
        for size in sorted(set(sizes.values()))
    ]


def _urgent(message: str, of: Iterable[Topic[Any] | Service[Any, Any]]) -> list[Rule]:
    """Return rules that set each message's priority to its topic's, whatever its sender requested.

    Otherwise a flood of messages sent at the highest priority would fill the e-stop's queue.
    Messages that may not be dropped would block all others for as long as one reader does not read.
    """
    urgency: dict[str, Priority] = {each.key: each.priority for each in of}
    return [
        _at_ingress(f"a {message} at {priority}", message, _keys(urgency, priority))
        | {"overwrite": {"priority": priority, "congestion_control": "drop", "express": False}}
        for priority in sorted(set(urgency.values()))
    ]


def _keys(by_key: dict[str, Any], wanted: object) -> list[str]:
    return [f"**/{key}/**" for key, value in by_key.items() if value == wanted]


def _at_ingress(name: str, message: str, keys: list[str]) -> Rule:
    return {"id": name, "messages": [message], "flows": ["ingress"], "key_exprs": keys}


# Runs Zenoh in one thread, except for sending: a message then wakes half as many threads. The
# variable is documented by Zenoh (zenoh_runtime::ZRuntime); a value set by the user wins.
ZENOH_RUNTIME = "(rx: (handover: app), acc: (handover: app), net: (handover: app))"
SECURE, PLAIN = "tls/", "tcp/"
IPV6 = f"{SECURE}[", f"{PLAIN}["
ROOMY = ("real_time", "interactive_high", "data_high", "data")
PENDING = 4000  # links that may wait to be accepted; silent ones are dropped after a second


def session_config(endpoint: Endpoint) -> dict[str, Any]:
    """Build the configuration of a client, a router, or a relay (which listens and connects).

    It uses explicit endpoints, no multicast, and short leases.

    With keys, all traffic that leaves the machine uses TLS with certificates on both ends. A router
    grants each client its certificate's rights. Raises ConfigError for an endpoint that Zenoh would
    wait for forever, and for missing keys.
    """
    endpoint = secured(endpoint)
    if not endpoint.listen and not endpoint.connect:
        raise ConfigError("no router to connect to, and nowhere to listen")
    for text in (*endpoint.listen, *endpoint.connect):
        _check(text)
    if not endpoint.keys:
        return session_settings(endpoint)
    check_files(Path(endpoint.keys))
    return session_settings(endpoint) | security(endpoint, generations_in(Path(endpoint.keys)))


def session_settings(endpoint: Endpoint) -> dict[str, Any]:
    """Build the settings that all sessions share, with keys or without."""
    config: dict[str, Any] = {
        "mode": "router" if endpoint.listen else "client",
        "listen/endpoints": list(endpoint.listen),
        "connect/endpoints": list(endpoint.connect),
        "connect/timeout_ms": -1,  # wait for the router as long as it takes
        "connect/exit_on_failure": False,
        "connect/retry": {
            "period_init_ms": 100,
            "period_max_ms": 500,
            "period_increase_factor": 2,
        },
        "scouting/multicast/enabled": False,
        "scouting/delay": 0,  # otherwise a router waits half a second for others to find it
        "transport/unicast/open_timeout": 1000,
        "transport/unicast/accept_timeout": 1000,
        "transport/unicast/accept_pending": PENDING,
        "transport/link/tx/lease": 400,
        "transport/link/tx/keep_alive": 4,
        # each small message that is not batched occupies one slot
        "transport/link/tx/queue/size": dict.fromkeys(ROOMY, 16),
        "transport/link/rx/max_message_size": 16 << 20,
        "transport/shared_memory/enabled": False,
    }
    if endpoint.listen and (endpoint.keys or endpoint.connect):
        config["adminspace/enabled"] = False
    if endpoint.listen:
        config |= bounds(endpoint.grants)
    if endpoint.namespace:
        config["namespace"] = endpoint.namespace
    if endpoint.stamps:
        config["timestamping/enabled"] = True
    return config


def security(endpoint: Endpoint, generations: Mapping[str, int]) -> dict[str, Any]:
    """Build the settings that keys add: TLS in both directions, and access control in a router."""
    folder, side = Path(endpoint.keys), "connect" if endpoint.connect else "listen"
    config: dict[str, Any] = {
        "transport/link/tls": {
            "root_ca_certificate": str(folder / CA),
            "enable_mtls": True,
            "close_link_on_expiration": True,
            f"{side}_private_key": str(folder / KEY),
            f"{side}_certificate": str(folder / CERTIFICATE),
        }
    }
    if endpoint.listen and not endpoint.connect:  # a relay is checked by the router it connects to
        table = Table(endpoint.names, grants=endpoint.grants)
        config["access_control"] = access_control(
            robots_of(endpoint), table, endpoint.namespace, generations
        )
    return config


def robots_of(endpoint: Endpoint) -> tuple[str, ...]:
    """Return the namespaces of the robots that a router serves: its own, and the fleet's."""
    own = (endpoint.namespace,) if endpoint.namespace or not endpoint.fleet else ()
    return tuple(dict.fromkeys((*own, *endpoint.fleet)))


def router_config(endpoint: Endpoint, state_dir: Path) -> RouterConfig:
    """Build the router process's settings, with the names that have rights in its session."""
    if not endpoint.keys:
        return RouterConfig(state_dir=str(state_dir))
    generations = generations_in(Path(endpoint.keys))
    knows = known_names(robots_of(endpoint), generations, endpoint.grants)
    return RouterConfig(state_dir=str(state_dir), knows=knows)


def secured(endpoint: Endpoint) -> Endpoint:
    """Return the endpoint with TLS in place of TCP if it has keys. Raises ConfigError."""
    texts = (*endpoint.listen, *endpoint.connect)
    if not endpoint.keys:
        bare = [text for text in texts if text.startswith(SECURE)]
        if bare:
            raise ConfigError(f"{bare[0]} needs keys; name their folder, or use tcp/")
        return endpoint
    for text in texts:
        if not text.startswith((SECURE, PLAIN)) and not LOCAL_ENDPOINT.fullmatch(text):
            raise ConfigError(f"{text!r}: with keys, expected one like tls/192.168.1.10:7447")
    # zenoh 1.10 takes it for an invalid DNS name, and would wait
    if endpoint.connect and all(text.startswith(IPV6) for text in endpoint.connect):
        raise ConfigError(
            f"{endpoint.connect[0]!r}: with keys, Zenoh connects to no IPv6 address; "
            "give the host's name, or its IPv4 address"
        )
    return structs.replace(
        endpoint,
        connect=tuple(_secure(text) for text in endpoint.connect),
        listen=tuple(_secure(text) for text in endpoint.listen),
    )


def _secure(text: str) -> str:
    return SECURE + text.removeprefix(PLAIN) if text.startswith(PLAIN) else text


def explain(endpoint: Endpoint, error: str) -> str:
    """Explain in one line why a session could not be opened."""
    text, listens = plain(error), ", ".join(endpoint.listen)
    if listens and "address already in use" in text.lower():
        return f"the router's port is taken ({listens}); stop what uses it, or choose another"
    if listens:
        return f"the router cannot listen on {listens}: {text}"
    return f"no session with {', '.join(endpoint.connect)}: {text}"


def plain(error: str) -> str:
    """Return Zenoh's message without locations in its source code."""
    text = re.sub(r" at \S+\.rs:\d+\.?", "", " ".join(error.split()))
    inner = re.search(r'msg: "(.+?)", location', text)
    return inner[1] if inner else text


def _check(text: str) -> None:
    try:
        host_and_port(text)
    except ValueError as error:
        raise ConfigError(str(error)) from None


HEADER = """\
// A router for several robots on a host of its own. Written by:
//   gigabrain keys zenohd{options}
// Start: zenohd --config zenohd.json5
"""


def configuration(endpoint: Endpoint, generations: Mapping[str, int] = FIRST) -> str:
    """Return a file for `zenohd --config`; its `keys` are a folder on its own host.

    Raises ConfigError.
    """
    endpoint, robots = secured(endpoint), endpoint.fleet
    for text in endpoint.listen:
        _check(text)
    settings = session_settings(endpoint) | security(endpoint, generations)
    options = "".join(f" --robot {robot}" for robot in robots if robot)
    return HEADER.format(options=options) + json.dumps(_nested(settings), indent=2) + "\n"


def _nested(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return `{"a/b": 1}` as `{"a": {"b": 1}}`."""
    root: dict[str, Any] = {}
    for path, value in settings.items():
        *parents, name = path.split("/")
        place = root
        for parent in parents:
            place = place.setdefault(parent, {})
        place[name] = value
    return root
