"""Router and relay: Zenoh sessions that connect the others; with keys the router controls access.

A relay is a host's own router, with one link to the robot's router. It does no access control: the
robot's router checks messages against the host's certificate, as if processes connected to it.
"""

import asyncio
import contextlib
import logging
import os
import re
import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from gigabrain_schemas.topics import SERVICES, TOPICS
from gigabrain_zenoh.bus.bridge import Bridge, Mailbox
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import Link
from gigabrain_zenoh.bus.zenoh.session import log_to_stdout
from gigabrain_zenoh.config.settings import RelayConfig, RouterConfig
from gigabrain_zenoh.host.posix import fcntl, resource
from gigabrain_zenoh.runtime.audit import AuditTrail
from gigabrain_zenoh.runtime.process_watch import ProcessWatch
from gigabrain_zenoh.runtime.running import SOCKET
from gigabrain_zenoh.security.identity_files import identity_in

log = logging.getLogger(__name__)
MAX_OPEN_FILES = 65536  # one per possible link, including links that never send a message
FLUSH_NS = 1_000_000_000


async def run(config: RouterConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Run access control, if keys are configured; the session itself does the routing."""
    _raise_file_limit()
    watch = ProcessWatch(bus, config.watches)
    if not config.knows:
        ready()
        await _call_every_second(bus, watch.look)
        return
    trail = AuditTrail(bus, Path(config.state_dir))
    access = AccessAudit(trail, config.knows)
    try:
        with zenoh_log(access.note_denial):
            bus.links(access.note_link)
            ready()
            await _call_every_second(bus, watch.look, trail.flush)
    finally:
        await trail.close()


async def _call_every_second(bus: Bus, *functions: Callable[[], object]) -> None:
    """Call `functions` once a second until the bus fails; raise its error."""
    async for _ in bus.clock.every(FLUSH_NS):
        for function in functions:
            function()
        if bus.failed.done():
            bus.failed.result()


def _raise_file_limit() -> None:
    """Raise the limit of open files, so that silent connections do not exhaust it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MAX_OPEN_FILES if hard == resource.RLIM_INFINITY else min(hard, MAX_OPEN_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with contextlib.suppress(ValueError, OSError):  # some systems allow less than they report
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


WARN_AFTER_S = 1.0  # without a router, before a warning is logged


class RouterLink:
    """State of the link to the robot's router."""

    def __init__(self, router: str) -> None:
        self.open = asyncio.Event()
        self._router = router

    def update(self, link: Link) -> None:
        """Update the state when the router's link comes or goes; other links use the socket."""
        if link.address.startswith(SOCKET) or link.open == self.open.is_set():
            return
        if link.open:
            self.open.set()
            log.info("joined to the router at %s", self._router)
        else:
            self.open.clear()
            log.warning("no link to the router at %s any more", self._router)


async def run_relay(config: RelayConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Report ready once the robot's router is linked; the session itself does the routing.

    Raises ConfigError if the link fails because the host's own keys are invalid.
    """
    link = RouterLink(config.router)
    bus.links(link.update)
    try:
        await asyncio.wait_for(link.open.wait(), WARN_AFTER_S)
    except TimeoutError:
        if config.keys:  # a router rejects invalid keys without an error
            await asyncio.to_thread(identity_in, Path(config.keys))
        text = "no router at %s yet; waiting for it (start one with: gigabrain router)"
        log.warning(text, config.router, extra={"data": {"event": "waiting"}})
        await link.open.wait()
    ready()
    await bus.failed


# Zenoh denies without a reply, and reports it only in its log. Access control logs two lines from
# one thread; only the second confirms the denial (zenoh 1.10, net/routing/interceptor).
DIRECTIVES = "zenoh::net::routing::interceptor=trace,zenoh_link_tls=warn"
DENIED = re.compile(
    r"(?:: |Using cached result: )(\w+)(?: on \S+)? is unauthorized to (.+?) \(ingress\) on (.+)"
)
TURNED_AWAY = re.compile(r" WARN .*zenoh_link_tls::unicast: (.+?)(?:\. Hint: .*)?$")
THREAD = re.compile(rb"ThreadId\(\d+\)")
COLOUR = re.compile(rb"\x1b\[[0-9;]*m")
MAX_LINE_BYTES = 64 * 1024  # Zenoh's own lines are shorter
MAX_THREADS = 100  # whose first line is remembered


@dataclass(frozen=True)
class Denied:
    """A client with a session sent a message that it may not send."""

    zid: str
    what: str  # Zenoh's word for the kind of message, such as Put
    key: str


@dataclass(frozen=True)
class TurnedAway:
    """A client did not get a session. Zenoh does not log its name or address."""

    why: str  # Zenoh's text


class ZenohLog:
    """Finds denials in Zenoh's log."""

    def __init__(self) -> None:
        self._rest = b""
        self._unconfirmed: dict[bytes, bytes] = {}  # first lines, by thread

    def feed(self, data: bytes) -> Iterator[Denied | TurnedAway]:
        """Yield the denials that these next bytes of the log complete."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > MAX_LINE_BYTES:
            self._rest = b""
        for line in lines:
            if seen := self._read(line):
                yield seen

    def _read(self, line: bytes) -> Denied | TurnedAway | None:
        thread = THREAD.search(line)
        if thread is None:
            return None
        if b" is unauthorized to " in line:
            if len(self._unconfirmed) >= MAX_THREADS:
                self._unconfirmed.clear()
            self._unconfirmed[thread[0]] = line
            return None
        if b"Msg intercepted!" in line:
            denied = DENIED.search(_text(self._unconfirmed.pop(thread[0], b"")))
            return Denied(denied[1], denied[2], denied[3]) if denied else None
        self._unconfirmed.pop(thread[0], None)
        found = TURNED_AWAY.search(_text(line)) if b"zenoh_link_tls" in line else None
        return TurnedAway(found[1]) if found else None


def _text(line: bytes) -> str:
    """Return the line without colours and control characters."""
    text = COLOUR.sub(b"", line).decode(errors="replace").rstrip()
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


STDOUT, CHUNK_BYTES, PIPE_BYTES = 1, 1 << 16, 1 << 20
MAX_QUEUED = 1000  # denials that may wait for the event loop
WITH_DIGITS = re.compile(r"\S*\d\S*")  # words such as addresses, ports, numbers
KNOWN_KEYS = {*(topic.key for topic in TOPICS), *(service.key for service in SERVICES)}
Seen = Denied | TurnedAway


class AccessAudit:
    """Writes rejected clients and messages to the audit trail."""

    def __init__(self, trail: AuditTrail, knows: Collection[str]) -> None:
        self._trail, self._knows = trail, knows
        self._links: dict[str, Link] = {}

    def note_link(self, link: Link) -> None:
        """Log that a client connected or left; add one without rights to the audit trail."""
        name = link.name or "a local process"
        if not link.open:
            if self._links.pop(link.zid, None):
                log.info("%s at %s has left", name, link.address)
            return
        self._links[link.zid] = link
        if link.name and link.name not in self._knows:
            text = f"{link.address} has keys of the fleet, but {link.name} has no rights here"
            self._trail.note("stranger", link.name, text, code="no rights", ok=False)
            log.warning("%s", text, extra={"data": {"event": "stranger", "source": link.name}})
        else:
            log.info("%s has come from %s", name, link.address)

    def note_denial(self, seen: Seen) -> None:
        """Add a denial to the audit trail."""
        if isinstance(seen, TurnedAway):
            text = f"a client was refused a session: {seen.why}"
            code = WITH_DIGITS.sub("…", seen.why)
            self._trail.note("stranger", "unknown", text, code=code, ok=False)
            return
        link = self._links.get(seen.zid)
        name = (link.name or "local") if link else "unknown"
        where = link.address if link else "an unknown address"
        verb = seen.what.lower()
        text = f"{name} at {where} may not {verb} {seen.key}"
        code = f"{verb} {_known_key(seen.key)}"
        self._trail.note("refused", name, text, code=code, ok=False)


def _known_key(key: str) -> str:
    """Return the topic or service of a key, without the namespace; "other" for an unknown one."""
    parts = key.split("/")
    candidates = ("/".join(parts[at : at + 2]) for at in (0, 1))
    return next((each for each in candidates if each in KNOWN_KEYS), "other")


@contextmanager
def zenoh_log(on_seen: Callable[[Seen], None]) -> Iterator[None]:
    """Read Zenoh's log while the block runs; `on_seen` is called on the loop's thread.

    Zenoh writes it to standard output, which a pipe replaces permanently. The log must not reach
    the real output, since it quotes texts of unknown clients. A thread empties the pipe, so that
    Zenoh never waits; while the event loop is busy, the newest denials are queued.
    """
    bridge = Bridge()
    mailbox = Mailbox(bridge, on_seen, MAX_QUEUED)
    reads, writes = os.pipe()
    with contextlib.suppress(OSError, AttributeError):  # other systems have smaller pipes
        fcntl.fcntl(writes, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    os.dup2(writes, STDOUT)
    os.close(writes)

    def work() -> None:
        parse = ZenohLog()
        while data := os.read(reads, CHUNK_BYTES):
            for seen in parse.feed(data):
                mailbox.put(seen)

    threading.Thread(target=work, name="zenoh-log", daemon=True).start()
    log_to_stdout(DIRECTIVES)
    try:
        yield
    finally:
        bridge.close()
