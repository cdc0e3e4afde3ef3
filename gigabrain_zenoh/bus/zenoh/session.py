"""Zenoh sessions, opened and closed in worker threads so that they do not block the event loop."""

import asyncio
import contextlib
import functools
import json
import logging
import os
import threading
from collections.abc import Callable

import zenoh

from gigabrain_zenoh.bus.zenoh.config import explain, plain, session_config
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


async def open_session(endpoint: Endpoint) -> zenoh.Session:
    """Open a session, waiting for the router without a time limit.

    Uses a daemon thread rather than the loop's executor, so that the process can exit meanwhile.
    Raises BusError when a router cannot listen, ConfigError for an endpoint that is not valid.
    """
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
        except zenoh.ZError as error:
            fault = error
        try:
            loop.call_soon_threadsafe(settle, session, fault)
        except RuntimeError:  # the loop is closed
            if session:
                _close(session)

    _in_thread(work)
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
        _in_thread(functools.partial(_close, opened.result()))


def _in_thread(work: Callable[[], None]) -> None:
    threading.Thread(target=work, name="zenoh-session", daemon=True).start()


def _close(session: zenoh.Session) -> None:
    try:
        session.close()
    except zenoh.ZError as error:
        log.debug("closing the session: %s", error)


async def close_session(session: zenoh.Session) -> None:
    """Close the session, waiting half a second at most.

    After that, closing continues until the process ends.
    """
    loop = asyncio.get_running_loop()
    done = asyncio.Event()

    def work() -> None:
        _close(session)
        with contextlib.suppress(RuntimeError):  # the loop is closed
            loop.call_soon_threadsafe(done.set)

    _in_thread(work)
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
