"""Decision node: steps the configured behaviour once per world model, and publishes intents."""

import asyncio
import logging
from collections.abc import Callable
from typing import Any

from gigabrain_schemas.base import Message
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import Intent, WorldModel
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.topics import BODY, INTENT, SAFETY, STATE, WORLD
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.freshness import PreviousTick
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.decision.behaviours import Behaviour, Inputs, StepResult, battery_nearly_empty
from gigabrain_zenoh.decision.contours import ContourFilter
from gigabrain_zenoh.decision.detected_objects import DetectedObjects, ObjectsByPerceptor
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.stopping import scan_limit_ns
from gigabrain_zenoh.runtime.heartbeat import Progress

NO_OBJECTS: ObjectsByPerceptor = {}
NO_BASE = "idle: the body has no base to drive"
log = logging.getLogger(__name__)

SETTINGS_KEY = "decision.settings"  # place of a behaviour's settings in a deployment file
RENAMED_PARAMS = {  # old to new name, by behaviour; remove in 0.3 together with config/renames.py
    "avoid": {"linear_speed": "max_linear_speed", "angular_speed": "max_angular_speed"},
    "navigate": {"speed_limit": "max_linear_speed"},
}


class InputSource:
    """Collects inputs and steps a behaviour: here with world model and odometry only."""

    moves_arms = False

    async def prepare(self) -> None:
        """Prepare what the first step needs."""

    async def finish_preparing(self) -> None:
        """Wait for slow preparations. Raises their errors."""

    def configure(self, config: Any) -> None:
        """Replace the settings."""

    def observe(self, state: RobotState) -> None:
        """Record a robot state; called with every state."""

    def step(
        self,
        behaviour: Behaviour,
        state: RobotState,
        world: WorldModel | None,
        verdict: SafetyState | None,
        objects: ObjectsByPerceptor,
    ) -> StepResult:
        """Step the behaviour once with the current inputs."""
        must_charge = battery_nearly_empty(verdict)
        return behaviour.step(
            Inputs(world=world, pose=state.pose, must_charge=must_charge, objects=objects)
        )

    @property
    def hung(self) -> bool:
        """Return whether a worker thread will never finish, although the node still runs."""
        return False

    async def close(self) -> None:
        """Wait until everything is written."""


class DecisionLoop:
    """Steps the behaviour once per world model, and keeps its intent until the next one.

    A world model waits for the state of the same tick, so they can arrive in either order.
    """

    def __init__(self, config: DecisionConfig, source: InputSource | None = None) -> None:
        self._name, self._type = config.behaviour, behaviours.load(config.behaviour)
        self._settings = behaviours.settings_of(config)
        self._source = source or InputSource()
        self._behaviour, self._boot = self._type(self._settings), 0
        self.intent = Intent(behaviour=config.behaviour, reason="starting")
        self.activity = "starting"
        self.basis = 0

    def serve_params(self, bus: Bus) -> None:
        """Offer the behaviour's parameters on the bus."""
        for name, expected in self._type.PARAMS.items():
            bus.params.add_field(
                name, expected, lambda: self._settings, self.configure, section=SETTINGS_KEY
            )
        for old, new in RENAMED_PARAMS.get(self.intent.behaviour, {}).items():
            bus.params.rename(old, new)

    def configure(self, settings: Any) -> None:
        """Replace the settings; the behaviour keeps its memory."""
        self._settings = settings
        self._behaviour.configure(settings)
        self._source.configure(settings)

    def step(
        self,
        state: RobotState,
        world: WorldModel | None,
        verdict: SafetyState | None = None,
        objects: ObjectsByPerceptor = NO_OBJECTS,
    ) -> None:
        """Update the intent if there is a new world model."""
        if state.boot != self._boot:  # the driver restarted, and the odometry with it
            self._behaviour, self._boot, self.basis = self._type(self._settings), state.boot, 0
        if world is not None:
            if world.basis == self.basis or world.basis > state.tick:
                return
            self.basis = world.basis
        try:
            step = self._source.step(self._behaviour, state, world, verdict, objects)
        except Exception as error:
            error.add_note(f"behaviour {self._name!r}")
            raise
        self.intent, outcome = step
        self.activity = outcome.activity

    def rest(self, reason: str) -> None:
        """Set the intent to do nothing."""
        self.intent = Intent(behaviour=self._name, reason=reason)
        self.activity = "idle"


async def run(config: DecisionConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Publish a new intent for each world model, and repeat it at each state."""
    source = input_source(config, bus)
    try:
        await source.prepare()
        _serve(config, bus, source)
        ready()
        await asyncio.gather(bus.failed, source.finish_preparing())
    finally:
        await source.close()


def input_source(config: DecisionConfig, bus: Bus) -> InputSource:
    """Return the input source that the configured behaviour needs. Raises ConfigError."""
    settings = behaviours.settings_of(config)
    if not behaviours.needs_map(config.behaviour):
        return InputSource()
    try:
        from gigabrain_zenoh.decision.goal_server import GoalServer
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"behaviour {config.behaviour} needs {error.name}; pip install 'gigabrain-zenoh[nav]'"
        ) from None
    return GoalServer(settings, bus, config)


def _serve(config: DecisionConfig, bus: Bus, source: InputSource) -> None:
    loop, logged_activity, late_worlds = DecisionLoop(config, source), "", 0
    loop.serve_params(bus)
    verdicts: PreviousTick[SafetyState] = PreviousTick()

    def newest_world() -> WorldModel | None:
        body = bodies.current
        return worlds.fresh(scan_limit_ns(body.description) if body else None)

    def decide(_: Message) -> None:
        state = states.fresh()
        if state is None:
            return
        source.observe(state)
        body = bodies.current
        if body and not body.description.has_base:
            loop.basis = state.tick
        if body and not (body.description.has_base or source.moves_arms):
            loop.rest(NO_BASE)
        else:
            verdict = verdicts.at(state.boot, state.tick, SAFETY.stale_after_ns)
            objects.observe(state)
            if world := newest_world():
                world = contours.merged(objects.merged(world), body.description if body else None)
            loop.step(state, world, verdict, objects.fresh())
        publish(state)

    def publish(state: RobotState) -> None:
        nonlocal logged_activity
        bus.publish(INTENT, loop.intent, basis=loop.basis)
        if loop.activity != logged_activity:
            logged_activity, reason = loop.activity, loop.intent.reason
            data = {"event": "decision", "tick": state.tick, "reason": reason}
            log.info("%s", reason, extra={"data": data})

    def on_world(world: WorldModel) -> None:
        nonlocal late_worlds
        late_worlds += newest_world() is None  # outdated on arrival, after a slow link
        if world.basis <= bus.time.tick:
            decide(world)

    def received() -> tuple[object, ...]:
        return bus.arrived.get(STATE.key), bus.arrived.get(WORLD.key)

    bodies, objects = bus.latest(BODY), DetectedObjects(bus)
    contours = ContourFilter(bus.counters)
    states = bus.latest(STATE, decide)
    worlds = bus.latest(WORLD, on_world)
    bus.latest(SAFETY, verdicts.receive)
    bus.progress = Progress(received, lambda: () if source.hung else (loop.basis, late_worlds))
