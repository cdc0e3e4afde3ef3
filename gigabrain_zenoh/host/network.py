"""Zenoh endpoints, the hosts that they name, and free ports."""

import ipaddress
import re
import socket
import sys
from collections.abc import Iterable

IP_ENDPOINT = re.compile(
    r"(?:tcp|udp|tls|quic|ws)/(?P<host>\[[^\[\]]+\]|[^\[\]/#?]+):(?P<port>\d+)(?:[?#].*)?"
)
LOCAL_ENDPOINT = re.compile(r"unixsock-stream/.+")
LABEL = re.compile(r"[a-z0-9_](?:[a-z0-9_-]{0,61}[a-z0-9_])?", re.IGNORECASE | re.ASCII)
LONGEST_NAME = 253  # characters (RFC 1035, 2.3.4)


def host_and_port(endpoint: str) -> tuple[str, int]:
    """The host of a Zenoh endpoint, without brackets, and its port; of a Unix socket "" and 0.

    Raises ValueError for what Zenoh would wait for in vain.
    """
    if LOCAL_ENDPOINT.fullmatch(endpoint):
        return "", 0
    found = IP_ENDPOINT.fullmatch(endpoint)
    host = found["host"].strip("[]") if found else ""
    if not found or int(found["port"]) >= 2**16 or not is_host(host):
        raise ValueError(
            f"{endpoint!r} is not a Zenoh endpoint; expected one like tcp/127.0.0.1:7447"
        )
    return host, int(found["port"])


def is_ip(host: str) -> bool:
    """Whether it is an IPv4 or IPv6 address, and no name."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def is_host(text: str) -> bool:
    """Whether it is an IP address, or can be a host's name in DNS (RFC 1123, 2.1)."""
    labels = text.removesuffix(".").split(".")
    named = all(LABEL.fullmatch(label) for label in labels) and not labels[-1].isdecimal()
    return is_ip(text) or (named and len(text) <= LONGEST_NAME)


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches the address. Of names, only `localhost` is sure to be."""
    return host == "localhost" or (is_ip(host) and ipaddress.ip_address(host).is_loopback)


def reached_at(endpoint: str) -> str:
    """Where this machine reaches whoever listens on an endpoint: loopback for all addresses."""
    return endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")


def exposed(endpoints: Iterable[str]) -> str:
    """The first of these Zenoh endpoints that other machines can reach, or nothing.

    Raises ValueError for one that is none.
    """
    for endpoint in endpoints:
        host, _ = host_and_port(endpoint)
        if host and not is_loopback(host):
            return endpoint
    return ""


def reserve_port(host: str, port: int = 0) -> int:
    """`port` of `host`, an IP address without brackets; with 0 any free one.

    On Linux a socket that is bound and does not listen holds it until this process ends: others may
    listen there if they ask for that port by its number, and nobody who asks for any port gets it.
    Elsewhere the port is only known to have been free. Raises OSError where somebody listens.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as holder:
        holder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        holder.bind((host, port))
        free = int(holder.getsockname()[1])
        if sys.platform == "linux":
            holder.detach()
    return free
