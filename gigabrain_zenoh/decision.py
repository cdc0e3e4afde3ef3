"""Decision: what is known becomes what to do, with what is expected to come of it, and why."""

import logging
from collections.abc import Callable

from gigabrain_schemas.base import Message
from gigabrain_schemas.brain import Intent
from gigabrain_schemas.topics import INTENT, STATE, WORLD
from gigabrain_zenoh import behaviours
from gigabrain_zenoh.behaviours import Situation
from gigabrain_zenoh.bus import Bus
from gigabrain_zenoh.settings import DecisionConfig

log = logging.getLogger(__name__)


async def run(config: DecisionConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """An intent per world, as soon as it comes; repeated with the newest tick at each state."""
    behaviour = behaviours.load(config.behaviour)(config)
    intent, basis, said = Intent(behaviour=config.behaviour, reason="starting"), 0, ""

    def decide(_: Message) -> None:
        nonlocal intent, basis, said
        state = states.fresh()
        if state is None:
            return
        world = worlds.fresh()
        # a world of a tick whose state is still on its way waits for it: no outcome may depend on
        # which of two messages was quicker
        if world is None:
            intent = behaviour.step(Situation(None, state.pose))
        elif basis != world.basis and world.basis <= state.tick:
            intent, basis = behaviour.step(Situation(world, state.pose)), world.basis
        bus.publish(INTENT, intent, basis=basis)
        phrase = intent.reason.partition(":")[0]
        if phrase != said:
            said = phrase
            data = {"event": "decision", "tick": state.tick, "reason": intent.reason}
            log.info(intent.reason, extra={"data": data})

    states = bus.latest(STATE, decide)
    worlds = bus.latest(WORLD, decide)
    ready()
    await bus.failed
