"""The router's door: who comes in, who is turned away, and who is denied what."""

import asyncio
import contextlib
import fcntl
import logging
import os
import select
import threading
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager

from gigabrain_zenoh.audit import AuditTrail
from gigabrain_zenoh.keys.zenoh_log import DIRECTIVES, Denied, TurnedAway, ZenohLog
from gigabrain_zenoh.transport import Link
from gigabrain_zenoh.zenoh_session import log_to_stdout

log = logging.getLogger(__name__)

STDOUT, CHUNK, ROOM = 1, 1 << 16, 1 << 20  # bytes
Seen = Denied | TurnedAway


class Door:
    """Tells the audit trail whom the router did not let in, and what it did not let through."""

    def __init__(self, trail: AuditTrail, knows: Collection[str]) -> None:
        self._trail, self._knows = trail, knows
        self._links: dict[str, Link] = {}

    def link(self, link: Link) -> None:
        """Somebody has come, or has gone."""
        name = link.name or "a local process"
        if not link.there:
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

    def seen(self, all_seen: Sequence[Seen]) -> None:
        """What Zenoh's log has told."""
        for seen in all_seen:
            if isinstance(seen, TurnedAway):
                text = f"somebody was turned away at the door: {seen.why}"
                self._trail.note("stranger", "unknown", text, code=seen.why, ok=False)
                continue
            link = self._links.get(seen.zid)
            name = (link.name if link else "") or "local"
            where = link.address if link else "an unknown address"
            text = f"{name} at {where} may not {seen.what.lower()} {seen.key}"
            code = f"{seen.what.lower()} {seen.key}"
            self._trail.note("refused", name, text, code=code, ok=False)


@contextmanager
def zenoh_log(on_seen: Callable[[Sequence[Seen]], None]) -> Iterator[None]:
    """Read Zenoh's log while the block runs; `on_seen` is called on the loop's thread.

    Zenoh writes it to standard output, whose place a pipe takes for good. A thread empties it, so
    that Zenoh never waits for us; what others write there is passed on.
    """
    loop = asyncio.get_running_loop()
    outside = os.dup(STDOUT)
    reads, writes = os.pipe()
    with contextlib.suppress(OSError, AttributeError):  # other systems have smaller pipes
        fcntl.fcntl(writes, fcntl.F_SETPIPE_SZ, ROOM)
    os.dup2(writes, STDOUT)
    os.close(writes)
    listening = True

    def work() -> None:
        parse = ZenohLog()
        while data := os.read(reads, CHUNK):
            said = list(parse.feed(data))
            for line in said:
                if isinstance(line, bytes) and select.select((), (outside,), (), 0)[1]:
                    os.write(outside, line)
            seen = [each for each in said if not isinstance(each, bytes)]
            if seen and listening:
                with contextlib.suppress(RuntimeError):  # the loop is gone
                    loop.call_soon_threadsafe(on_seen, seen)

    threading.Thread(target=work, name="zenoh-log", daemon=True).start()
    log_to_stdout(DIRECTIVES)
    try:
        yield
    finally:
        listening = False
