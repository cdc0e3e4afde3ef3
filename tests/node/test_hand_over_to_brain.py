"""Hand-over from operator to brain: older teleop messages do not keep the brain from driving."""

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

BRAIN_ENABLED = GateStatus(mode="enabled", commander="control", enables=1)
HANDED_BACK = GateStatus(mode="enabled", commander="control", enables=2)
TELEOP_TWIST = Twist(linear_x=0.1)
OPERATOR_TICKS = 60
MAX_TRANSIT_TICKS = 12  # 240 ms, longer than a stream counts after its last message


async def speed_after_hand_over(
    chain: Chain, *, echo: bool, speed: float, sent: int, late: int
) -> float:
    """Return the forward speed one second after a hand-over [m/s].

    The operator's last message is sent `sent` ticks before the hand-over, and arrives `late`
    ticks after that.
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
        gate = HANDED_BACK if tick >= hand_over else BRAIN_ENABLED
        speeds = await chain.go(1, v=0.2, gate=gate)
    return speeds[-1]


@pytest.mark.parametrize("echo", [True, False])
@pytest.mark.parametrize("speed", [0.0, 0.1])
async def test_a_teleop_message_sent_before_the_hand_over_never_stops_the_brain(
    speed: float, echo: bool
) -> None:
    stopped_brain = []
    for sent, late in itertools.product((1, 2, 6, 10), range(MAX_TRANSIT_TICKS + 1)):
        async with Chain() as chain:
            if (
                await speed_after_hand_over(chain, echo=echo, speed=speed, sent=sent, late=late)
                < 0.15
            ):
                stopped_brain.append((sent, late))
    assert stopped_brain == []


@pytest.mark.parametrize("echo", [True, False])
async def test_an_operator_who_still_steers_after_the_hand_over_keeps_the_body(echo: bool) -> None:
    async with Chain() as chain:
        chain.send(BODY, body())
        for tick in range(1, 120):
            twist = Twist(linear_x=-0.1, boot=BOOT if echo else 0, tick=tick if echo else 0)
            gate = HANDED_BACK if tick >= 61 else BRAIN_ENABLED
            speeds = await chain.go(1, v=0.2, gate=gate, teleop=twist)
        chain.sent(CMD_VEL)
        chain.send(STATE, state(120, gate=HANDED_BACK))
        (command,) = chain.sent(CMD_VEL)
    assert speeds[-1] == pytest.approx(-0.1)
    assert command.operator


async def test_commands_have_a_flag_that_an_operator_drives() -> None:
    async with Chain() as chain:
        chain.send(BODY, body())
        operator_flags = []
        for gate, teleop in (
            (BRAIN_ENABLED, None),
            (BRAIN_ENABLED, TELEOP_TWIST),
            (BRAIN_ENABLED, None),
            (HANDED_BACK, None),
        ):
            await chain.go(40, v=0.2, gate=gate, teleop=teleop)
            chain.send(STATE, state(chain.tick, gate=gate))
            operator_flags.append(chain.sent(CMD_VEL)[-1].operator)
    assert operator_flags == [False, True, True, False]


def publish_gate(page: SteeredPage, enables: int) -> None:
    gate = GateStatus(mode="enabled", commander="control", enables=enables)
    page.net.two.publish(STATE, state(10, gate=gate))


@pytest.mark.parametrize("ending", ["lets go", "leaves", "is cut off"])
async def test_a_viewer_that_ends_after_the_hand_over_sends_no_more_velocity(
    ending: str,
) -> None:
    page = SteeredPage()
    publish_gate(page, enables=1)
    await settle()
    for at_s in (1.0, 1.1, 1.2):
        page.arbiter.drive(page.one, Velocity(linear_x=0.1), at_s)
    publish_gate(page, enables=2)
    await settle()
    if ending == "lets go":
        page.arbiter.drive(page.one, ZERO, 1.25)
    elif ending == "leaves":
        page.arbiter.leave(page.one)
    else:
        page.arbiter.clear()
    await settle()
    assert page.speeds == [0.1, 0.1]
    assert page.arbiter.driving(1.26) == 0
