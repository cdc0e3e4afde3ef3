"""Decision: what is known becomes what to do, with what is expected to come of it, and why."""

import logging
from collections.abc import Callable

from gigabrain_schemas.base import Message
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import Intent, WorldModel
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.topics import BODY, INTENT, SAFETY, STATE, WORLD
from gigabrain_zenoh import behaviours
from gigabrain_zenoh.ages import scan_limit_ns
from gigabrain_zenoh.behaviours import Plain, Senses
from gigabrain_zenoh.bus import Bus
from gigabrain_zenoh.earlier import Earlier
from gigabrain_zenoh.settings import DecisionConfig

log = logging.getLogger(__name__)

CHANGEABLE = {  # while it runs, and what is expected
    "linear_speed": "a number above 0, up to 10 [m/s]; the body's own limit holds as well",
    "angular_speed": "a number above 0, up to 10 [rad/s]; the body's own limit holds as well",
    "turn": "one of: right, left, clearer",
}


class Thinker:
    """Thinks once per world, and stands by its word in between.

    A world of a tick whose state is still on its way waits for that state: no outcome may depend on
    which of two messages was quicker.
    """

    def __init__(self, config: DecisionConfig, senses: Senses | None = None) -> None:
        self._load, self._config = behaviours.load(config.behaviour), config
        self._senses = senses or Plain()
        self._behaviour, self._boot = self._load(config), 0
        self.intent = Intent(behaviour=config.behaviour, reason="starting")
        self.basis = 0

    @property
    def config(self) -> DecisionConfig:
        """The settings that it goes by."""
        return self._config

    def configure(self, config: DecisionConfig) -> None:
        """Go by other settings from now on. The behaviour begins anew."""
        self._config, self._behaviour = config, self._load(config)

    def think(
        self,
        state: RobotState,
        world: WorldModel | None,
        verdict: SafetyState | None = None,
    ) -> None:
        """Form a new intent if there is anything new to go by."""
        if state.boot != self._boot:  # the driver has started anew, and with it the odometry
            self._behaviour, self._boot, self.basis = self._load(self._config), state.boot, 0
        if world is not None:
            if world.basis == self.basis or world.basis > state.tick:
                return
            self.basis = world.basis
        situation = self._senses.situation(state, world, verdict)
        self.intent = self._behaviour.step(situation)
        self._senses.heed(self._behaviour)


async def run(config: DecisionConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """An intent per world, as soon as it comes; repeated with the newest tick at each state."""
    senses = behaviours.senses(config, bus)
    try:
        await senses.warm_up()
        _think(config, bus, senses)
        ready()
        await bus.failed
    finally:
        await senses.close()


def _think(config: DecisionConfig, bus: Bus, senses: Senses) -> None:
    thinker, said = Thinker(config, senses), ""
    for name, expected in CHANGEABLE.items():
        bus.params.add_field(name, expected, lambda: thinker.config, thinker.configure)
    verdicts: Earlier[SafetyState] = Earlier()

    def decide(_: Message) -> None:
        nonlocal said
        state = states.fresh()
        if state is None:
            return
        senses.see(state)
        body = bodies.current
        world = worlds.fresh(scan_limit_ns(body.description) if body else None)
        verdict = verdicts.at(state.boot, state.tick, SAFETY.stale_after_ns)
        thinker.think(state, world, verdict)
        intent = thinker.intent
        bus.publish(INTENT, intent, basis=thinker.basis)
        phrase = intent.reason.partition(":")[0]
        if phrase != said:
            said = phrase
            data = {"event": "decision", "tick": state.tick, "reason": intent.reason}
            log.info("%s", intent.reason, extra={"data": data})

    def see(world: WorldModel) -> None:
        if world.basis <= bus.time.tick:
            decide(world)

    bodies = bus.latest(BODY)
    states = bus.latest(STATE, decide)
    worlds = bus.latest(WORLD, see)
    bus.latest(SAFETY, verdicts.receive)
