"""Zenoh sessions: opened and closed in worker threads, and replaced when their link is lost.

A session of Zenoh 1.10 reconnects to its router by itself. With short leases on a busy machine,
however, one end may notice the loss before the other. Both may then continue with the old link's
state: messages arrive under wrong keys, or none arrive until the link is lost again (zenoh#2806 is
similar). A new session keeps no state of the old one.
"""

import asyncio
import atexit
import contextlib
import functools
import json
import logging
import os
import threading
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

import zenoh
from zenoh.handlers import Callback

from gigabrain_zenoh.bus.bridge import Bridge
from gigabrain_zenoh.bus.transport import Close
from gigabrain_zenoh.bus.zenoh.config import ZENOH_RUNTIME, explain, plain, session_config
from gigabrain_zenoh.bus.zenoh.workarounds import (
    CLOSING_THREAD,
    await_zenoh_threads,
    disable_linger,
    keep_thread_state,
)
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import BusError, ConfigError

log = logging.getLogger(__name__)
CLOSE_S = 0.5  # without a limit, closing may take 10 s on a link that loses packets


def _config(endpoint: Endpoint) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in session_config(endpoint).items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise ConfigError(
                f"{key} = {value!r} is refused by Zenoh: {plain(str(error))}"
            ) from None
    return config


_open: set[zenoh.Session] = set()  # those of this process that nobody began to close


@functools.cache
def _close_at_exit() -> None:
    """Have this process close at its end what is still open; see `await_zenoh_threads`."""
    atexit.register(_close_all)


def _close_all() -> None:
    for session in tuple(_open):
        _in_thread(functools.partial(_close, session), CLOSING_THREAD)
    await_zenoh_threads()


async def open_session(endpoint: Endpoint) -> zenoh.Session:
    """Open a session, waiting for the router without a time limit.

    Uses a daemon thread rather than the loop's executor, so that the process can exit meanwhile.
    Raises BusError when a router cannot listen, ConfigError for an endpoint that is not valid.
    """
    _close_at_exit()
    os.environ.setdefault("ZENOH_RUNTIME", ZENOH_RUNTIME)  # read when Zenoh starts its threads
    config = _config(endpoint)
    loop = asyncio.get_running_loop()
    opened: asyncio.Future[zenoh.Session] = loop.create_future()

    def settle(session: zenoh.Session | None, error: zenoh.ZError | None) -> None:
        if session:
            opened.set_result(session)
        elif error:
            opened.set_exception(error)

    def work() -> None:
        session, fault = None, None
        try:
            session = zenoh.open(config)
            _open.add(session)
        except zenoh.ZError as error:
            fault = error
        try:
            loop.call_soon_threadsafe(settle, session, fault)
        except RuntimeError:  # the loop is closed
            if session:
                _close(session)

    _in_thread(work, "zenoh-open")
    try:
        return await asyncio.shield(opened)
    except zenoh.ZError as error:
        raise BusError(explain(endpoint, str(error))) from None
    except asyncio.CancelledError:
        opened.add_done_callback(_discard)
        raise


def _discard(opened: asyncio.Future[zenoh.Session]) -> None:
    """Close a session whose opening was cancelled."""
    if opened.exception() is None:
        _in_thread(functools.partial(_close, opened.result()), CLOSING_THREAD)


def _in_thread(work: Callable[[], None], name: str) -> None:
    threading.Thread(target=work, name=name, daemon=True).start()


def _close(session: zenoh.Session) -> None:
    _open.discard(session)
    try:
        session.close()
    except zenoh.ZError as error:
        log.debug("closing the session: %s", error)


async def close_session(session: zenoh.Session, declared: list[Any]) -> None:
    """Close the session, waiting half a second at most.

    After that, closing continues until the process ends. What was `declared` on it is dropped in
    the closing thread. An advanced publisher waits there for Zenoh's threads, and these may wait
    for a callback: garbage collection in that callback's thread would wait for ever.
    """
    loop = asyncio.get_running_loop()
    done = asyncio.Event()

    def work() -> None:
        _close(session)
        declared.clear()
        with contextlib.suppress(RuntimeError):  # the loop is closed
            loop.call_soon_threadsafe(done.set)

    _in_thread(work, CLOSING_THREAD)
    try:
        await asyncio.wait_for(done.wait(), CLOSE_S)
    except TimeoutError:
        log.debug("the session did not close in %s s", CLOSE_S)


def log_to_stdout(directives: str) -> None:
    """Make Zenoh write its own log to standard output, for the life of this process.

    The `directives` have the format of RUST_LOG, and are added to those set by the user there.
    """
    ours = os.environ.get("RUST_LOG", "")
    os.environ["RUST_LOG"] = f"{ours},{directives}" if ours else directives
    zenoh.try_init_log_from_env()


T = TypeVar("T")
AGAIN_S = 1.0  # pause after a failed attempt to open a session


def has_subscriber(publisher: zenoh.Publisher) -> bool:
    """Return whether anybody subscribes to the publisher's key.

    The status is an object that is always true, where the stubs of zenoh 1.10 say bool.
    """
    status: Any = publisher.matching_status
    return bool(status.matching)


class OpenSession:
    """A session, valid until a client's link to its router is lost."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session
        self.cut = False
        self.watch: Any = None  # keeps the listener alive

    def guard(self, deliver: Callable[[T], object]) -> Callable[[T], None]:
        """Wrap `deliver` to drop messages after the loss, which may arrive under a wrong key."""

        def delivered(what: T) -> None:
            if not self.cut:
                deliver(what)

        return delivered

    def direct(self, deliver: Callable[[T], object]) -> Any:
        """Return the same as a handler in Zenoh's receiving thread, where `deliver` must be short.

        Any other callback of Zenoh's wakes a thread of its own for each message.
        """

        def delivered(what: T) -> None:
            keep_thread_state()
            if not self.cut:
                deliver(what)

        return Callback(delivered, indirect=False)


Make = Callable[[OpenSession], Any]


class Declaration:
    """A declaration, and the function that repeats it on a new session."""

    def __init__(self, make: Make) -> None:
        self.make = make
        self.made: Any = None


class Bundle:
    """Declarations that are withdrawn together, the last first."""

    def __init__(self, *declared: Any) -> None:
        self._declared = declared

    def undeclare(self) -> None:
        """Withdraw all of them."""
        for each in reversed(self._declared):
            with contextlib.suppress(zenoh.ZError):  # its session is closed
                each.undeclare()


class ReconnectingSession:
    """The current line and all declarations on it. Calls `on_lost` on the event loop."""

    def __init__(
        self, session: zenoh.Session, endpoint: Endpoint, bridge: Bridge, on_lost: Close
    ) -> None:
        self.now: OpenSession | None = None  # None while there is no session
        self._endpoint, self._bridge, self._on_lost = endpoint, bridge, on_lost
        self._declared: list[Declaration] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self._joined = asyncio.Event()
        self._join(session)

    def declare(self, make: Make) -> Close:
        """Declare something on this and every later line; return a function that undeclares it."""
        declared = Declaration(make)
        if self.now:
            declared.made = make(self.now)
        self._declared.append(declared)

        def close() -> None:
            if declared in self._declared:
                self._declared.remove(declared)
                if declared.made:
                    declared.made.undeclare()

        return close

    async def within(self, timeout_s: float) -> OpenSession | None:
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
            await close_session(line.session, self._withdraw())

    def _join(self, session: zenoh.Session) -> None:
        """Repeat all declarations on a new session, then make it the current line."""
        line = OpenSession(session)
        renews = not self._endpoint.listen  # a router's links are its clients'

        def linked(event: zenoh.LinkEvent) -> None:
            disable_linger()
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

    def _lost(self, line: OpenSession) -> None:
        if line is not self.now:
            return
        self.now = None
        self._joined.clear()
        self._on_lost()
        self._start(close_session(line.session, self._withdraw()))
        self._start(self._renew())

    def _withdraw(self) -> list[Any]:
        """Return what was declared on the last line, and forget it."""
        made = [declared.made for declared in self._declared]
        for declared in self._declared:
            declared.made = None
        return made

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
                    self._start(close_session(session, []))
                await asyncio.sleep(AGAIN_S)

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
