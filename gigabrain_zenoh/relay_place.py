"""Which host has a relay, and who connects to whom there.

Perception and decision on a host without the router would meet at the robot's: what a scan leads to
would cross the network four times. At a router of their own host it crosses twice.
"""

import sys
from collections.abc import Collection

from msgspec import structs

from gigabrain_zenoh.running import local_socket
from gigabrain_zenoh.settings import Endpoint, RelayConfig

RELAY = "relay"
MEET = {"perception", "decision"}  # each runs once, so a robot has one relay at most
AT_THE_ROBOT = {"router", "driver"}  # a body cut off from its router is to stop


def has_relay(processes: Collection[str]) -> bool:
    """Whether a host with these processes has a relay; there are none without Unix sockets."""
    here = set(processes)
    return sys.platform != "win32" and here >= MEET and not here & AT_THE_ROBOT


def behind(endpoint: Endpoint) -> Endpoint:
    """Where the host's processes connect: the socket that only this user can open."""
    return structs.replace(endpoint, connect=(local_socket(),), keys="")


def between(endpoint: Endpoint) -> Endpoint:
    """The relay's own side: it listens there, and connects to the robot's router with the keys."""
    return structs.replace(endpoint, listen=(local_socket(),))


def relay_config(endpoint: Endpoint) -> RelayConfig:
    """What the relay has to know in order to say whom it waits for."""
    return RelayConfig(router=endpoint.connect[-1], keys=endpoint.keys)
