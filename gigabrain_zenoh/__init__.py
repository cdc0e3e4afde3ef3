"""A robot brain of three systems that any body can wear: small processes on Zenoh.

`connect()` opens a connection to a running robot: `with gigabrain_zenoh.connect() as robot:`.
"""

TYPE_CHECKING = False  # as in `typing`: a command handles signals before it imports more
if TYPE_CHECKING:
    from typing import Any

    from gigabrain_zenoh.client.connection import Connection, connect
    from gigabrain_zenoh.client.motion import Reached
    from gigabrain_zenoh.client.robot import Robot
    from gigabrain_zenoh.client.sync_robot import SyncRobot
    from gigabrain_zenoh.errors import (
        BodyLost,
        BusError,
        ConfigError,
        GigabrainError,
        NotConfirmed,
        Refused,
        Unsupported,
    )

__all__ = [
    "BodyLost",
    "BusError",
    "ConfigError",
    "Connection",
    "GigabrainError",
    "NotConfirmed",
    "Reached",
    "Refused",
    "Robot",
    "SyncRobot",
    "Unsupported",
    "connect",
]
_MODULES = {
    "connect": "client.connection",
    "Connection": "client.connection",
    "SyncRobot": "client.sync_robot",
    "Reached": "client.motion",
    "Robot": "client.robot",
}


def __getattr__(name: str) -> "Any":
    """Import a public name when it is first used, as processes do not need it."""
    if name not in __all__:
        raise AttributeError(f"module 'gigabrain_zenoh' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"gigabrain_zenoh.{_MODULES.get(name, 'errors')}"), name)


def __dir__() -> list[str]:
    return __all__
