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


class Late:
    """Answers after a minute."""

    def __init__(self) -> None:
        self.began = asyncio.Event()

    async def answer(self, _: bytes) -> tuple[bytes, str]:
        self.began.set()
        await asyncio.sleep(60)
        return b"", ""

    async def asked_by(self, asker: ZenohTransport) -> "asyncio.Future[list[bytes | str]]":
        """A question of `asker` that has come here and waits for its answer."""
        async with asyncio.timeout(30):
            while True:
                asking = asyncio.ensure_future(asker.query("robot/goal", b"", "", 60.0, "data"))
                begun = asyncio.ensure_future(self.began.wait())
                await asyncio.wait((asking, begun), return_when=asyncio.FIRST_COMPLETED)
                if not asking.done():
                    return asking
                begun.cancel()  # asked before the server was known


async def ask(
    transport: ZenohTransport, key: str, payload: bytes = b"", wanted: int = 1
) -> list[bytes | str]:
    """Ask until as many as wanted are known to the network and have answered."""
    async with asyncio.timeout(30):
        while True:
            replies = await transport.query(key, payload, "", 5.0, "data")
            if len(replies) == wanted:
                return replies


async def test_a_query_has_its_answer(net: ZenohNetwork) -> None:
    server, asker = await net.client(), await net.client()
    server.serve("robot/goal", echo)
    assert await ask(asker, "robot/goal", b"abc") == [b"cba"]
    assert await ask(asker, "robot/goal") == [b""]
    assert await ask(asker, "robot/goal", bytes(64 * 1024)) == [bytes(64 * 1024)]


async def test_a_kept_value_of_a_megabyte_is_answered_whole(net: ZenohNetwork) -> None:
    async def answer(_: bytes) -> tuple[bytes, str]:
        return bytes(range(256)) * 4096, ""

    server, asker = await net.client(), await net.client()
    server.serve("robot/map", answer)
    assert await ask(asker, "robot/map") == [bytes(range(256)) * 4096]


async def test_a_refusal_is_a_text(net: ZenohNetwork) -> None:
    server, asker = await net.client(), await net.client()
    server.serve("robot/goal", refuse)
    assert await ask(asker, "robot/goal", b"now") == ["not now: ümläut"]


async def test_a_query_that_nobody_serves_has_no_answer(net: ZenohNetwork) -> None:
    asker = await net.client()
    assert await asker.query("robot/goal", b"", "", 30.0, "data") == []


async def test_an_answer_that_is_late_is_none(net: ZenohNetwork) -> None:
    late = Late()
    server, asker = await net.client(), await net.client()
    server.serve("robot/goal", late.answer)
    while not late.began.is_set():
        assert await asker.query("robot/goal", b"", "", 0.2, "data") == []


async def test_all_who_serve_a_key_answer(net: ZenohNetwork) -> None:
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


async def test_who_serves_no_more_does_not_answer(net: ZenohNetwork) -> None:
    server, asker = await net.client(), await net.client()
    close = server.serve("robot/goal", echo)
    server.serve("robot/mission", echo)
    await ask(asker, "robot/goal", b"ab")
    close()
    close()
    await ask(asker, "robot/mission", b"ab")
    assert await ask(asker, "robot/goal", b"ab", 0) == []


async def test_an_asker_gets_nothing_at_once_when_the_server_leaves(net: ZenohNetwork) -> None:
    late = Late()
    server, asker = await net.client(), await net.client()
    server.serve("robot/goal", late.answer)
    asking = await late.asked_by(asker)
    await server.close()
    async with asyncio.timeout(20):  # less than the asker's own patience
        assert await asking == []


async def test_an_asker_that_leaves_does_not_wait(net: ZenohNetwork) -> None:
    server, asker = await net.client(), await net.client()
    late = Late()
    server.serve("robot/goal", late.answer)
    asking = await late.asked_by(asker)
    await asker.close()
    async with asyncio.timeout(10):
        assert await asking == []


async def test_an_asker_that_is_cancelled_leaves_nothing_behind(net: ZenohNetwork) -> None:
    server, asker = await net.client(), await net.client()
    late = Late()
    server.serve("robot/goal", late.answer)
    asking = await late.asked_by(asker)
    asking.cancel()
    with pytest.raises(asyncio.CancelledError):
        await asking
    server.serve("robot/mission", echo)
    assert await ask(asker, "robot/mission", b"ab") == [b"ba"]


async def test_a_question_on_the_bus_crosses_zenoh_and_so_does_its_answer(
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


async def test_garbage_is_refused_over_zenoh_in_words(net: ZenohNetwork) -> None:
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
