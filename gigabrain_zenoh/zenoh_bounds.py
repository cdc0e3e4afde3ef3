"""What a router bounds of all that comes in, whoever says it: how large and how urgent it may be.

Readers refuse what is too large or too frequent themselves, and count it. But what is far too much
holds up what comes after it on the same lines, and an e-stop may be among that.
"""

from collections.abc import Iterable
from typing import Any

from gigabrain_schemas.topics import ESTOP_SAID, SERVICES, TOPICS, Priority, Service, Topic

FAR_TOO_LARGE = 4  # times what a reader takes
SAID: tuple[Topic[Any], ...] = (*TOPICS, ESTOP_SAID)
Rule = dict[str, Any]


def bounds() -> dict[str, Any]:
    """The settings of a router's session that bound what others may send through it."""
    return {
        "low_pass_filter": [*_small("put", SAID), *_small("query", SERVICES)],
        "qos/network": [*_urgent("put", SAID), *_urgent("query", SERVICES)],
    }


def _small(message: str, of: Iterable[Topic[Any] | Service[Any, Any]]) -> list[Rule]:
    """Zenoh's low-pass filter: what is far too large ends at the router."""
    sizes = {each.key: each.max_bytes for each in of}
    return [
        _at_ingress(f"a {message} of at most {size // 1024} KB", message, _keys(sizes, size))
        | {"size_limit": FAR_TOO_LARGE * size}
        for size in sorted(set(sizes.values()))
    ]


def _urgent(message: str, of: Iterable[Topic[Any] | Service[Any, Any]]) -> list[Rule]:
    """Everything as urgent as the table of topics has it, whatever its sender asks for.

    Else a flood of what calls itself most urgent would fill the queue of the e-stop, and one that
    may not be dropped would stand in everybody's way for as long as somebody does not read.
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
