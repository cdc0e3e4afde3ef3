"""The page beside a demo: at its port, or at a free one where that is taken."""

import socket

from msgspec.structs import replace

from gigabrain_zenoh.deployment import Deployment
from gigabrain_zenoh.page.node import INSTALL, installed
from gigabrain_zenoh.settings import PageConfig

HOST = "127.0.0.1"


def with_page(deployment: Deployment, port: int) -> tuple[Deployment, str]:
    """The deployment with a page on its first host, and its address; or how to get one."""
    if not installed():
        return deployment, INSTALL
    port = free_port(port)
    (host, names), *others = deployment.hosts.items()
    hosts = {host: (*names, "page"), **dict(others)}
    served = replace(deployment, hosts=hosts, page=PageConfig(port=port))
    return served, f"http://{HOST}:{port}"


def free_port(port: int) -> int:
    """`port` where nobody listens on it yet, else any free one."""
    for wanted in (port, 0):
        try:
            with socket.create_server((HOST, wanted)) as probe:
                return int(probe.getsockname()[1])
        except OSError:
            continue
    return port
