"""The page beside a demo: at its port, or at a free one where that is taken."""

import contextlib

from msgspec.structs import replace

from gigabrain_zenoh.config.settings import PageConfig
from gigabrain_zenoh.host.network import reserve_port
from gigabrain_zenoh.runtime.deployment import Deployment
from gigabrain_zenoh.ui.page.access import token_file, tokens
from gigabrain_zenoh.ui.page.node import INSTALL, installed

HOST = "127.0.0.1"


def with_page(deployment: Deployment, port: int, *, login: bool = False) -> tuple[Deployment, str]:
    """The deployment with a page on its first host, and its address; or how to get one.

    With `login` the address holds the token to drive. Raises ConfigError.
    """
    if not installed():
        return deployment, INSTALL
    port = free_port(port)
    (host, names), *others = deployment.hosts.items()
    hosts = {host: (*names, "page"), **dict(others)}
    served = replace(deployment, hosts=hosts, page=PageConfig(port=port, login=login))
    key = f"/#{tokens(token_file(''))[0].operator}" if login else ""
    return served, f"http://{HOST}:{port}{key}"


def free_port(port: int) -> int:
    """`port` where nobody listens on it yet, else any free one."""
    for wanted in (port, 0):
        with contextlib.suppress(OSError):
            return reserve_port(HOST, wanted)
    return port
