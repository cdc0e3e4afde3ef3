"""What Zenoh's own log tells of those whom a router turns away, or denies something.

Zenoh denies in silence, and says so in its log alone: for the access control in two lines of one
thread, of which the second makes the first count (zenoh 1.10, net/routing/interceptor).
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass

DIRECTIVES = "zenoh::net::routing::interceptor=trace,zenoh_link_tls=warn"
DENIED = re.compile(
    r"(?:: |Using cached result: )(\w+)(?: on \S+)? is unauthorized to (.+?) \(ingress\) on (.+)"
)
TURNED_AWAY = re.compile(r" WARN .*zenoh_link_tls::unicast: (.+?)(?:\. Hint: .*)?$")
THREAD = re.compile(rb"ThreadId\(\d+\)")
COLOUR = re.compile(rb"\x1b\[[0-9;]*m")
LONGEST = 64 * 1024  # bytes of a line; what is longer is no line of Zenoh's
THREADS = 100  # whose first line is remembered


@dataclass(frozen=True)
class Denied:
    """Somebody who has a session tried what is not allowed."""

    zid: str
    what: str  # in Zenoh's words, such as Put
    key: str


@dataclass(frozen=True)
class TurnedAway:
    """Somebody did not get a session. Zenoh does not say who, or from where."""

    why: str


class ZenohLog:
    """Cuts the log into lines and picks those that tell of a denial."""

    def __init__(self) -> None:
        self._rest = b""
        self._last: dict[bytes, bytes] = {}  # by thread

    def feed(self, data: bytes) -> Iterator[Denied | TurnedAway]:
        """What the log says of those whom the router does not let in, or not through."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LONGEST:
            self._rest = b""
        for line in lines:
            if seen := self._read(line):
                yield seen

    def _read(self, line: bytes) -> Denied | TurnedAway | None:
        thread = THREAD.search(line)
        if thread is None:
            return None
        if b" is unauthorized to " in line:
            if len(self._last) >= THREADS:
                self._last.clear()
            self._last[thread[0]] = line
            return None
        if b"Msg intercepted!" in line:
            denied = DENIED.search(_text(self._last.pop(thread[0], b"")))
            return Denied(denied[1], denied[2], denied[3]) if denied else None
        self._last.pop(thread[0], None)
        away = TURNED_AWAY.search(_text(line)) if b"zenoh_link_tls" in line else None
        return TurnedAway(away[1]) if away else None


def _text(line: bytes) -> str:
    """Without colours, and without what a terminal might obey."""
    text = COLOUR.sub(b"", line).decode(errors="replace").rstrip()
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
