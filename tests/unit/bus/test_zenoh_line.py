"""A line to the router: renewed whole, whatever goes wrong meanwhile."""

import asyncio
import threading
from collections.abc import Callable
from typing import Any

import pytest
import zenoh

from gigabrain_zenoh.bus.bridge import Bridge
from gigabrain_zenoh.bus.zenoh import session as zenoh_line
from gigabrain_zenoh.bus.zenoh.session import ReconnectingSession
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.bus.zenoh.workarounds import CLOSING_THREAD
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.testing.waiting import until


class Info:
    """The links of a session, and who is told when one goes."""

    def __init__(self, linked: bool) -> None:
        self._linked = linked
        self.told: Callable[[Any], None] = print

    def links(self) -> list[str]:
        return ["router"] if self._linked else []

    def declare_link_events_listener(self, told: Callable[[Any], None], history: bool) -> object:
        self.told = told
        return self


class Session:
    """As much of a Zenoh session as a line asks of it."""

    def __init__(self, *, linked: bool = True, refuses: Exception | None = None) -> None:
        self.info, self.refuses, self.closed = Info(linked), refuses, False
        self.declared: list[str] = []

    def declare(self, name: str) -> str:
        if self.refuses and self.declared:
            raise self.refuses
        self.declared.append(name)
        return name

    def get(self, *_: object, **__: object) -> None:
        if self.refuses:
            raise self.refuses

    def close(self) -> None:
        self.closed = True

    def lose(self) -> None:
        class Gone:
            kind = zenoh.SampleKind.DELETE

        self.info.told(Gone())


class World:
    """The sessions that are opened, in order, and a line over them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *sessions: Session) -> None:
        self._later = list(sessions[1:])
        self.lost = 0
        monkeypatch.setattr(zenoh_line, "open_session", self._open)
        monkeypatch.setattr(zenoh_line, "close_session", self._close)
        monkeypatch.setattr(zenoh_line, "AGAIN_S", 0.0)
        first: Any = sessions[0]
        self.lines = ReconnectingSession(
            first, Endpoint(connect=("tcp/127.0.0.1:1",)), Bridge(), self._count
        )
        for name in ("scan", "state"):
            self.lines.declare(lambda line, name=name: line.session.declare(name))

    async def _open(self, _: Endpoint) -> Session:
        return self._later.pop(0)

    async def _close(self, session: Session, declared: list[str]) -> None:
        session.closed = True
        declared.clear()

    def _count(self) -> None:
        self.lost += 1


@pytest.mark.parametrize("refusal", [zenoh.ZError("gone again"), RuntimeError("of any kind")])
async def test_a_session_that_cannot_be_declared_on_is_given_up_whole(
    refusal: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, half, whole = Session(), Session(refuses=refusal), Session()
    world = World(monkeypatch, first, half, whole)
    first.lose()
    await until(lambda: whole.declared == ["scan", "state"])
    assert world.lines.now is not None
    assert world.lines.now.session is whole  # type: ignore[comparison-overlap]
    assert (first.closed, half.closed, whole.closed) == (True, True, False)
    await world.lines.close()


async def test_nobody_gets_a_line_that_is_only_half_declared(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first, half = Session(), Session(refuses=zenoh.ZError("gone again"))
    world = World(monkeypatch, first, half, Session())
    first.lose()
    await until(lambda: bool(half.declared))
    assert world.lines.now is None or world.lines.now.session is not half  # type: ignore[comparison-overlap]
    await world.lines.close()


async def test_a_link_that_was_lost_before_anybody_listened_is_noticed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first, second = Session(linked=False), Session()
    world = World(monkeypatch, first, second)
    await until(lambda: second.declared == ["scan", "state"])
    assert world.lost == 1
    assert first.closed
    await world.lines.close()
    await asyncio.sleep(0)


class Declared:
    """Something declared on a session, which notes in which thread it is dropped."""

    def __init__(self, dropped: list[str]) -> None:
        self._dropped = dropped

    def __del__(self) -> None:
        self._dropped.append(threading.current_thread().name)


@pytest.mark.parametrize("lost", [False, True])
async def test_what_was_declared_is_dropped_by_the_thread_that_closes(
    lost: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not by garbage collection: in the thread of a callback it may wait for that callback."""
    first, dropped = Session(), list[str]()
    monkeypatch.setattr(zenoh_line, "open_session", lambda _: asyncio.sleep(60))
    session: Any = first
    lines = ReconnectingSession(session, Endpoint(connect=("tcp/127.0.0.1:1",)), Bridge(), list)
    lines.declare(lambda _: Declared(dropped))
    if lost:
        first.lose()
    else:
        await lines.close()
    await until(lambda: dropped)
    assert dropped == [CLOSING_THREAD]
    await lines.close()


async def test_who_asks_on_a_session_that_was_just_closed_is_answered_by_nobody() -> None:
    closed: Any = Session(refuses=zenoh.ZError("session closed"))
    transport = ZenohTransport(closed, Endpoint(connect=("tcp/127.0.0.1:1",)))
    assert await transport.query("robot/map", b"", "", 1.0, "data") == []
    await transport.close()
