"""Decision: what is known becomes what to do, with what is expected to come of it, and why."""

import logging
from collections.abc import Callable, Mapping

from gigabrain_schemas.base import Message
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import Intent, WorldModel
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.topics import BODY, INTENT, SAFETY, STATE, WORLD
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.freshness import PreviousTick
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.decision.behaviours import Plain, Senses
from gigabrain_zenoh.geometry.ages import scan_limit_ns
from gigabrain_zenoh.runtime.heartbeat import Progress

log = logging.getLogger(__name__)


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
        """Go by other settings from now on; the behaviour keeps what it remembers."""
        self._config = config
        self._behaviour.configure(config)

    @property
    def params(self) -> Mapping[str, str]:
        """The settings that may change while it runs, and what is expected of each."""
        return self._load.PARAMS

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
        for name in behaviours.unread(config):
            log.warning("%s has no effect: behaviour %s does not read it", name, config.behaviour)
        _think(config, bus, senses)
        ready()
        await bus.failed
    finally:
        await senses.close()


def _think(config: DecisionConfig, bus: Bus, senses: Senses) -> None:
    thinker, said, too_old = Thinker(config, senses), "", 0
    for name, expected in thinker.params.items():
        bus.params.add_field(name, expected, lambda: thinker.config, thinker.configure)
    verdicts: PreviousTick[SafetyState] = PreviousTick()

    def newest_world() -> WorldModel | None:
        body = bodies.current
        return worlds.fresh(scan_limit_ns(body.description) if body else None)

    def decide(_: Message) -> None:
        nonlocal said
        state = states.fresh()
        if state is None:
            return
        senses.see(state)
        verdict = verdicts.at(state.boot, state.tick, SAFETY.stale_after_ns)
        thinker.think(state, newest_world(), verdict)
        intent = thinker.intent
        bus.publish(INTENT, intent, basis=thinker.basis)
        phrase = intent.reason.partition(":")[0]
        if phrase != said:
            said = phrase
            data = {"event": "decision", "tick": state.tick, "reason": intent.reason}
            log.info("%s", intent.reason, extra={"data": data})

    def see(world: WorldModel) -> None:
        nonlocal too_old
        too_old += newest_world() is None  # over a slow link: looked at, and refused
        if world.basis <= bus.time.tick:
            decide(world)

    def came() -> tuple[object, ...]:
        return bus.arrived.get(STATE.key), bus.arrived.get(WORLD.key)

    bodies = bus.latest(BODY)
    states = bus.latest(STATE, decide)
    worlds = bus.latest(WORLD, see)
    bus.latest(SAFETY, verdicts.receive)
    bus.progress = Progress(came, lambda: () if senses.hung else (thinker.basis, too_old))
