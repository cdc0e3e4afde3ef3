"""A process's Zenoh session, which is replaced whenever its link to the router is lost.

A session of Zenoh 1.10 reconnects to its router by itself. With short leases on a busy machine,
however, one end may notice the loss before the other. Both may then continue with the old link's
state: messages arrive under wrong keys, or none arrive until the link is lost again (zenoh#2806 is
similar). A new session keeps no state of the old one.
"""

import asyncio
import contextlib
import logging
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

import zenoh

from gigabrain_zenoh.bus.bridge import Bridge
from gigabrain_zenoh.bus.transport import Close
from gigabrain_zenoh.bus.zenoh.linger import close_in_background
from gigabrain_zenoh.bus.zenoh.session import close_session, open_session
from gigabrain_zenoh.config.settings import Endpoint

log = logging.getLogger(__name__)

T = TypeVar("T")
AGAIN_S = 1.0  # pause after a failed attempt to open a session


class Line:
    """A session, valid until a client's link to its router is lost."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session
        self.cut = False
        self.watch: Any = None  # keeps the listener alive

    def take(self, deliver: Callable[[T], object]) -> Callable[[T], None]:
        """Wrap `deliver` to drop messages after the loss, which may arrive under a wrong key."""

        def delivered(what: T) -> None:
            if not self.cut:
                deliver(what)

        return delivered


Make = Callable[[Line], Any]


class Declared:
    """A declaration, and the function that repeats it on a new session."""

    def __init__(self, make: Make) -> None:
        self.make = make
        self.made: Any = None


class Lines:
    """The current line and all declarations on it. Calls `on_lost` on the event loop."""

    def __init__(
        self, session: zenoh.Session, endpoint: Endpoint, bridge: Bridge, on_lost: Close
    ) -> None:
        self.now: Line | None = None  # None while there is no session
        self._endpoint, self._bridge, self._on_lost = endpoint, bridge, on_lost
        self._declared: list[Declared] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self._joined = asyncio.Event()
        self._join(session)

    def declare(self, make: Make) -> Close:
        """Declare something on this and every later line; return a function that undeclares it."""
        declared = Declared(make)
        if self.now:
            declared.made = make(self.now)
        self._declared.append(declared)

        def close() -> None:
            if declared in self._declared:
                self._declared.remove(declared)
                if declared.made:
                    declared.made.undeclare()

        return close

    async def within(self, timeout_s: float) -> Line | None:
        """Wait for a line up to `timeout_s`; return None if there is none by then."""
        if self.now is None:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._joined.wait(), timeout_s)
        return self.now

    async def close(self) -> None:
        """Close the session, and open no more."""
        for task in self._tasks:
            task.cancel()
        line, self.now = self.now, None
        self._joined.set()  # release callers that wait for a new line
        if line:
            await close_session(line.session)

    def _join(self, session: zenoh.Session) -> None:
        """Repeat all declarations on a new session, then make it the current line."""
        line = Line(session)
        renews = not self._endpoint.listen  # a router's links are its clients'

        def linked(event: zenoh.LinkEvent) -> None:
            close_in_background()
            if renews and event.kind == zenoh.SampleKind.DELETE:
                line.cut = True
                self._bridge.post(self._lost, line)

        line.watch = session.info.declare_link_events_listener(linked, history=True)
        made = [declared.make(line) for declared in self._declared]
        for declared, one in zip(self._declared, made, strict=True):
            declared.made = one
        self.now = line
        self._joined.set()
        if renews and not session.info.links():  # lost before the listener: no event
            line.cut = True
            self._bridge.post(self._lost, line)

    def _lost(self, line: Line) -> None:
        if line is not self.now:
            return
        self.now = None
        self._joined.clear()
        for declared in self._declared:
            declared.made = None
        self._start(close_session(line.session))
        self._on_lost()
        self._start(self._renew())

    async def _renew(self) -> None:
        while True:
            session = None
            try:
                session = await open_session(self._endpoint)
                self._join(session)
                return
            except Exception as error:  # noqa: BLE001 - without a line the process is deaf for good
                log.warning("the router cannot be joined again: %s", error)
                if session:  # some declarations failed on it
                    self._start(close_session(session))
                await asyncio.sleep(AGAIN_S)

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
