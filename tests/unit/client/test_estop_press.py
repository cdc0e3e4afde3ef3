"""The e-stop is pressed again until a body has confirmed it, and never called confirmed before."""

import asyncio
import re
import time

import pytest

from gigabrain_schemas.body import GateStatus
from gigabrain_schemas.requests import EstopRequest, GateReply
from gigabrain_schemas.topics import ESTOP
from gigabrain_zenoh.client.requests import press_estop
from gigabrain_zenoh.errors import NotConfirmed, Refused
from gigabrain_zenoh.testing.in_memory import Net

LATCHED = GateReply(ok=True, text="stopped", robot_type="mock", gate=GateStatus(mode="latched"))
OPEN = GateReply(ok=True, text="what?", robot_type="mock", gate=GateStatus(mode="enabled"))


class Driver:
    """Answers as told, one entry per request; None for never. Then it stays silent."""

    def __init__(self, net: Net, *answers: GateReply | str | None) -> None:
        self.answers, self.asked = list(answers), list[EstopRequest]()
        net.one.serve(ESTOP, self._answer)

    async def _answer(self, request: EstopRequest) -> GateReply:
        self.asked.append(request)
        answer = self.answers.pop(0) if self.answers else None
        if answer is None:
            await asyncio.sleep(60)
        if isinstance(answer, str):
            raise Refused(answer)
        assert answer is not None
        return answer


async def test_the_first_confirmation_ends_it() -> None:
    net = Net()
    driver = Driver(net, LATCHED)
    assert await press_estop(net.two, "a child") == LATCHED
    assert driver.asked == [EstopRequest(source="two", reason="a child")]


@pytest.mark.parametrize(
    ("reason", "sent"),
    [
        ("x" * 100_000, "x" * 500),
        ("人" * 500, "人" * 166),  # 500 bytes of 3 for each
        ("\udcff is no text", "? is no text"),
        (ValueError("a wheel slips"), "a wheel slips"),
    ],
)
async def test_no_reason_that_a_script_gives_keeps_the_robot_from_stopping(
    reason: str, sent: str
) -> None:
    net = Net()
    driver = Driver(net, LATCHED)
    script = net.bus("人" * 100)
    assert await press_estop(script, reason) == LATCHED
    assert driver.asked == [EstopRequest(source="人" * 64, reason=sent)]


async def test_a_lost_request_is_repeated() -> None:
    net = Net()
    driver = Driver(net, None, None, LATCHED)
    assert await press_estop(net.two) == LATCHED
    assert len(driver.asked) == 3


async def test_an_answer_from_a_gate_that_is_not_latched_confirms_nothing() -> None:
    net = Net()
    Driver(net, OPEN, "not now", LATCHED)
    assert await press_estop(net.two) == LATCHED


@pytest.mark.long
@pytest.mark.parametrize(
    ("answers", "why"), [((), "no driver answers"), (("its disk",) * 9, "its disk")]
)
async def test_what_nobody_confirms_says_what_a_person_has_to_do(
    answers: tuple[str, ...], why: str
) -> None:
    net = Net()
    driver = Driver(net, *answers)
    text = f"NOT CONFIRMED: {why}; press the hardware e-stop or cut the robot's power"
    with pytest.raises(NotConfirmed, match=f"^{re.escape(text)}$") as error:
        await press_estop(net.two, within_s=0.4)
    assert error.value.exit_code == 3
    assert 2 <= len(driver.asked) <= 6  # after 150 ms, and then every 50


def hold_up(seconds: float) -> None:
    """Hold up the whole process, as a machine does that stands still."""
    time.sleep(seconds)


async def test_what_was_confirmed_while_the_presser_itself_was_held_up_is_heard() -> None:
    net = Net()

    async def slow(_: EstopRequest) -> GateReply:
        await asyncio.sleep(0.01)
        return LATCHED

    net.one.serve(ESTOP, slow)
    pressed = asyncio.create_task(press_estop(net.two, within_s=0.05))
    for _ in range(5):  # the request is on its way
        await asyncio.sleep(0)
    hold_up(0.1)
    assert await pressed == LATCHED


async def test_where_nobody_is_at_all_it_is_not_confirmed_either() -> None:
    with pytest.raises(NotConfirmed):
        await press_estop(Net().two, within_s=0.2)
