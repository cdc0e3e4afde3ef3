"""A robot brain of three systems that any body can wear: small processes on Zenoh."""

TYPE_CHECKING = False  # as in `typing`: a command handles signals before it imports more
if TYPE_CHECKING:
    from typing import Any

__all__ = ["connect"]


def __getattr__(name: str) -> "Any":
    """Import `gigabrain_zenoh.connect` when it is first used, as processes do not need it."""
    if name == "connect":
        from gigabrain_zenoh.client.robot import connect

        return connect
    raise AttributeError(f"module 'gigabrain_zenoh' has no attribute {name!r}")
