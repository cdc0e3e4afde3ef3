"""A robot brain of three systems that any body can wear: small processes on Zenoh."""

TYPE_CHECKING = False  # as in `typing`: a command handles signals before it imports more
if TYPE_CHECKING:
    from typing import Any

__all__ = ["connect"]


def __getattr__(name: str) -> "Any":
    """`gigabrain_zenoh.connect`, imported when first used: the processes have no need of it."""
    if name == "connect":
        from gigabrain_zenoh.client.robot import connect

        return connect
    raise AttributeError(f"module 'gigabrain_zenoh' has no attribute {name!r}")
