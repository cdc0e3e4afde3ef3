"""Parameters of all processes, of which some do not answer at times."""

import asyncio

import pytest

from gigabrain_schemas.requests import Param, ParamReply, ParamRequest
from gigabrain_schemas.topics import PARAM
from gigabrain_zenoh.client import requests
from gigabrain_zenoh.client.requests import ParamTable
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.testing.in_memory import Net


def margin(value: str) -> tuple[Param, ...]:
    return (Param(name="stop_margin", value=value, expected="a number"),)


@pytest.mark.parametrize("trouble", ["silent", "busy"])
async def test_a_process_without_an_answer_keeps_its_parameters(
    trouble: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(requests, "ANSWER_S", 0.05)
    net, troubles, value = Net(), list[str](), "0.08"

    async def driver(_: ParamRequest) -> ParamReply:
        if "silent" in troubles:
            await asyncio.sleep(9.0)
        if "busy" in troubles:
            raise Refused("busy; try again")
        return ParamReply(ok=True, text="", params=margin(value))

    async def decision(_: ParamRequest) -> ParamReply:
        return ParamReply(ok=True, text="", params=margin("0.3"))

    net.two.serve(PARAM, driver, name="driver")
    net.two.serve(PARAM, decision, name="decision")
    table = ParamTable(net.one, lambda: ("driver", "decision", "router"))
    found = {"decision": margin("0.3"), "driver": margin("0.08"), "router": ()}
    assert await table.read() == found
    value = "0.12"
    troubles.append(trouble)
    assert await table.read() == found
    troubles.clear()
    assert await table.read() == found | {"driver": margin("0.12")}
