import asyncio
from collections.abc import AsyncIterator

import pytest

from gigabrain_schemas.body import GateStatus
from gigabrain_schemas.requests import EstopRequest, GateReply
from gigabrain_schemas.topics import ESTOP
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.testing.processes import ZenohNetwork, robot


@pytest.fixture
async def net() -> AsyncIterator[ZenohNetwork]:
    async with robot() as made:
        await made.router()
        yield made


async def echo(payload: bytes) -> tuple[bytes, str]:
    return payload[::-1], "application/x"


async def refuse(payload: bytes) -> tuple[bytes, str]:
    raise Refused(f"not {payload.decode()}: ümläut")


class SlowService:
    """A service that replies after a minute."""

    def __init__(self) -> None:
        self.began = asyncio.Event()

    async def answer(self, _: bytes) -> tuple[bytes, str]:
        self.began.set()
        await asyncio.sleep(60)
        return b"", ""

    async def asked_by(self, asker: ZenohTransport) -> "asyncio.Future[list[bytes | str]]":
        """Return a pending query of `asker` that has arrived here."""
        async with asyncio.timeout(30):
            while True:
                asking = asyncio.ensure_future(asker.query("robot/goal", b"", "", 60.0, "data"))
                begun = asyncio.ensure_future(self.began.wait())
                await asyncio.wait((asking, begun), return_when=asyncio.FIRST_COMPLETED)
                if not asking.done():
                    return asking
                begun.cancel()  # the query was sent before the server was known


async def ask(
    transport: ZenohTransport, key: str, payload: bytes = b"", wanted: int = 1
) -> list[bytes | str]:
    """Repeat a query until it has as many replies as wanted."""
    async with asyncio.timeout(30):
        while True:
            replies = await transport.query(key, payload, "", 5.0, "data")
            if len(replies) == wanted:
                return replies


async def test_a_query_gets_its_reply(net: ZenohNetwork) -> None:
    server, asker = await net.client(), await net.client()
    server.serve("robot/goal", echo)
    assert await ask(asker, "robot/goal", b"abc") == [b"cba"]
    assert await ask(asker, "robot/goal") == [b""]
    assert await ask(asker, "robot/goal", bytes(64 * 1024)) == [bytes(64 * 1024)]


async def test_a_reply_of_a_megabyte_arrives_whole(net: ZenohNetwork) -> None:
    async def answer(_: bytes) -> tuple[bytes, str]:
        return bytes(range(256)) * 4096, ""

    server, asker = await net.client(), await net.client()
    server.serve("robot/map", answer)
    assert await ask(asker, "robot/map") == [bytes(range(256)) * 4096]


async def test_a_refusal_is_a_text(net: ZenohNetwork) -> None:
    server, asker = await net.client(), await net.client()
    server.serve("robot/goal", refuse)
    assert await ask(asker, "robot/goal", b"now") == ["not now: ümläut"]


async def test_a_query_without_a_server_has_no_reply(net: ZenohNetwork) -> None:
    asker = await net.client()
    assert await asker.query("robot/goal", b"", "", 30.0, "data") == []


async def test_a_late_reply_is_dropped(net: ZenohNetwork) -> None:
    slow = SlowService()
    server, asker = await net.client(), await net.client()
    server.serve("robot/goal", slow.answer)
    while not slow.began.is_set():
        assert await asker.query("robot/goal", b"", "", 0.2, "data") == []


async def test_all_servers_of_a_key_reply(net: ZenohNetwork) -> None:
    one, two, asker = await net.client(), await net.client(), await net.client()
    one.serve("robot/goal", echo)
    two.serve("robot/goal", refuse)
    replies = await ask(asker, "robot/goal", b"abc", 2)
    assert set(replies) == {b"cba", "not abc: ümläut"}


async def test_a_query_may_name_many_keys_at_once(net: ZenohNetwork) -> None:
    server, asker = await net.client(), await net.client()
    for process in ("driver", "control", "safety"):
        server.serve(f"robot/describe/{process}", echo)
    server.serve("robot/goal", echo)
    assert await ask(asker, "robot/describe/*", b"ab", 3) == [b"ba"] * 3


async def test_a_session_answers_its_own_queries(net: ZenohNetwork) -> None:
    client = await net.client()
    client.serve("robot/goal", echo)
    assert await ask(client, "robot/goal", b"ab") == [b"ba"]


async def test_a_closed_service_does_not_reply(net: ZenohNetwork) -> None:
    server, asker = await net.client(), await net.client()
    close = server.serve("robot/goal", echo)
    server.serve("robot/mission", echo)
    await ask(asker, "robot/goal", b"ab")
    close()
    close()
    await ask(asker, "robot/mission", b"ab")
    assert await ask(asker, "robot/goal", b"ab", 0) == []


async def test_a_query_ends_at_once_when_its_server_closes(net: ZenohNetwork) -> None:
    slow = SlowService()
    server, asker = await net.client(), await net.client()
    server.serve("robot/goal", slow.answer)
    asking = await slow.asked_by(asker)
    await server.close()
    async with asyncio.timeout(20):  # less than the timeout of the query
        assert await asking == []


async def test_closing_a_client_does_not_wait_for_its_query(net: ZenohNetwork) -> None:
    server, asker = await net.client(), await net.client()
    slow = SlowService()
    server.serve("robot/goal", slow.answer)
    asking = await slow.asked_by(asker)
    await asker.close()
    async with asyncio.timeout(10):
        assert await asking == []


async def test_a_cancelled_query_does_not_block_later_ones(net: ZenohNetwork) -> None:
    server, asker = await net.client(), await net.client()
    slow = SlowService()
    server.serve("robot/goal", slow.answer)
    asking = await slow.asked_by(asker)
    asking.cancel()
    with pytest.raises(asyncio.CancelledError):
        await asking
    server.serve("robot/mission", echo)
    assert await ask(asker, "robot/mission", b"ab") == [b"ba"]


async def test_requests_and_replies_of_the_bus_work_over_zenoh(
    net: ZenohNetwork,
) -> None:
    async def answer(request: EstopRequest) -> GateReply:
        if request.reason == "fun":
            raise Refused("not for fun")
        return GateReply(ok=True, text=request.reason, robot_type="mock", gate=GateStatus())

    one, two = Bus(await net.client(), Clock(), "one"), Bus(await net.client(), Clock(), "two")
    one.serve(ESTOP, answer)
    replies: list[GateReply] = []
    async with asyncio.timeout(30):
        while not replies:
            replies = await two.ask(ESTOP, EstopRequest(reason="a child"), timeout_s=5)
    assert replies[0].text == "a child"
    with pytest.raises(Refused, match=r"^not for fun$"):
        await two.ask(ESTOP, EstopRequest(reason="fun"), timeout_s=20)


async def test_an_invalid_request_over_zenoh_is_refused_with_a_reason(net: ZenohNetwork) -> None:
    async def answer(_: EstopRequest) -> GateReply:
        return GateReply(ok=True, text="", robot_type="mock", gate=GateStatus())

    bus, raw = Bus(await net.client(), Clock()), await net.client()
    bus.serve(ESTOP, answer)
    [text] = await ask(raw, "robot/estop", b"\xc1")
    assert isinstance(text, str)
    assert text.startswith("not a valid EstopRequest: ")
    [reply] = await ask(raw, "robot/estop")
    assert isinstance(reply, bytes)
    assert not bus.failed.done()
