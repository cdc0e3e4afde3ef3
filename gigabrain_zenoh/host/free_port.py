"""A free TCP port that the system gives to nobody else while this process runs."""

import socket
import sys


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
