"""Limits on the size and priority of messages that enter a router, from any sender.

Readers themselves reject and count messages that are too large or too frequent. But extreme sizes
delay later messages on the same links, and an e-stop may be among those.
"""

from collections.abc import Iterable
from typing import Any

from gigabrain_schemas.topics import ESTOP_SAID, SERVICES, TOPICS, Priority, Service, Topic

FAR_TOO_LARGE = 4  # times the size that a reader accepts
SAID: tuple[Topic[Any], ...] = (*TOPICS, ESTOP_SAID)
Rule = dict[str, Any]


def bounds() -> dict[str, Any]:
    """Return the settings of a router's session that limit messages from others."""
    return {
        "low_pass_filter": [*_small("put", SAID), *_small("query", SERVICES)],
        "qos/network": [*_urgent("put", SAID), *_urgent("query", SERVICES)],
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
