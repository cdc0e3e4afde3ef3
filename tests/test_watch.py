"""Whoever watches a robot asks again when a question was lost."""

import asyncio

from gigabrain_schemas.requests import DescribeRequest, Description
from gigabrain_schemas.topics import DESCRIBE
from gigabrain_zenoh.watch import Watch
from tests.bus_rig import Net


async def answer(_: DescribeRequest) -> Description:
    return Description(process="driver", pid=7, host="robot", version="1")


async def test_a_process_that_comes_back_in_time_is_heard() -> None:
    net = Net()
    asking = asyncio.ensure_future(Watch(net.one).describe("driver", 20.0))
    await asyncio.sleep(0.15)
    net.two.serve(DESCRIBE, answer, name="driver")
    told = await asking
    assert told
    assert told.pid == 7


async def test_who_never_answers_is_none() -> None:
    assert await Watch(Net().one).describe("driver", 0.15) is None
