"""What `gigabrain why` goes by: one short look at every link of the chain."""

import asyncio
import itertools
from collections.abc import Mapping

from msgspec import Struct

from gigabrain_schemas.base import Cause, Velocity
from gigabrain_schemas.body import Body, RobotState
from gigabrain_schemas.brain import CmdVel, Intent, WorldModel
from gigabrain_schemas.requests import Description
from gigabrain_schemas.safety import Health, SafetyState
from gigabrain_schemas.tasks import TaskStatus
from gigabrain_schemas.topics import (
    BODY,
    CMD_VEL,
    HEALTH,
    INTENT,
    SAFETY,
    SCAN,
    STATE,
    TASK,
    WORLD,
    command_topic,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.diagnostics.rates import HOPS, Heard, listen
from gigabrain_zenoh.diagnostics.roll_call import roll_call
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.geometry.limits import ZERO

LOOK_S = 1.5


class Facts(Struct, frozen=True, kw_only=True):
    """One look. None stands for what has not come, or is too old to count."""

    router: str = ""  # why there is none; empty where it answers
    there: Mapping[str, Description] = {}  # who answers, by name
    state: RobotState | None = None
    body: Body | None = None
    scan_age_ms: float | None = None  # by the robot's clock
    world: WorldModel | None = None
    intent: Intent | None = None
    command: CmdVel | None = None  # of the robot's own control
    fastest: Velocity = ZERO  # of the commander's commands in this look, each way
    strangers: tuple[str, ...] = ()  # who else sends commands
    safety: SafetyState | None = None
    tasks: TaskStatus | None = None  # where decision is one that is sent to places
    problems: tuple[Cause, ...] = ()  # of all processes: what they cannot do now
    hz: Mapping[str, float] = {}  # measured, by key
    after_ms: Mapping[str, float] = {}  # from the hop before to this one, median, by key


class Watcher:
    """Collects them."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._state, self._body = bus.latest(STATE), bus.latest(BODY, self._join)
        self._scan, self._world = bus.latest(SCAN), bus.latest(WORLD)
        self._intent, self._safety = bus.latest(INTENT), bus.latest(SAFETY)
        self._tasks = bus.latest(TASK)
        self._heard = listen(bus)
        self._commands: dict[str, list[tuple[int, CmdVel]]] = {}
        self._problems: dict[str, tuple[Cause, ...]] = {}  # by process
        bus.subscribe(CMD_VEL, self._command)
        bus.subscribe(HEALTH, self._health)

    def _health(self, _key: str, health: Health) -> None:
        if health.problems:
            self._problems[health.process] = health.problems

    def _join(self, body: Body) -> None:
        """A body may obey a key of its own."""
        topic = command_topic(body.description)
        if topic.key not in self._bus.listens:
            self._bus.subscribe(topic, self._command)

    def _command(self, _key: str, command: CmdVel) -> None:
        said = self._commands.setdefault(command.source, [])
        said.append((self._bus.clock.now_ns(), command))

    async def look(self, seconds: float = LOOK_S) -> Facts:
        """After so long."""
        bus = self._bus
        began_ns, counts = bus.clock.now_ns(), bus.received.copy()
        there, _ = await asyncio.gather(roll_call(bus), bus.clock.sleep_ns(round(seconds * 1e9)))
        state = self._state.fresh()
        lasted_s = (bus.clock.now_ns() - began_ns) / 1e9
        commander = state.gate.commander if state else ""
        scan_ns = self._scan.age_ns()
        return Facts(
            there=there,
            state=state,
            body=self._body.current,
            scan_age_ms=None if scan_ns is None else scan_ns / 1e6,
            world=self._world.fresh(),
            intent=self._intent.fresh(),
            command=self._newest(BRAIN),
            fastest=_fastest(self._commands.get(commander, [])),
            strangers=tuple(sorted(set(self._commands) - {BRAIN, commander})),
            safety=self._safety.fresh(),
            tasks=self._tasks.fresh(),
            problems=tuple(one for told in self._problems.values() for one in told),
            hz={
                key: round((count - counts[key]) / lasted_s / (2 if key in TWICE else 1), 1)
                for key, count in bus.received.items()
            },
            after_ms=_after(self._heard),
        )

    def _newest(self, source: str) -> CmdVel | None:
        """The newest command of `source`, unless it has fallen silent."""
        said = self._commands.get(source)
        if not said or self._bus.clock.now_ns() - said[-1][0] > SILENT_NS:
            return None
        return said[-1][1]


SILENT_NS = 500_000_000  # wall time: of a simulation that runs slowly as well
TWICE = frozenset(topic.key for topic in (*HOPS, STATE, BODY))  # these are subscribed to twice


def _after(heard: Heard) -> dict[str, float]:
    if not heard.complete:
        return {}
    pairs = itertools.pairwise(HOPS)
    return {after.key: heard.between(before, after) for before, after in pairs}


def _fastest(said: list[tuple[int, CmdVel]]) -> Velocity:
    commands = [command for _, command in said]
    return Velocity(
        linear_x=max((c.linear_x for c in commands), key=abs, default=0.0),
        linear_y=max((c.linear_y for c in commands), key=abs, default=0.0),
        angular_z=max((c.angular_z for c in commands), key=abs, default=0.0),
    )
