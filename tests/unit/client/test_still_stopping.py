"""A script whose newest state is older than the gate's answer waits for the gate all the same."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import pytest
from msgspec.structs import replace

from gigabrain_schemas.body import GateMode, GateStatus, RobotState
from gigabrain_schemas.examples import example
from gigabrain_schemas.requests import GateReply
from gigabrain_schemas.topics import ENABLE, RELEASE, STATE
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.testing.in_memory import Net

Asks = Callable[[Robot], Awaitable[GateReply]]
REQUESTS: tuple[Asks, ...] = (lambda robot: robot.enable(), lambda robot: robot.release())


class Gate:
    """Says in its states that it is `shown`, and in its answers what it is by then."""

    def __init__(self, net: Net, shown: GateMode, *answers: GateReply) -> None:
        self.answers, self.asked = list(answers), 0
        self._bus, self._shown = net.one, shown
        net.one.serve(ENABLE, self._answer)
        net.one.serve(RELEASE, self._answer)

    async def _answer(self, _request: Any) -> GateReply:
        self.asked += 1
        return self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]

    @contextlib.asynccontextmanager
    async def states(self) -> AsyncIterator[None]:
        """Publish states meanwhile."""

        async def publish() -> None:
            while True:
                gate = GateStatus(mode=self._shown)
                self._bus.publish(STATE, replace(example(RobotState), gate=gate))
                await asyncio.sleep(0)

        task = asyncio.ensure_future(publish())
        yield
        task.cancel()


def answer(mode: GateMode, *, ok: bool) -> GateReply:
    return GateReply(ok=ok, text="a reason", robot_type="mock", gate=GateStatus(mode=mode))


@pytest.mark.parametrize("ask", REQUESTS)
async def test_it_asks_again_while_the_gate_answers_that_it_stops(ask: Asks) -> None:
    net = Net()
    gate = Gate(net, "enabled", *[answer("stopping", ok=False)] * 3, answer("idle", ok=True))
    robot = Robot(net.two)
    async with gate.states():
        assert (await ask(robot)).gate.mode == "idle"
    assert gate.asked == 4


@pytest.mark.parametrize("ask", REQUESTS)
@pytest.mark.parametrize(("mode", "asked"), [("latched", 1), ("stopping", 51)])
async def test_any_other_refusal_and_the_last_one_are_raised(
    ask: Asks, mode: GateMode, asked: int
) -> None:
    net = Net()
    gate, robot = Gate(net, "enabled", answer(mode, ok=False)), Robot(net.two)
    async with gate.states():
        with pytest.raises(Refused, match="mock: a reason"):
            await ask(robot)
    assert gate.asked == asked
