"""A line to the router: renewed whole, whatever goes wrong meanwhile."""

from collections.abc import Callable
from typing import Any

import zenoh

from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.config.settings import Endpoint


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


async def test_who_asks_on_a_session_that_was_just_closed_is_answered_by_nobody() -> None:
    closed: Any = Session(refuses=zenoh.ZError("session closed"))
    transport = ZenohTransport(closed, Endpoint(connect=("tcp/127.0.0.1:1",)))
    assert await transport.query("robot/map", b"", "", 1.0, "data") == []
    await transport.close()
