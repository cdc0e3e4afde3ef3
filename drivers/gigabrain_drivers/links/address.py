"""A body behind a TCP port whose address may be written in a file."""

from pathlib import Path

from gigabrain_drivers.links.link import LinkProblem
from gigabrain_drivers.links.tcp_link import TcpLink
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import read_bounded

MOST_BYTES = 256  # of a file that says where to call


class AddressLink(TcpLink):
    """As TcpLink, to `HOST:PORT` or to what a file says, which is read for every connection.

    An emulator takes whichever port is free, and another one when it starts anew.
    """

    def __init__(self, where: str, clock: Clock) -> None:
        super().__init__("", 0, clock)
        self._where = where
        if "/" not in where:
            self._host, self._port = address(where)

    def __str__(self) -> str:
        return f"{self._host}:{self._port}" if self._host else self._where

    async def _connect(self) -> int:
        if "/" in self._where:
            self._host, self._port = written(Path(self._where))
        return await super()._connect()


def address(text: str) -> tuple[str, int]:
    """(host, port) of `HOST:PORT`. Raises ConfigError."""
    host, _, port = text.strip().rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigError(f"port: expected HOST:PORT, such as 192.168.1.10:8080, got {text!r}")
    return host.strip("[]"), int(port)


def written(path: Path) -> tuple[str, int]:
    """(host, port) in a file. Raises LinkProblem."""
    try:
        return address(read_bounded(path, MOST_BYTES).decode("ascii"))
    except OSError:
        raise LinkProblem(f"no {path}: is the emulator running?") from None
    except (ConfigError, UnicodeDecodeError):
        raise LinkProblem(f"{path} does not hold HOST:PORT") from None
