"""Handing the body back: what an operator sent before the hand-over does not hold the brain out."""

import itertools

import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import GateStatus
from gigabrain_schemas.brain import Twist
from gigabrain_schemas.topics import BODY, CMD_VEL, STATE, TELEOP
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.testing.samples import BOOT, body, state
from gigabrain_zenoh.testing.waiting import settle
from tests.unit.control.test_control_node import Chain
from tests.unit.ui.test_page_access import SteeredPage

MINE = GateStatus(mode="enabled", commander="control", enables=1)
HANDED_BACK = GateStatus(mode="enabled", commander="control", enables=2)
OPERATES = Twist(linear_x=0.1)
OPERATOR_TICKS = 60
LATEST_TICKS = 12  # 240 ms on the way, longer than a stream is trusted after its last message


async def drives_after(chain: Chain, *, echo: bool, speed: float, sent: int, late: int) -> float:
    """The speed that decision gets one second after a hand-over.

    The operator's last message is sent `sent` ticks before the hand-over and comes `late` ticks
    after that.
    """
    chain.send(BODY, body())
    hand_over = OPERATOR_TICKS + 1
    last = replace(Twist(linear_x=speed), boot=BOOT if echo else 0)
    for tick in range(1, hand_over + 50):
        chain.tick = tick - 1
        operates = tick <= hand_over - sent
        if tick == hand_over - sent + late:
            chain.send(TELEOP, replace(last, tick=hand_over - sent if echo else 0))
        elif operates and tick % 2 == 0:
            chain.send(TELEOP, replace(last, linear_x=0.1, tick=tick - 1 if echo else 0))
        gate = HANDED_BACK if tick >= hand_over else MINE
        speeds = await chain.go(1, v=0.2, gate=gate)
    return speeds[-1]


@pytest.mark.parametrize("echo", [True, False])
@pytest.mark.parametrize("speed", [0.0, 0.1])
async def test_a_last_message_sent_before_the_hand_over_never_holds_the_brain_out(
    speed: float, echo: bool
) -> None:
    held_out = []
    for sent, late in itertools.product((1, 2, 6, 10), range(LATEST_TICKS + 1)):
        async with Chain() as chain:
            if await drives_after(chain, echo=echo, speed=speed, sent=sent, late=late) < 0.15:
                held_out.append((sent, late))
    assert held_out == []


@pytest.mark.parametrize("echo", [True, False])
async def test_an_operator_who_goes_on_after_the_hand_over_keeps_the_body(echo: bool) -> None:
    async with Chain() as chain:
        chain.send(BODY, body())
        for tick in range(1, 120):
            twist = Twist(linear_x=-0.1, boot=BOOT if echo else 0, tick=tick if echo else 0)
            gate = HANDED_BACK if tick >= 61 else MINE
            speeds = await chain.go(1, v=0.2, gate=gate, teleop=twist)
        chain.sent(CMD_VEL)
        chain.send(STATE, state(120, gate=HANDED_BACK))
        (command,) = chain.sent(CMD_VEL)
    assert speeds[-1] == pytest.approx(-0.1)
    assert command.operator


async def test_commands_say_whether_an_operator_has_the_body() -> None:
    async with Chain() as chain:
        chain.send(BODY, body())
        said = []
        for gate, teleop in ((MINE, None), (MINE, OPERATES), (MINE, None), (HANDED_BACK, None)):
            await chain.go(40, v=0.2, gate=gate, teleop=teleop)
            chain.send(STATE, state(chain.tick, gate=gate))
            said.append(chain.sent(CMD_VEL)[-1].operator)
    assert said == [False, True, True, False]


def with_gate(page: SteeredPage, enables: int) -> None:
    gate = GateStatus(mode="enabled", commander="control", enables=enables)
    page.net.two.publish(STATE, state(10, gate=gate))


@pytest.mark.parametrize("last_word", ["lets go", "leaves", "is cut off"])
async def test_a_viewer_that_ends_after_the_body_was_handed_back_says_nothing_more(
    last_word: str,
) -> None:
    page = SteeredPage()
    with_gate(page, enables=1)
    await settle()
    for at_s in (1.0, 1.1, 1.2):
        page.arbiter.drive(page.one, Velocity(linear_x=0.1), at_s)
    with_gate(page, enables=2)
    await settle()
    if last_word == "lets go":
        page.arbiter.drive(page.one, ZERO, 1.25)
    elif last_word == "leaves":
        page.arbiter.leave(page.one)
    else:
        page.arbiter.clear()
    await settle()
    assert page.speeds == [0.1, 0.1]
    assert page.arbiter.driving(1.26) == 0
