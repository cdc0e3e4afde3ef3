"""How sessions are configured, and what a refusal means. Zenoh is not needed to read this."""

import re
from typing import Any

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.settings import Endpoint

IP_ENDPOINT = re.compile(r"(?:tcp|udp|tls|quic|ws)/[^/#?]+:(\d+)(?:[?#].*)?")
LOCAL_ENDPOINT = re.compile(r"unixsock-stream/.+")


def session_config(endpoint: Endpoint) -> dict[str, Any]:
    """Client of a router, or the router itself; explicit endpoints, no multicast, short leases.

    Raises ConfigError for an endpoint that Zenoh would wait for in vain.
    """
    if not endpoint.listen and not endpoint.connect:
        raise ConfigError("no router to connect to, and nowhere to listen")
    for text in (*endpoint.listen, *endpoint.connect):
        _check(text)
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
        "scouting/delay": 0,  # a router would wait half a second for others to find it
        "transport/unicast/open_timeout": 1000,
        "transport/unicast/accept_timeout": 1000,
        "transport/link/tx/lease": 400,
        "transport/link/tx/keep_alive": 4,
        # small messages that are not batched take a place each
        "transport/link/tx/queue/size": {"real_time": 16, "data_high": 16, "data": 16},
        "transport/link/rx/max_message_size": 16 << 20,
        "transport/shared_memory/enabled": False,
    }
    if endpoint.namespace:
        config["namespace"] = endpoint.namespace
    return config


def explain(endpoint: Endpoint, error: str) -> str:
    """Why a session could not be opened, in one line."""
    text, listens = plain(error), ", ".join(endpoint.listen)
    if listens and "address already in use" in text.lower():
        return f"the router's port is taken ({listens}); stop what uses it, or choose another"
    if listens:
        return f"the router cannot listen on {listens}: {text}"
    return f"no session with {', '.join(endpoint.connect)}: {text}"


def plain(error: str) -> str:
    """Zenoh's message without the places in its source."""
    text = re.sub(r" at \S+\.rs:\d+\.?", "", " ".join(error.split()))
    inner = re.search(r'msg: "(.+?)", location', text)
    return inner[1] if inner else text


def _check(text: str) -> None:
    address = IP_ENDPOINT.fullmatch(text)
    if not LOCAL_ENDPOINT.fullmatch(text) and not (address and int(address[1]) < 2**16):
        raise ConfigError(f"{text!r} is not a Zenoh endpoint; expected one like tcp/127.0.0.1:7447")
