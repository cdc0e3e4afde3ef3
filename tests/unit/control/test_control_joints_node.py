"""Control on the bus, for joints: what it sends at each state, and between two of them."""

from typing import Literal

import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import TICK_NS
from gigabrain_schemas.body import Body
from gigabrain_schemas.brain import JointCommand
from gigabrain_schemas.topics import BODY, CMD_VEL, INTENT, JOINT_CMD, STATE
from gigabrain_zenoh.control import node as control
from gigabrain_zenoh.testing.in_memory import NodeBench
from gigabrain_zenoh.testing.samples import BOOT
from tests.unit.control.arm import ArmBench, arm_body, targets

STEPS = 4  # per tick


async def sent_while_moving(
    rate_hz: float, link: Literal["sim", "emulated"], silent_from: int = 100
) -> list[list[JointCommand]]:
    """Return the commands of each of 40 ticks. From tick `silent_from` on, no intent is sent."""
    description = arm_body()
    assert description.arm
    description = replace(description, arm=replace(description.arm, rate_hz=rate_hz))
    arm, found = ArmBench(description), []
    async with NodeBench(control.run) as bench:
        bench.send(BODY, Body(description=description, link=link, boot=BOOT, tick=1))
        for tick in range(1, 41):
            arm.tick = tick
            bench.send(STATE, arm.state())
            if tick < silent_from:
                bench.send(INTENT, replace(targets(pan=1.0), boot=BOOT, tick=tick, basis=tick))
            for _ in range(STEPS):
                await bench.clock.advance(TICK_NS // STEPS)
            found.append(bench.sent(JOINT_CMD))
            arm.obey(found[-1][-1])
        assert bench.sent(CMD_VEL) == []
    return found


async def test_one_command_a_state_rests_on_its_tick() -> None:
    found = await sent_while_moving(50.0, "emulated")
    assert [len(commands) for commands in found] == [1] * 40
    assert [commands[0].basis for commands in found] == list(range(1, 41))
    assert found[-1][0].position[0] > 0.3


@pytest.mark.parametrize(("rate_hz", "count"), [(100.0, 2), (200.0, 4)])
async def test_an_arm_with_a_higher_rate_gets_commands_between_two_states(
    rate_hz: float, count: int
) -> None:
    found = await sent_while_moving(rate_hz, "emulated")
    assert len(found[5]) == 1  # at rest
    places = [command.position[0] for command in found[20]]
    assert len(places) == count
    assert places == sorted(set(places))
    assert len({command.seq for command in found[20]}) == count
    ahead = places[0] + found[20][0].velocity[0] * 0.02 * (count - 1) / count
    assert places[-1] == pytest.approx(ahead)


async def test_a_simulation_gets_one_command_for_each_of_its_ticks() -> None:
    assert {len(commands) for commands in await sent_while_moving(200.0, "sim")} == {1}


async def test_joints_come_to_rest_from_the_third_tick_without_an_intent() -> None:
    moving = [one[0] for one in await sent_while_moving(50.0, "emulated")]
    braking = [one[0] for one in await sent_while_moving(50.0, "emulated", silent_from=15)]
    assert braking[:16] == moving[:16]
    assert moving[16].velocity[0] > 0.5
    assert {(one.position, one.velocity) for one in braking[16:]} == {((), (0.0, 0.0))}


async def test_an_arm_whose_joints_are_missing_leaves_control_healthy() -> None:
    """As before the supply of its servos is switched on."""
    arm, made = ArmBench(), []
    async with NodeBench(control.run) as bench:
        bench.send(BODY, Body(description=arm.body, link="real", boot=BOOT, tick=1))
        for missing in (True, True, False, False):
            arm.missing = missing
            for _ in range(50):
                arm.tick += 1
                bench.send(STATE, arm.state())
            made.append((bench.bus.progress(), bool(bench.sent(JOINT_CMD))))
    assert made == [(True, False)] * 2 + [(True, True)] * 2
