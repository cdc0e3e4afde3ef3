"""`gigabrain param`, where a process of the robot refuses to answer."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import pytest
from msgspec.structs import replace

from gigabrain_schemas.examples import example
from gigabrain_schemas.requests import (
    DescribeRequest,
    Description,
    Param,
    ParamReply,
    ParamRequest,
)
from gigabrain_schemas.topics import DESCRIBE, PARAM
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.cli import node
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.testing.in_memory import Net

MARGIN = Param(name="stop_margin", value="0.08", expected="a number")


@pytest.fixture(autouse=True)
def robot(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot of which one process is busy, and the one after it is not."""

    async def run(do: Callable[[Bus], Awaitable[Any]]) -> Any:
        net = Net()
        serve(net, "decision", busy=True)
        serve(net, "driver", busy=False)
        return await do(net.one)

    monkeypatch.setattr(node, "on_bus", lambda _at, do: asyncio.run(run(do)))


def serve(net: Net, process: str, *, busy: bool) -> None:
    """Answer as a process with one parameter."""

    async def describe(_: DescribeRequest) -> Description:
        return replace(example(Description), process=process)

    async def answer(_: ParamRequest) -> ParamReply:
        if busy:
            raise Refused("busy; try again")
        return ParamReply(ok=True, text="", params=(MARGIN,))

    net.two.serve(DESCRIBE, describe, name=process)
    net.two.serve(PARAM, answer, name=process)


def test_a_process_that_refuses_does_not_hide_the_others(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert node.list_params() == 1
    out, err = capsys.readouterr()
    assert out.split() == ["driver", "stop_margin", "0.08", "a", "number"]
    assert err == "decision: busy; try again\n"


def test_a_list_without_refusals_is_a_success(capsys: pytest.CaptureFixture[str]) -> None:
    assert node.list_params("driver") == 0
    assert capsys.readouterr().err == ""


def test_a_refusal_to_tell_one_parameter_names_the_process() -> None:
    with pytest.raises(Refused, match=r"^decision: busy; try again$"):
        node.get_param("decision", "stop_margin")
