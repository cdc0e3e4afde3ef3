"""Zenoh endpoints, the hosts that addresses name, and free ports."""

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
MAX_NAME_CHARS = 253  # RFC 1035, 2.3.4

ADDRESS = re.compile(r"(.*?://)(?:[^/?#]*@)?([^/?#]*)(.*)", re.DOTALL)


def host_shown(text: str) -> str:
    """Return a text that may hold an address, such as rtsp://HOST/PATH, only up to its host.

    The rest may hold a password. Where the host cannot be found with certainty, it is left out too.
    """
    address = ADDRESS.fullmatch(text)
    if address is None:
        return text
    start, host, rest = address.groups()
    return f"{start}…" if "@" in rest else start + host


def host_and_port(endpoint: str) -> tuple[str, int]:
    """Return the host of a Zenoh endpoint, without brackets, and its port; "" and 0 for a socket.

    Raises ValueError for an endpoint to which Zenoh could never connect.
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
    """Return whether `host` is an IPv4 or IPv6 address, not a name."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def is_host(text: str) -> bool:
    """Return whether `text` is an IP address or a possible host name (RFC 1123, 2.1)."""
    labels = text.removesuffix(".").split(".")
    named = all(LABEL.fullmatch(label) for label in labels) and not labels[-1].isdecimal()
    return is_ip(text) or (named and len(text) <= MAX_NAME_CHARS)


def is_loopback(host: str) -> bool:
    """Return whether the address is a loopback address, or the name `localhost`."""
    return host == "localhost" or (is_ip(host) and ipaddress.ip_address(host).is_loopback)


def reached_at(endpoint: str) -> str:
    """Return an endpoint to connect to from this machine: loopback for a wildcard address."""
    return endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")


def exposed(endpoints: Iterable[str]) -> str:
    """Return the first of these Zenoh endpoints that other machines can reach; empty for none.

    Raises ValueError for an invalid endpoint.
    """
    for endpoint in endpoints:
        host, _ = host_and_port(endpoint)
        if host and not is_loopback(host):
            return endpoint
    return ""


def reserve_port(host: str, port: int = 0) -> int:
    """Reserve `port` of `host`, an IP address without brackets; with 0 any free one.

    On Linux a bound socket that does not listen reserves it until this process ends: others may
    listen there if they name the port, but never get it as a free one. Other systems do not reserve
    it. Raises OSError if the port is in use.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as holder:
        holder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        holder.bind((host, port))
        free = int(holder.getsockname()[1])
        if sys.platform == "linux":
            holder.detach()
    return free
