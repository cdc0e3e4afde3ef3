import asyncio

import msgspec
import pytest

from gigabrain_schemas.body import GateStatus
from gigabrain_schemas.examples import example
from gigabrain_schemas.requests import (
    DescribeRequest,
    Description,
    EstopRequest,
    GateReply,
    ReleaseRequest,
)
from gigabrain_schemas.topics import DESCRIBE, ESTOP, RELEASE
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.testing.in_memory import Net

REPLY = GateReply(ok=True, text="stopped", robot_type="mock", gate=GateStatus())


@pytest.fixture
async def net() -> Net:
    return Net()


async def test_a_question_gets_its_answer(net: Net) -> None:
    asked: list[EstopRequest] = []

    async def answer(request: EstopRequest) -> GateReply:
        asked.append(request)
        return REPLY

    net.one.serve(ESTOP, answer)
    assert await net.two.ask(ESTOP, EstopRequest(source="operator")) == [REPLY]
    assert asked == [EstopRequest(source="operator")]
    assert net.one.received["robot/estop"] == 1


async def test_a_question_that_nobody_serves_has_no_answer(net: Net) -> None:
    assert await net.two.ask(ESTOP, EstopRequest()) == []


async def test_all_who_serve_a_question_answer_it(net: Net) -> None:
    async def answer(_: EstopRequest) -> GateReply:
        return REPLY

    net.one.serve(ESTOP, answer)
    net.two.serve(ESTOP, answer)
    assert await net.bus("three").ask(ESTOP, EstopRequest()) == [REPLY, REPLY]


async def test_an_empty_question_is_one_of_nothing_but_defaults(net: Net) -> None:
    asked: list[EstopRequest] = []

    async def answer(request: EstopRequest) -> GateReply:
        asked.append(request)
        return REPLY

    net.one.serve(ESTOP, answer)
    raw = net.network.transport()
    for payload in (b"", b"{}", b"\x80"):
        replies = await raw.query("robot/estop", payload, "", 1.0, "data")
        assert replies == [msgspec.msgpack.encode(REPLY)]
    assert asked == [EstopRequest()] * 3


async def test_a_question_that_is_garbage_is_refused_with_a_text(net: Net) -> None:
    async def answer(_: ReleaseRequest) -> GateReply:
        return REPLY

    net.one.serve(RELEASE, answer)
    raw = net.network.transport()
    for payload, text in (
        (b"", "Object missing required field `estop_generation`"),
        (b"\xc1", "MessagePack data is malformed: invalid opcode '\\xc1' (byte 0)"),
        (bytes(65537), "65537 bytes, at most 65536 are read"),
    ):
        assert await raw.query("robot/release", payload, "", 1.0, "data") == [
            f"not a valid ReleaseRequest: {text}"
        ]
    assert net.one.rejected["robot/release"] == 3
    assert not net.one.failed.done()


async def test_a_refusal_travels_with_its_reason(net: Net) -> None:
    async def answer(_: EstopRequest) -> GateReply:
        raise Refused("the body is moving")

    net.one.serve(ESTOP, answer)
    with pytest.raises(Refused, match=r"^the body is moving$"):
        await net.two.ask(ESTOP, EstopRequest())
    assert not net.one.failed.done()


async def test_an_exception_in_an_answer_ends_its_process_and_the_asker_is_told(net: Net) -> None:
    async def answer(_: EstopRequest) -> GateReply:
        raise ZeroDivisionError("by nothing")

    net.one.serve(ESTOP, answer)
    with pytest.raises(Refused, match=r"^one failed: ZeroDivisionError\('by nothing'\)$"):
        await net.two.ask(ESTOP, EstopRequest())
    with pytest.raises(ZeroDivisionError):
        await net.one.failed
    assert not net.two.failed.done()


async def test_an_answer_that_comes_too_late_is_none(net: Net) -> None:
    async def answer(_: EstopRequest) -> GateReply:
        await asyncio.sleep(60)
        return REPLY

    net.one.serve(ESTOP, answer)
    assert await net.two.ask(ESTOP, EstopRequest(), timeout_s=0.01) == []


async def test_an_answer_that_is_garbage_is_dropped_and_counted(net: Net) -> None:
    async def answer(_: bytes) -> tuple[bytes, str]:
        return b"\xc1", ""

    net.network.transport().serve("robot/estop", answer)
    assert await net.two.ask(ESTOP, EstopRequest()) == []
    assert net.two.rejected["robot/estop"] == 1


async def test_one_process_may_be_asked_or_all_of_them(net: Net) -> None:
    description = example(Description)

    async def answer(_: DescribeRequest) -> Description:
        return description

    net.one.serve(DESCRIBE, answer, name="driver")
    net.two.serve(DESCRIBE, answer, name="control")
    ask = DescribeRequest()
    assert len(await net.one.ask(DESCRIBE, ask, name="control")) == 1
    assert len(await net.one.ask(DESCRIBE, ask, name="*")) == 2
    assert await net.one.ask(DESCRIBE, ask, name="safety") == []
