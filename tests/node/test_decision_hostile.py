"""Extreme messages to decision: it limits their speeds, and still reaches its goal."""

import msgspec

from gigabrain_schemas import topics
from gigabrain_schemas.base import Message, Velocity
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.tasks import GoalRequest
from gigabrain_schemas.topics import BODY, CMD_VEL, GOAL
from gigabrain_zenoh import codec
from gigabrain_zenoh.decision.context import ContextSource
from gigabrain_zenoh.decision.zones import ZoneSource
from gigabrain_zenoh.qa.faults.hostile import chosen_extremes
from gigabrain_zenoh.testing.in_memory import Net
from gigabrain_zenoh.testing.samples import body, state
from gigabrain_zenoh.testing.waiting import settle
from tests.node.plane import ROOM, Plane, as_map, drawn


async def test_decision_clamps_the_sent_commands_as_the_gate_does() -> None:
    net = Net()
    source = ContextSource(net.two, ZoneSource(net.two))
    for bus in (net.one, net.two):
        bus.time.observe(state(10))
    net.one.publish(BODY, body())
    await settle()
    source.observe(state(10))
    net.one.publish(CMD_VEL, CmdVel(linear_x=90.0, angular_z=-90.0, source="control"))
    net.one.publish(CMD_VEL, CmdVel(linear_x=-90.0, source="stranger"))
    await settle()
    source.observe(state(11))
    context = source.at_scan(state(11), None, None)
    assert [(one.tick, one.velocity) for one in context.sent] == [
        (10, Velocity(linear_x=0.26, angular_z=-1.82))
    ]


def plausible_message(plane: Plane, topic: object) -> Message | None:
    """Return the robot's map, state or body at this tick; None for other topics."""
    match topic:
        case topics.MAP:
            return as_map(plane.known, plane.tick, plane.boot)
        case topics.STATE:
            return state(plane.tick, boot=plane.boot)
        case topics.BODY:
            return body(boot=plane.boot)
        case _:
            return None


async def test_decision_survives_extreme_messages_and_reaches_its_goal_afterwards() -> None:
    received = (BODY, topics.MAP, topics.STATE, topics.WORLD, topics.POSE, CMD_VEL, topics.SAFETY)
    async with Plane(drawn(ROOM)) as plane:
        await plane.go(0.2)
        await plane.ask_at_once(GOAL, GoalRequest(x=4.0, y=0.8))
        for case in (one for one in chosen_extremes() if one.to in received):
            own = plausible_message(plane, case.to)
            base = msgspec.msgpack.decode(codec.encode(own)) if own else None
            header = {"boot": plane.boot, "tick": plane.tick, "basis": plane.tick}
            plane.bench.network.deliver(case.key, case.payload(base, header))
            before, plane.maps_sent = plane.intent, False
            await plane.go(0.1)
            assert not plane.bench.bus.failed.done(), (case, plane.bench.bus.failed.exception())
            assert plane.intent is not before, case
        await plane.go(1.2)
        await plane.ask_at_once(GOAL, GoalRequest(x=4.0, y=0.8))
        await plane.until("succeeded", seconds=60.0)
