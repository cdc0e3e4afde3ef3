"""Modules of Python that only POSIX systems have. On other systems their use raises Unsupported.

All other modules import them from here, so that the package imports on Windows.
"""

from typing import TYPE_CHECKING, Any

from gigabrain_zenoh.errors import Unsupported

__all__ = ["fcntl", "resource", "termios", "tty"]


class _Missing:
    error = OSError  # `except termios.error` must name an exception type

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        raise Unsupported(f"{self._name}.{attribute} needs Linux or macOS")


if TYPE_CHECKING:
    import fcntl
    import resource
    import termios
    import tty
else:
    try:
        import fcntl
        import resource
        import termios
        import tty
    except ImportError:
        fcntl, resource, termios, tty = map(_Missing, __all__)
