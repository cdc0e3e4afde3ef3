"""Decides which host runs a relay, and which endpoints its processes connect to.

Without a relay, perception and decision on a host without the router meet at the robot's router.
The result of a scan would then cross the network four times; through a relay it crosses twice.
"""

import sys
from collections.abc import Collection

from msgspec import structs

from gigabrain_zenoh.config.settings import Endpoint, RelayConfig
from gigabrain_zenoh.runtime.running import local_socket

RELAY = "relay"
MEET = {"perception", "decision"}  # each runs once per robot, so there is one relay at most
AT_THE_ROBOT = {"router", "driver"}  # no relay between them: a body without its router must stop


def has_relay(processes: Collection[str]) -> bool:
    """Return whether a host with these processes runs a relay; never on Windows.

    A relay needs Unix sockets.
    """
    here = set(processes)
    return sys.platform != "win32" and here >= MEET and not here & AT_THE_ROBOT


def behind(endpoint: Endpoint) -> Endpoint:
    """Return the endpoint of the host's processes: a Unix socket that only this user can open."""
    return structs.replace(endpoint, connect=(local_socket(),), keys="")


def between(endpoint: Endpoint) -> Endpoint:
    """Return the relay's endpoint: it listens on the socket, and connects to the robot's router."""
    return structs.replace(endpoint, listen=(local_socket(),))


def relay_config(endpoint: Endpoint) -> RelayConfig:
    """Build the relay's settings, which name the router it connects to."""
    return RelayConfig(router=endpoint.connect[-1], keys=endpoint.keys)
